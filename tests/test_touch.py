"""Forces as channels: taxels, loads, centres of pressure, and the gradients of all of them, also
where a point touches down between two outputs."""

from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import RUBBER, coarse, dry, grasped, times
from rig_tester import assert_gradients_exact
from scipy.integrate import quad
from scipy.stats import norm
from torch import Tensor

from torchsoft import (
    Body,
    Circle,
    Contact,
    KelvinVoigt,
    Pad,
    PadMesh,
    Rig,
    RigFile,
    Taxels,
    Trajectory,
    simulate,
)
from torchsoft.physics.channels import LIGHT
from torchsoft.sysid import Problem, Sensor, Unknown, record
from torchsoft.testing import check_gradients

SKIN = {"skin": Taxels("L", 3e-3, count=40, spread=1e-3)}


def pressed(speed: float = 0.02) -> tuple[Rig, Tensor]:
    model = coarse()
    model.taxels |= SKIN
    return model, grasped(model, (speed, 0.0))


def run(**options: Any) -> Trajectory:
    model, y0 = pressed()
    return simulate(model, times(0.1, 3), y0=y0, **options)


def test_gradients_of_every_channel_are_the_differences():
    """Taxels and centres too, of a light disc that touches down between two outputs, rolls and
    slips."""
    mesh, rubber = PadMesh(60e-3, 4.59e-3, 60, 3), KelvinVoigt(**RUBBER, tau=0.01)
    rig = Rig(
        bodies={"disc": Body(0.05, Circle(19.37e-3))},
        pads={"table": Pad(mesh, rubber, origin=(-30e-3, 0.0))},
        contacts={"table": Contact("table", "disc", dry())},
        taxels={"skin": Taxels("table", 2e-3, centres=(-2e-3, 0.0, 1e-3), spread=5e-4)},
    )
    place = {"x": 2e-4, "y": mesh.height + 19.37e-3 + 1e-4}
    y0 = rig.state(disc=place | {"v_x": 0.02, "v_y": -0.04, "omega": 3.0}).detach()
    made = assert_gradients_exact((rig, y0), times(0.03, 14), rtol=1e-5, centres=True)
    touching = made.force["table"][..., 0].detach().sum(-1) > 0
    assert not bool(touching[0])
    assert bool(touching[5:].all())


def test_channels_are_sums_of_what_is_recorded():
    made = run()
    normal, shear = made.force["L"].unbind(-1)
    along = torch.from_numpy(made.rig.pads["L"].point_coordinates)
    assert torch.equal(made["L.normal.31"], normal[:, 31])
    assert torch.equal(made["L.shear.30"], shear[:, 30])
    covered = sum(made[f"skin.normal.{i}"] for i in range(40))
    assert torch.allclose(covered, normal.sum(-1), rtol=1e-9)  # the row is wider than the contact
    centre = (normal @ along) / (normal.sum(-1) + LIGHT)
    assert torch.allclose(made["L.centre"], centre, rtol=1e-12)
    assert float((made["skin.centre"] - centre).abs().max()) < 2e-5
    assert torch.allclose(made["bracket.load_y"], made.loads["bracket"][:, 1], rtol=1e-12)
    assert torch.allclose(made["U.force_y"], made["bracket.load_y"], rtol=1e-12)
    assert torch.allclose(made["L.force_y"], -made["disc.load_y"] - made["U.force_y"], rtol=1e-9)
    with pytest.raises(KeyError, match=r"L.normal.0 to 60"):
        made["L.normal.999"]


