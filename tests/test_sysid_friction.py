"""A friction law of the user's own, with parameters that no rig file has, identified like any
other."""

import pickle
import runpy
from dataclasses import replace
from functools import partial

import pytest
from conftest import COARSE, PAPER, RIG, excited, stroked
from test_sysid import check_derivatives
from torch import Tensor, nn

from torchsoft.physics.contact import SlipLaw
from torchsoft.physics.shapes import parameter
from torchsoft.sysid import Problem, Recording, Unknown, record

BASE = PAPER.override(COARSE)
SENSORS = {
    name: RIG[name].model_copy(update={"noise": 0.7 * RIG[name].noise})
    for name in ("x_C", "theta_C", "effort_x")
}
JERKS = stroked(30e-3, stroke_time=0.1, duration=0.6, depth=5e-4, grasp=0.2, since=0.25)
E, FRICTION = "materials.rubber.E", "laws.steel_on_rubber.friction"
ALPHA, BETA = f"{FRICTION}.alpha", f"{FRICTION}.beta"
TRUTH = {ALPHA: 0.45, BETA: 200.0}


class Viscous(nn.Module):
    """Slip under what exceeds alpha F_N, against a viscosity beta F_N, beta in s/m."""

    def __init__(self, alpha: float, beta: float) -> None:
        super().__init__()
        self.alpha, self.beta = parameter(alpha), parameter(beta)

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        return (E - self.alpha * F_N).clamp(min=0.0) / (R + self.beta * F_N)


def given(recording: Recording, law: SlipLaw | None = None) -> Recording:
    """The same samples, of a rig with another law of friction; by default the file's."""
    rig = BASE.assemble({} if law is None else {FRICTION: law})
    rig.reference = recording.rig.reference
    return replace(recording, rig=rig)


@pytest.fixture(scope="module")
def jerks():
    """Without noise, of the true law; the recording's own model has other numbers."""
    planned = excited(JERKS, BASE, parts={FRICTION: Viscous(0.6, 100.0)})
    return record("jerks", planned, TRUTH | {E: 0.9e6}, SENSORS, noise=0.0)


@pytest.mark.slow
def test_its_derivatives_by_both_routes_are_those_of_differences(jerks):
    slack = {BETA: Unknown(scale="linear", nominal=1.0, low=0.0, high=100.0)}
    ratio = {"control.K_98": Unknown(ratio_to="control.K_81")}
    problem = Problem([jerks], SENSORS, {ALPHA: Unknown()} | slack | ratio)
    check_derivatives(problem, problem.coordinates.start, 3e-5, 2e-4)


def test_only_what_the_model_has_can_be_identified(jerks):
    assert {*TRUTH, E} <= set(jerks.parameters)
    for name in (f"{FRICTION}.mu_s", f"{FRICTION}.gamma"):
        with pytest.raises(ValueError, match=f"`{name}` cannot be identified; .*{ALPHA}"):
            Problem([jerks], SENSORS, {name: Unknown()})
    negative = given(jerks, Viscous(-1.0, 100.0))
    with pytest.raises(ValueError, match=r"friction\.alpha = -1 is not on a logarithmic scale"):
        Problem([negative], SENSORS, {ALPHA: Unknown()})


def scaled(factor: float) -> SlipLaw:
    return lambda E, F_N, R: factor * E / R


def weighted(E: Tensor, F_N: Tensor, R: Tensor, factor: float) -> Tensor:
    return factor * E / R


def test_recordings_of_other_laws_have_other_fingerprints(jerks, tmp_path):
    """Of other numbers, another function, one that holds others, or another file; not in another
    process."""
    laws = [Viscous(0.6, 100.0), None, Viscous(0.61, 100.0)]
    for factor in (0.5, 0.25):
        laws += [scaled(factor), partial(weighted, factor=factor)]
    for number, text in enumerate(("E / R", "E / (2 * R)")):
        path = tmp_path / f"laws_{number}.py"
        path.write_text(f"def law(E, F_N, R):\n    return {text}\n")
        laws.append(runpy.run_path(str(path))["law"])
    prints = [given(jerks, law).fingerprint for law in laws]
    assert len(set(prints)) == len(laws)
    assert prints == [given(jerks, law).fingerprint for law in laws]
    there = pickle.loads(pickle.dumps(jerks))
    assert isinstance(there.run_context().rig.contacts["L"].law.friction, Viscous)
    assert there.fingerprint == jerks.fingerprint
