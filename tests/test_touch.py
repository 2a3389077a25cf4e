"""Forces as channels: taxels, loads, centres of pressure, and the gradients of all of them, also
where a point touches down between two outputs."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import coarse, excited, f64, grasped, times
from rig_tester import assert_gradients_exact
from scipy.integrate import quad
from scipy.stats import norm
from test_every_rig import law
from test_sysid import BASE, SENSORS, SHAKE, TRUTH, check_derivatives
from test_sysid_rigs import FIT, RIG
from test_sysid_rigs import coarse as fingers
from torch import Tensor

from torchsoft import (
    Body,
    Circle,
    Contact,
    KelvinVoigt,
    Pad,
    PadMesh,
    Rig,
    Taxels,
    Trajectory,
    simulate,
    simulate_batch,
)
from torchsoft.rigs.build import RigFile
from torchsoft.solve.trajectory import LIGHT
from torchsoft.sysid import Problem, Sensor, Unknown, record
from torchsoft.sysid.measured import load

SKIN = {"skin": Taxels("L", 3e-3, count=40, spread=1e-3)}


def pressed(speed: float = 0.02) -> tuple[Rig, Tensor]:
    model = coarse()
    model.taxels |= SKIN
    return model, grasped(model, (speed, 0.0))


def run(**options: Any) -> Trajectory:
    model, y0 = pressed()
    return simulate(model, times(0.1, 3), y0=y0, **options)


def covered(**taxels: Taxels) -> Rig:
    """The paper's bodies and pads without loops, with taxels."""
    rig = coarse()
    parts = {name: dict(getattr(rig, name)) for name in ("bodies", "pads", "contacts")}
    return Rig(**parts, taxels=taxels)


def falling() -> tuple[Rig, Tensor]:
    """A light disc that comes down on a pad between two outputs, rolls and slips."""
    mesh, rubber = PadMesh(60e-3, 4.59e-3, 60, 3), KelvinVoigt(0.7e6, 0.45, 1100.0, 0.01, 10e-3)
    rig = Rig(
        bodies={"disc": Body(0.05, Circle(19.37e-3))},
        pads={"table": Pad(mesh, rubber, origin=(-30e-3, 0.0))},
        contacts={"table": Contact("table", "disc", law())},
        taxels={"skin": Taxels("table", 2e-3, centres=(-2e-3, 0.0, 1e-3), spread=5e-4)},
    )
    y0 = torch.zeros(rig.layout.size, dtype=torch.float64)
    y0[rig.layout.slices["pose", "disc"]] = f64(2e-4, mesh.height + 19.37e-3 + 1e-4, 0.0)
    y0[rig.layout.slices["velocity", "disc"]] = f64(0.02, -0.04, 3.0)
    return rig, y0


def test_gradients_of_every_channel_are_the_differences():
    """Taxels and centres too, from before a touch-down."""
    run = assert_gradients_exact(falling(), times(0.03, 14), rtol=1e-5, centres=True)
    touching = run.force["table"][..., 0].detach().sum(-1) > 0
    assert not bool(touching[0])
    assert bool(touching[5:].all())


def test_channels_are_sums_of_what_is_recorded():
    model, y0 = pressed()
    run = simulate(model, times(0.05, 6), y0=y0)
    normal, shear = run.force["L"].unbind(-1)
    along = torch.from_numpy(model.pads["L"].point_coordinates)
    assert torch.equal(run["L.normal.31"], normal[:, 31])
    assert torch.equal(run["L.shear.30"], shear[:, 30])
    covered = sum(run[f"skin.normal.{i}"] for i in range(40))
    assert torch.allclose(covered, normal.sum(-1), rtol=1e-9)  # the row is wider than the contact
    centre = (normal @ along) / (normal.sum(-1) + LIGHT)
    assert torch.allclose(run["L.centre"], centre, rtol=1e-12)
    assert float((run["skin.centre"] - centre).abs().max()) < 2e-5
    assert torch.allclose(run["bracket.load_y"], run.loads["bracket"][:, 1], rtol=1e-12)
    assert torch.allclose(run["U.force_y"], run["bracket.load_y"], rtol=1e-12)
    assert torch.allclose(run["L.force_y"], -run["disc.load_y"] - run["U.force_y"], rtol=1e-9)
    for name, part in (("no.normal.0", "no.normal.0"), ("L.normal.999", "L.normal.0 to 60")):
        with pytest.raises(KeyError, match=part):
            run[name]


