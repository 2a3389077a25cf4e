"""The rig that `torchsoft init` writes: a disc that is pressed between two pads and rolled. Made as a Python user would."""

from torchsoft.rigs.actuators import ActuatorTable
from torchsoft.rigs.bodies import BodyTable, StartTable
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.contacts import ContactTable, LawTable, SmoothTable
from torchsoft.rigs.materials import KelvinVoigtTable
from torchsoft.rigs.motion import ProfileTable
from torchsoft.rigs.outputs import OutputsTable
from torchsoft.rigs.pads import BlockTable
from torchsoft.rigs.shapes import CircleTable


def template(title: str) -> RigFile:
    """A rig that is meant to be changed."""
    pad = {"material": "rubber", "length": 80e-3, "height": 5e-3, "elements_x": 80, "elements_y": 4}
    return RigFile(
        title=title,
        bodies={
            "disc": BodyTable(mass=0.4, shape=CircleTable(radius=20e-3), start=StartTable(x=0.3e-3, y="rest")),
            "bracket": BodyTable(mass=0.4, theta=0.0, weighted=False, start=StartTable(x=0.0, y=50.1e-3)),
        },
        materials={"rubber": KelvinVoigtTable(E=0.75e6, nu=0.45, tau=10e-3, depth=44e-3)},
        pads={
            "lower": BlockTable(**pad, origin=(-40e-3, 0.0)),
            "upper": BlockTable(**pad, base="bracket", origin=(-40e-3, 0.0), mirrored=True),
        },
        laws={
            "dry": LawTable(
                K_n=1.2e5, R_n=400.0, K_t=1.2e5, R_t=400.0, friction=SmoothTable(mu_s=0.8, mu_k=0.7, v_s=0.05)
            )
        },
        contacts={name: ContactTable(pad=name, body="disc", law="dry") for name in ("lower", "upper")},
        actuators={
            "x": ActuatorTable(pushes="bracket.x", setpoint="x_d", Kp=1e5, Kd=400.0),
            "y": ActuatorTable(pushes="bracket.y", setpoint="y_d", feed_forward="press", Kp=1e5, Kd=400.0),
        },
        motion={
            "x_d": ProfileTable(times=(0.5, 1.5), values=("start", 20e-3)),
            "y_d": ProfileTable(times=(0.0, 0.4), values=("start", 49e-3)),
            "press": ProfileTable(times=(0.0, 0.4), values=(0.0, -30.0)),
        },
        outputs=OutputsTable(duration=2.0),
    )
