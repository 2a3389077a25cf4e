"""Configurations of datasets: their distributions, and mistakes that are named by their field."""

import copy
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import truncnorm
from test_datasets import CONFIG, KINDS, written

from torchsoft.cli import main
from torchsoft.datasets.config import Config
from torchsoft.datasets.distributions import Choice, Normal, Uniform
from torchsoft.datasets.generate import points
from torchsoft.datasets.rig_files import embedded
from torchsoft.tables import InvalidTable

SPAN = "{low = 0.3, high = 0.7}"


def stroke(line: str) -> str:
    """The kinds, with a line more in the first one."""
    return KINDS.replace('name = "stroke"', f'name = "stroke"\n{line}')


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    folder = tmp_path_factory.mktemp("config")
    return embedded(tomllib.loads(written(folder, CONFIG + KINDS).read_text()), folder)


MISTAKES = [
    (f'parameters."materials.silicone.E" = {SPAN}',
     r"`materials.silicone.E` is not in the rig file: materials has rubber"),
    (f'parameters."motion.y_d.values_8" = {SPAN}', "it has motion.y_d.values_1 to _2"),
    (f'parameters."materials.rubber.nu" = {SPAN}', r"nu.high = 0.7: impossible: .*nu.*0\.4999"),
    ('parameters."bodies.disc.mass" = {choices = [0.3, -0.4]}',
     r"mass.choices.1 = -0.4: impossible"),
    ('parameters."bodies.disc.start.x" = {mean = 0.06, sd = 1e19}',
     r"start.x: mean - 4 sd = -4e\+19: impossible"),
    ('parameters."bodies.disc.mass" = {mean = 0.4}', "parameters.bodies.disc.mass.sd is missing"),
    ('parameters."bodies.disc.mass" = {mean = 0.4, sd = 0.01, low = 0.5}',
     "low = 0.5 should be below high"),
    ('parameters."bodies.disc.mass" = {mean = 0.4, sd = 0.01, low = 1.5, high = 1.6}',
     "next to nothing of mean = 0.4"),
    ('parameters."materials.rubber.E" = {low = 9e5, high = 8e5}', "rubber.E: low = 9"),
    ('parameters."materials.rubber.E" = {low = -1.0, high = 0.9e6, scale = "log"}',
     "logarithmic range needs low > 0"),
    ('parameters."laws.dry.friction.mu_k" = {low = 0.75, high = 0.9}',
     r"mu_k.high = 0.9: .* must not exceed mu_s"),
    ('parameters."laws.dry.friction.mu_k" = {low = 0.8, high = 1.0, ratio_to = "laws.dry.mu"}',
     "mu_k.ratio_to: `laws.dry.mu` is not in the"),
    ('parameters."materials.rubber.E" = '
     '{low = 0.3, high = 0.7, ratio_to = "laws.dry.friction.mu_k"}', "mu_k is a ratio itself"),
    ('parameters."bodies.disc.start.x" = {low = 0.0595, high = 0.0605}\n'
     'parameters."bodies.bracket.start.x" = {choices = [1e5], ratio_to = "bodies.disc.start.x"}',
     r"parameters.bodies.bracket.start.x.choices.0 = 100000: impossible"),
    (f'parameters."pads.upper.elements_x" = {SPAN}',
     "the same in every trajectory; set it in `fix"),
    ('parameters."pads.upper.length" = {low = 70e-3, high = 80e-3}',
     "length.low = 0.07: it changes the contact points of pads.upper"),
    ('parameters."bodies.disc.theta" = {low = 0.0, high = 1e-3}',
     "theta.low = 0: it changes the coordinates and energies of the rig"),
    (f'parameters."contacts.above.pad" = {SPAN}', "is no number, but 'upper'"),
    (f'parameters."outputs.duration" = {SPAN}', "`outputs.duration` has no part in a dataset"),
    (f'parameters."pads.lower.elements_x" = {SPAN}', "is in `fixed` as well"),
    ('fixed."pads.lower.elements" = 3', "fixed.pads.lower.elements: .*you mean `elements_y`"),
    ('channels = ["x_disk"]', "channels: `x_disk` is no channel of the rig; there are x_disc"),
    ('channels = ["x_disc", "x_disc"]', "channels: every name once"),
    ("duration = 0.102", "duration = 0.102 s is not a whole number of sample_interval"),
    (KINDS.replace('"stroke"', '"grip"'), "kinds: every name once"),
    (stroke('fixed."motion.x_e" = {kind = "hold"}'), "kinds.0.*x_e.*did you mean `x_d`"),
    (stroke('fixed."materials.rubber.E" = 1e6'),
     "kinds.0.parameters.materials.rubber.E: it is in `fixed`"),
    (stroke('parameters."motion.x_d.stroke_time" = {low = 1e-6, high = 1e-2}'),
     "kinds.0.*stroke_time.low = 1e-06: impossible: .* makes 50000 strokes"),
    (stroke('fixed."motion.y_d" = {kind = "hold", value = 49e-3}'),
     "kinds.0.parameters.motion.y_d.values_2: `motion.y_d.values_2` is not in"),
    (stroke('fixed."motion.y_d.values" = ["held", 49e-3]'), '"held" stands for the effort'),
    (stroke('fixed."pads.lower.points" = 2'), "kinds.0.fixed: it changes the contact points"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "message"), MISTAKES)