def test_a_taxel_takes_what_a_gaussian_has_inside_it():
    pad = coarse().pads["L"]
    taxels = Taxels("L", 3e-3, centres=[1e-3, 5e-3], spread=2e-3)
    weights = taxels.weights(pad)
    for place, row in zip((1e-3, 5e-3), weights):
        for x, weight in zip(pad.point_coordinates[28:34], row[28:34]):
            inside = quad(norm(x, 2e-3).pdf, place - 1.5e-3, place + 1.5e-3)[0]
            assert weight == pytest.approx(inside, rel=1e-9)
    sharp = Taxels("L", 2 * float(np.diff(pad.point_coordinates)[0]), count=8).weights(pad)
    assert set(np.unique(sharp)) == {0.0, 0.5, 1.0}
    assert sharp[:, 25:36].sum(0) == pytest.approx(1.0)


REFUSED: dict[str, tuple[Callable[[], Any], str]] = {
    "both": (lambda: Taxels("L", 1e-3, count=3, centres=[0.0]), "a `count` or their `centres`"),
    "width": (lambda: Taxels("L", 0.0, count=3), "`width` should be from 1e-06 to 10 m, not 0"),
    "pad": (lambda: covered(skin=Taxels("K", 1e-3, count=3)), "they lie on `K`"),
    "name": (lambda: covered(L=Taxels("L", 1e-3, count=3)), "is called `L` too"),
    "channel": (
        lambda: run(gradient="forward", wrt=["pad.E"], touch=["L.norm"]),
        r"`touch` names 'L.norm', but channels of touch are .*L.normal.0 to 60",
    ),
    "route": (
        lambda: run(touch=["L.normal"]),
        "`touch` belong to gradient='forward'",
    ),
    "file": (
        lambda: RigFile.from_toml(RIG).override(
            taxels={"skin": {"pad": "tables", "width": 2e-3, "count": 4}}
        ),
        r"taxels\.skin\.pad: there is no `tables` among pads",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_felt_is_refused(case):
    make, said = REFUSED[case]
    with pytest.raises(ValueError, match=said):
        make()


def test_forces_of_a_batch_have_the_gradients_of_its_runs():
    model, y0 = pressed()
    values = f64(0.6e6, 0.8e6).requires_grad_()
    t = times(0.05, 6)
    batch = simulate_batch(
        model, t, parameters={"pad.E": values}, y0=y0, gradient="discrete", rtol=1e-4, threads=2
    )
    felt = batch["skin.normal.20"][:, -1] + batch["bracket_moment"][:, 2]
    (slope,) = torch.autograd.grad(felt.sum(), values)
    for i, value in enumerate(values.tolist()):
        with torch.no_grad():
            model.parameter("pad.E").fill_(value)
        run = simulate(model, t, y0=y0, gradient="discrete", rtol=1e-4)
        (alone,) = torch.autograd.grad(
            run["skin.normal.20"][-1] + run["bracket_moment"][2], model.parameter("pad.E")
        )
        assert float(slope[i]) == pytest.approx(float(alone), rel=1e-9)
    batch = simulate_batch(
        model, t, y0=[y0, y0], gradient="forward", wrt=["pad.E"], touch=["skin.normal"]
    )
    assert all(len(one.touch_sensitivities) == 40 for one in batch.trajectories if one is not None)


def test_stored_energies_have_gradients():
    model, y0 = pressed()
    t = times(0.05, 6)
    run = simulate(model, t, y0=y0, gradient="discrete", tolerance=1e-10, rtol=1e-4)
    E, ends = model.parameter("pad.E"), []
    (slope,) = torch.autograd.grad(run.energy["strain_L"].sum(), E)
    for h in (1.0, -1.0):
        with torch.no_grad():
            E.add_(h)
        again = simulate(model, t, y0=y0, tolerance=1e-10, knots=run.knots)
        ends.append(float(again.energy["strain_L"].sum()))
        with torch.no_grad():
            E.sub_(h)
    assert float(slope) == pytest.approx(0.5 * (ends[0] - ends[1]), rel=1e-5)


def test_taxels_are_sensors_of_a_fit():
    """Jacobian and gradient of the misfit; an array's sensor stands for its taxels, one with a
    delay and a gain of its own but one."""
    felt = {f"skin.normal.{i}": Sensor(noise=0.02) for i in range(18, 22)}
    centre = {"L.centre": Sensor(noise=1e-4), "bracket_moment": Sensor(noise=1e-3)}
    skin = {"pad": "L", "width": 3e-3, "count": 40, "spread": 1e-3}
    planned = excited(SHAKE, BASE.override(taxels={"skin": skin}))
    data = record("shake", planned, TRUTH, SENSORS | felt | centre, noise=0.0)
    assert data.channels[-6:] == (*felt, "L.centre", "M_U")
    sensors = (
        SENSORS
        | centre
        | {
            "skin.normal": Sensor(noise=0.02),
            "skin.normal.19": Sensor(noise=0.01, gain=0.1),
        }
    )
    unknowns = {"pad.E": Unknown(), "contact.K_n": Unknown(), "contact.mu_s": Unknown()}
    problem = Problem([data], sensors, unknowns)
    assert problem.sensors["skin.normal.20"].noise == 0.02
    assert problem.sensors["skin.normal.19"].noise == 0.01
    assert len(problem.coordinates) == 4
    check_derivatives(problem, problem.coordinates.start, 1e-4, 1e-4, 1e-6)
    with pytest.raises(ValueError, match=r"no recording has samples of `L\.normal\.3`"):
        Problem([data], SENSORS | {"L.normal.3": Sensor(noise=1.0)}, unknowns)
    with pytest.raises(ValueError, match=r"no recording has samples of `skin\.shear`"):
        Problem([data], SENSORS | {"skin.shear": Sensor(noise=1.0)}, unknowns)


def test_taxels_of_a_rig_file_are_columns_of_its_recordings(tmp_path):
    skin = {"skin": {"pad": "left_tip", "width": 2e-3, "count": 3, "spread": 5e-4}}
    file = fingers(taxels=skin)
    rig, y0, _ = file.build()
    t = times(0.4, 81)
    run = simulate(rig, t, y0=y0, rtol=1e-5)
    text = RIG.read_text(encoding="utf-8") + (
        '\n[taxels.skin]\npad = "left_tip"\nwidth = 2e-3\ncount = 3\nspread = 5e-4\n'
    )
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
    fit = FIT.replace("y_disc.noise = 1e-5\n", "").replace("effort_left_x.noise = 0.05\n", "")
    fit += '"skin.normal".noise = 0.01\n'
    (tmp_path / "fit.toml").write_text(fit, encoding="utf-8")
    names = ["x_disc", "x_left", *(f"skin.normal.{i}" for i in range(3))]
    head = "t [s],camera [m],x_left [m]," + ",".join(f"{name} [N]" for name in names[2:])
    table = torch.cat((t[:, None], run.together(*names)), 1).numpy()
    np.savetxt(tmp_path / "run.csv", table, "%.12g", ",", header=head, comments="")
    problem = load([tmp_path / "run.csv"], tmp_path / "fit.toml").problem
    assert {f"skin.normal.{i}" for i in range(3)} <= set(problem.recordings[0].samples)
    assert problem.sensors["skin.normal.1"].noise == 0.01
    assert problem.recordings[0].units["skin.normal.1"] == "N"
    recording = problem.recordings[0]
    own, other = deepcopy(recording.rig), deepcopy(recording.rig)
    other.taxels["skin"] = replace(other.taxels["skin"], spread=6e-4)
    assert replace(recording, rig=own).fingerprint == recording.fingerprint
    assert replace(recording, rig=other).fingerprint != recording.fingerprint
