"""A friction law of the user's own, with parameters that `Parameters` does not have, identified
like any other."""

import pickle
import runpy
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
from conftest import COARSE, PAPER, RIG, excited, still, stroked
from test_sysid import check_derivatives
from torch import Tensor, nn

from torchsoft import Reference, Rig, RigFile, excite
from torchsoft.physics.contact import SlipLaw
from torchsoft.physics.shapes import parameter
from torchsoft.sysid import Problem, Recording, Stage, Unknown, identify, record

BASE = PAPER.override(COARSE)
SENSORS = {
    name: RIG[name].model_copy(update={"noise": 0.7 * RIG[name].noise})
    for name in ("x_C", "theta_C", "effort_x")
}
JERKS = stroked(
    travel=30e-3,
    stroke_time=0.1,
    duration=0.6,
    depth=5e-4,
    grasp=0.2,
    since=0.25,
)
TRUTH = {"laws.steel_on_rubber.friction.alpha": 0.45, "laws.steel_on_rubber.friction.beta": 200.0}


class Viscous(nn.Module):
    """Slip under what exceeds alpha F_N, against a viscosity beta F_N, beta in s/m."""

    def __init__(self, alpha: float, beta: float) -> None:
        super().__init__()
        self.alpha, self.beta = parameter(alpha), parameter(beta)

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        return (E - self.alpha * F_N).clamp(min=0.0) / (R + self.beta * F_N)


def rig(settings: RigFile, reference: Reference, alpha: float = 0.6) -> Rig:
    return still(settings, reference, friction=Viscous(alpha, 100.0))


def built(recording: Recording, build: Callable[[RigFile, Reference], Rig]) -> Recording:
    """The same samples, of another rig."""
    return replace(recording, rig=build(excite(BASE, JERKS), recording.rig.reference))


@pytest.fixture(scope="module")
def jerks():
    """Without noise, of the true law; the recording's own model has other numbers."""
    planned = excited(JERKS, BASE)
    planned = replace(planned, rig=rig(excite(BASE, JERKS), planned.rig.reference))
    return record("jerks", planned, TRUTH | {"materials.rubber.E": 0.9e6}, SENSORS, noise=0.0)


def test_its_parameters_are_found_beside_those_of_the_pads(jerks):
    problem = Problem(
        [jerks], SENSORS, {name: Unknown() for name in (*TRUTH, "materials.rubber.E")}
    )
    plan = [Stage("all", ("jerks",), problem.coordinates.labels, 1e-6)]
    answer = identify(
        problem, plan=plan, assumptions="trusted"
    )  # three sensors do not tell beta from the mesh
    assert answer.converged
    for name, value in (*TRUTH.items(), ("materials.rubber.E", 0.9e6)):
        assert answer[name].identifiable, name
        assert abs(answer[name].last / value - 1) < 0.1 * answer[name].relative_sd, (
            name
        )  # of the steps, which differ
    assert answer["laws.steel_on_rubber.friction.alpha"].unit == ""


def test_its_derivatives_by_both_routes_are_those_of_differences(jerks):
    slack = {
        "laws.steel_on_rubber.friction.beta": Unknown(
            scale="linear", nominal=1.0, low=0.0, high=100.0
        )
    }
    ratio = {"actuators.y.Kp": Unknown(ratio_to="actuators.x.Kp")}
    problem = Problem(
        [jerks], SENSORS, {"laws.steel_on_rubber.friction.alpha": Unknown()} | slack | ratio
    )
    check_derivatives(problem, problem.coordinates.start, 3e-5, 2e-4)


def test_it_can_be_sent_to_another_process(jerks):
    there = pickle.loads(pickle.dumps(jerks))
    assert isinstance(there.begin().rig.contacts["L"].law.friction, Viscous)
    assert there.fingerprint == jerks.fingerprint


def test_only_what_the_model_has_can_be_identified(jerks):
    assert {*TRUTH, "materials.rubber.E", "actuators.y.Kd", "bodies.disc.shape.radius"} <= set(
        jerks.parameters
    )
    for name in ("laws.steel_on_rubber.friction.mu_s", "laws.steel_on_rubber.friction.gamma"):
        with pytest.raises(
            ValueError,
            match=f"`{name}` cannot be identified; .*laws.steel_on_rubber.friction.alpha",
        ):
            Problem([jerks], SENSORS, {name: Unknown()})
    negative = built(jerks, partial(rig, alpha=-1.0))
    with pytest.raises(
        ValueError, match=r"contact\.friction\.alpha = -1 is not on a logarithmic scale"
    ):
        Problem([negative], SENSORS, {"laws.steel_on_rubber.friction.alpha": Unknown()})


def frictionless(E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
    return E / R


def plain(settings: RigFile, reference: Reference, law: SlipLaw = frictionless) -> Rig:
    return still(settings, reference, friction=law)


def scaled(factor: float) -> SlipLaw:
    return lambda E, F_N, R: factor * E / R


def weighted(E: Tensor, F_N: Tensor, R: Tensor, factor: float) -> Tensor:
    return factor * E / R


def test_a_checkpoint_of_another_law_is_not_read(jerks, tmp_path):
    """Neither of other numbers, nor of another function, of one that holds others, nor of a changed
    one."""
    builds = [rig, Rig, partial(rig, alpha=0.61), plain]
    for factor in (0.5, 0.25):
        builds += [
            partial(plain, law=law) for law in (scaled(factor), partial(weighted, factor=factor))
        ]
    for number, text in enumerate(("E / R", "E / (2 * R)")):
        path = tmp_path / f"{number}" / "laws.py"
        path.parent.mkdir()
        path.write_text(f"def law(E, F_N, R):\n    return {text}\n")
        builds.append(partial(plain, law=runpy.run_path(str(path))["law"]))
    prints = [built(jerks, build).fingerprint for build in builds]
    assert len(set(prints)) == len(builds) == 10
    assert prints == [built(jerks, build).fingerprint for build in builds]