def test_a_taxel_takes_what_a_gaussian_has_inside_it():
    pad = coarse().pads["L"]
    for given in ({"count": 2}, {"centres": [1e-3, 5e-3]}):
        weights = Taxels("L", 3e-3, spread=2e-3, **given).weights(pad)
        for place, row in zip(given.get("centres", (-1.5e-3, 1.5e-3)), weights, strict=True):
            for x, weight in zip(pad.point_coordinates[28:34], row[28:34]):
                inside = quad(norm(x, 2e-3).pdf, place - 1.5e-3, place + 1.5e-3)[0]
                assert weight == pytest.approx(inside, rel=1e-9)
    sharp = Taxels("L", 2 * float(np.diff(pad.point_coordinates)[0]), count=8).weights(pad)
    assert set(np.unique(sharp)) == {0.0, 0.5, 1.0}
    assert sharp[:, 25:36].sum(0) == pytest.approx(1.0)


def covered(**taxels: Taxels) -> Rig:
    rig = coarse()
    parts = {name: dict(getattr(rig, name)) for name in ("bodies", "pads", "contacts")}
    return Rig(**parts, taxels=taxels)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Taxels("L", 1e-3, count=3, centres=[0.0]), "a `count` or their `centres`"),
        (lambda: covered(skin=Taxels("K", 1e-3, count=3)), "they lie on `K`"),
        (lambda: covered(L=Taxels("L", 1e-3, count=3)), "is called `L` too"),
        (lambda: run(gradient="forward", wrt=["pad.E"], touch=["L.norm"]),
         r"`touch` names 'L.norm', but channels of touch are .*L.normal.0 to 60"),
        (lambda: run(touch=["L.normal"]), "`touch` belong to gradient='forward'"),
        (lambda: RigFile.ready("paper").override(
            taxels={"skin": {"pad": "LU", "width": 2e-3, "count": 4}}),
         r"taxels\.skin\.pad: there is no `LU` among pads"),
    ],
)  # fmt: skip
def test_taxels_that_cannot_be_are_rejected(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_gradients_of_stored_energies_are_the_differences():
    model, y0 = pressed()
    stored = lambda run: run.energy["strain_L"].sum()
    check_gradients(model, times(0.05, 6), y0, wrt=["pad.E"], of=stored, step_error=False)


def test_taxels_are_sensors_of_a_fit_and_columns_of_its_recordings():
    """An array's sensor holds for its taxels, but for one with a gain of its own."""
    built = RigFile.ready("paper").override(
        {"pad.elements_x": 30, "pad.elements_y": 1, "contact.v_s": 0.05},
        taxels={"skin": {"pad": "L", "width": 3e-3, "count": 40, "spread": 1e-3}},
        outputs={"duration": 0.02, "interval": 0.01, "snapshots": []},
    ).build()  # fmt: skip
    recorded = {f"skin.normal.{i}": Sensor(noise=0.02) for i in range(18, 22)}
    recorded |= {"L.centre": Sensor(noise=1e-4), "bracket_moment": Sensor(noise=1e-3)}
    data = record("press", built, {"pad.E": 0.8e6}, recorded, noise=0.0)
    assert data.channels[-6:] == (*list(recorded)[:4], "L.centre", "M_U")
    assert data.units["skin.normal.18"] == "N"
    sensors = {"skin.normal": Sensor(noise=0.02), "L.centre": Sensor(noise=1e-4)}
    sensors |= {"skin.normal.19": Sensor(noise=0.01, gain=0.1)}
    problem = Problem([data], sensors, unknowns := {"pad.E": Unknown(), "contact.K_n": Unknown()})
    assert [problem.sensors[f"skin.normal.{i}"].noise for i in (19, 20)] == [0.01, 0.02]
    assert len(problem.coordinates) == 3
    for missing in ("L.normal.3", "skin.shear"):
        with pytest.raises(ValueError, match=f"no recording has samples of `{missing}`"):
            Problem([data], sensors | {missing: Sensor(noise=1.0)}, unknowns)
    other = deepcopy(data.rig)
    other.taxels["skin"] = replace(other.taxels["skin"], spread=6e-4)
    assert replace(data, rig=deepcopy(data.rig)).fingerprint == data.fingerprint
    assert replace(data, rig=other).fingerprint != data.fingerprint
