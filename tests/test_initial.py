"""A run of a built rig starts from the equilibrium of its present parameters, and is differentiated
with its start: every value is that of the rig built anew."""

import copy

import numpy as np
import pytest
import torch

from torchsoft import BuiltRig, RigFile, Trajectory, simulate, simulate_batch
from torchsoft.sysid import Standing
from torchsoft.sysid.prediction import predict
from torchsoft.sysid.recording import Grid, Recording

E, MASS = "materials.rubber.E", "bodies.disc.mass"
COARSE = {f"pads.{pad}.elements_{axis}": n for pad in ("lower", "upper")
          for axis, n in (("x", 20), ("y", 1))}  # fmt: skip
FILE = RigFile.ready("light_grasp").override(
    COARSE | {"bodies.bracket.start": {"x": 60.3e-3, "y": {"force": 4.0}}},
    motion={
        "y_d": {"kind": "spline", "times": [0.0, 0.02, 0.04],
                "values": ["start", 49.6e-3, "start"]},
        "x_d": {"kind": "profile", "offset": "start", "times": [0.0, 0.04], "values": [0.0, 2e-3]},
        "F_ff": {"kind": "hold", "value": "held"},
    },
    outputs={"duration": 0.04, "interval": 5e-3, "snapshots": []},
)  # fmt: skip
"""A rig pressed together, whose set-points follow the start and whose feed-forward holds it."""
TOUCHING = FILE.override({"bodies.bracket.start.y": "touch", "motion.F_ff.value": -4.0})
CHANNELS = "x_disc", "y_disc", "y_bracket", "effort_y"


def anew(values: dict[str, float], file: RigFile = FILE, **options: object) -> Trajectory:
    return file.override(values).build().run(**options)


def changed(values: dict[str, float]) -> BuiltRig:
    built = FILE.build()
    with torch.no_grad():
        for name, value in values.items():
            built.rig.parameter(name).fill_(value)
    return built


def assert_same(run: Trajectory, expected: Trajectory) -> None:
    for channel in CHANNELS:
        size = (expected[channel] - expected[channel][0]).abs().max()
        assert (run[channel] - expected[channel]).abs().max() < 1e-6 * size, channel


def test_a_run_starts_from_the_equilibrium_of_the_present_parameters():
    """Set in place, loaded or copied; a set-point changed in place keeps its change."""
    values = {E: 0.3e6, MASS: 0.6}
    built, expected, other = changed(values), anew(values), FILE.build()
    assert (built.run().y[0] - built.y0).abs().max() > 1e-5  # the start did move
    other.rig.load_state_dict(FILE.override(values).build().rig.state_dict())
    for one in (built, other, copy.deepcopy(built)):
        assert_same(one.run(knots=expected.knots), expected)
    with torch.no_grad():
        built.rig.reference["y_d"].values[1] -= 1e-4
    expected = anew(values | {"motion.y_d.values": ["start", 49.5e-3, "start"]})
    assert_same(built.run(knots=expected.knots), expected)


def test_derivatives_include_the_start_the_set_points_and_the_feed_forward():
    """Adjoint, forward, and differences of rigs built anew."""
    built, names = FILE.build(), [E, MASS]
    run = built.run(gradient="discrete")
    ahead = built.run(gradient="forward", wrt=names, knots=run.knots)
    leaves = [*map(built.rig.parameter, names)]
    ends = [
        [anew({name: value.item() * (1 + h)}, knots=run.knots) for h in (1e-4, -1e-4)]
        for name, value in zip(names, leaves)
    ]
    for channel in ("y_disc", "effort_y"):
        slopes = torch.autograd.grad(run[channel][-1], leaves, retain_graph=True)
        for value, (high, low), slope in zip(leaves, ends, slopes):
            difference = float(high[channel][-1] - low[channel][-1]) / (2e-4 * value.item())
            assert float(slope) == pytest.approx(difference, 1e-4)
    at = built.rig.layout.slices["pose", "disc"].start + 1
    slopes = torch.autograd.grad(run["y_disc"][-1], leaves)
    assert ahead.sensitivities[-1, at].tolist() == pytest.approx([*map(float, slopes)], rel=1e-7)


def test_a_given_start_is_held_constant():
    built = FILE.build()
    run = built.run(y0=built.y0, gradient="discrete")
    run["y_disc"][0].backward()
    assert not built.rig.parameter(E).grad
    assert_same(run, simulate(built.rig, built.t, y0=built.y0, **built.solver))


@pytest.mark.slow
def test_every_run_of_a_batch_starts_at_its_own_parameters():
    built, moduli = FILE.build(), torch.tensor([0.4e6, 0.9e6], dtype=torch.float64)
    moduli.requires_grad_()
    batch = simulate_batch(
        built.rig, built.t, y0=built.initial, parameters={E: moduli}, gradient="discrete", threads=1
    )
    batch["y_disc"][:, -1].sum().backward()
    for i, value in enumerate(moduli.tolist()):
        alone = FILE.override({E: value}).build()
        run = alone.run(gradient="discrete")
        run["y_disc"][-1].backward()
        assert (batch["y_disc"][i] - run["y_disc"]).abs().max() < 1e-8
        assert moduli.grad[i].item() == pytest.approx(alone.rig.parameter(E).grad.item(), rel=1e-6)


def test_identification_follows_the_start_and_its_set_points():
    """With springs that are "auto", a bracket that touches, and set-points that follow it."""
    auto = {f"laws.wet.{name}": "auto" for name in ("K_n", "R_n", "K_t", "R_t")}
    file = TOUCHING.override(auto)
    built = file.build()
    samples = {name: (built.t.numpy(), built.t.numpy()) for name in ("y_bracket", "effort_y")}
    made = Recording("bench", built.rig, samples, Standing.built(built, 0.0))
    at = 0.5e6
    found = predict(made.run_context(), {E: at}, Grid(built.t, 0), [E], 1e-6)
    knots = torch.from_numpy(found.knots)
    expected, high, low = (anew({E: at * by}, file, knots=knots) for by in (1, 1 + 1e-4, 1 - 1e-4))
    for name in samples:
        column, size = made.channels.index(name), float(np.ptp(expected[name].numpy()))
        assert found.signals[:, column] == pytest.approx(expected[name].numpy(), abs=1e-6 * size)
        slope = ((high[name] - low[name]) / (2e-4 * at)).numpy()
        error = np.abs(found.derivatives[:, column, 0] - slope).max()
        assert error < 1e-3 * np.abs(slope).max(), name