def test_a_mistake_is_named_by_its_field(tree, change, message):
    changes = tomllib.loads(change).items()
    other = {k: tree[k] | new if isinstance(new, dict) else new for k, new in changes}
    with pytest.raises(InvalidTable) as error:
        Config.model_validate(tree | other)
    assert re.search(message, str(error.value)), str(error.value)
    assert "\n" not in str(error.value)


def test_mistakes_of_the_whole_are_named(tree):
    nothing = {name: one for name, one in tree.items() if name != "kinds"} | {"parameters": {}}
    with pytest.raises(InvalidTable, match="parameters is missing: nothing would differ"):
        Config.model_validate(nothing)
    same = copy.deepcopy(tree) | {"channels": None, "kinds": []}
    same["rig"]["motion"]["steps"] = same["rig"]["motion"].pop("x_d")
    same["rig"]["actuators"]["x"]["setpoint"] = "steps"
    with pytest.raises(InvalidTable, match="two arrays of the dataset would be called `steps`"):
        Config.model_validate(same)


def test_another_file_is_another_dataset(tmp_path):
    """However its numbers are written."""
    path = written(tmp_path)
    config = Config.from_toml(path)
    path.write_text(CONFIG.replace("high = 1.0", "high = 1"))
    assert Config.from_toml(path).hash == config.hash
    licensed = config.model_copy(update={"license": "CC-BY-4.0"})
    assert Config.model_validate(licensed.model_dump()) == licensed
    (tmp_path / "rigs" / "x_d.csv").write_text("t [s],x [mm]\n0,0\n0.05,0\n0.1,0.3\n")
    assert Config.from_toml(path).hash != config.hash
    (tmp_path / "rigs" / "x_d.csv").unlink()
    with pytest.raises(OSError, match=r"x_d\.csv"):
        Config.from_toml(path)


def test_kinds_are_drawn_by_weight_with_their_own_parameters(tree):
    """Which may be those of all kinds, otherwise distributed."""
    config = Config.model_validate(tree | {"trajectories": 96})
    tasks = [config.subject.task(i, u) for i, u in enumerate(points(config))]
    of = {name: [one for one in tasks if one.labels["kind"] == name] for name in ("stroke", "grip")}
    assert [len(some) for some in of.values()] == pytest.approx([32, 64], abs=1)
    for name, low, high in (("grip", 49.1e-3, 49.2e-3), ("stroke", 49.4e-3, 49.6e-3)):
        heights = [one.labels["motion.y_d.values_2"] for one in of[name]]
        assert low <= min(heights) < max(heights) <= high
    travel = np.array([one.values["motion.x_d.travel"] for one in of["stroke"]])
    assert (np.abs(np.abs(travel) - 1.5e-4) <= 0.5e-4).all()
    assert 8 < (travel < 0).sum() < 24
    assert all("motion.x_d.travel" not in one.labels for one in tasks)


@settings(max_examples=50, derandomize=True)
@given(
    st.floats(1e-6, 1e8), st.floats(1.0, 1e6), st.floats(0, 1), st.sampled_from(["log", "linear"])
)
def test_a_uniform_quantile_lies_within_its_ends_where_it_should(low, ratio, u, scale):
    """For either sign symmetrically about zero."""
    one = Uniform(low=low, high=low * ratio, scale=scale)
    assert one.low <= one.at(u) <= one.high
    expected = low * ratio**u if scale == "log" else low + u * (one.high - low)
    assert one.at(u) == pytest.approx(expected, rel=1e-9)
    both = one.model_copy(update={"either_sign": True})
    assert both.at(0.5 + u / 2) == pytest.approx(expected, rel=1e-9)
    assert both.at(0.5 - u / 2) == pytest.approx(-expected, rel=1e-9) or u == 0.0


def test_normal_and_chosen_values_have_their_distributions():
    u = np.linspace(0, 1, 101)
    one = Normal(mean=2.0, sd=0.5, low=1.0, high=4.5)
    wanted = truncnorm.ppf(u, (1.0 - 2.0) / 0.5, (4.5 - 2.0) / 0.5, loc=2.0, scale=0.5)
    np.testing.assert_allclose([one.at(x) for x in u], wanted, rtol=1e-9)
    assert (Normal(mean=1.0, sd=0.1).low, Normal(mean=1.0, sd=0.1).high) == (0.6, 1.4)
    choice = Choice(choices=(3.0, 1.0, 2.0))
    assert [choice.at(x) for x in (0.0, 0.33, 0.34, 0.67, 1.0)] == [3.0, 3.0, 1.0, 2.0, 2.0]


@pytest.mark.parametrize(
    ("file", "out", "message"),
    [
        ("large.toml", "set", "or use --yes to begin"),
        ("none.toml", "set", "No such file"),
        ("set.toml", "nowhere://set", "Protocol not known: nowhere"),
    ],
)
def test_the_command_rejects_in_one_line(tmp_path, monkeypatch, capsys, file, out, message):
    monkeypatch.chdir(written(tmp_path).parent)
    monkeypatch.setattr("torchsoft.cost.LONG", 1.0)  # [s]
    Path("large.toml").write_text(CONFIG.replace("trajectories = 5", "trajectories = 150"))
    assert main(["dataset", "make", file, "--out", out, "--workers", "0"]) == 2
    reported = capsys.readouterr().err
    assert message in reported
    assert reported.count("\n") == 1
    assert not Path("set").exists()
    with pytest.raises(SystemExit):
        main(["dataset", "make", file, "--out", out, "--workers", "-3"])
    assert "--workers: should be from 0 to 1000, not -3" in capsys.readouterr().err
