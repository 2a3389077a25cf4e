"""Parameters: every impossible value is refused by name, sources are kept, files and overrides
round-trip."""

import math
import warnings
from typing import Any

import pytest
from conftest import PAPER, still
from hypothesis import given
from hypothesis import strategies as st

from torchsoft.tables import InvalidTable

NAN, INF = math.nan, math.inf

NOT_NEGATIVE = [
    "contact.R_n", "contact.R_t", "contact.mu_s", "contact.mu_k", "control.K_81",
    "control.R_80", "control.K_98", "control.R_99", "scenario.gravity", "scenario.hold_time",
    "scenario.rest_time",
]  # fmt: skip
ANY_SIGN = ["pad.nu", "bracket.cm_height", "scenario.x_C0", "scenario.travel"]
NUMBERS = [name for name, row in PAPER.table().items() if isinstance(row["value"], float)]
POSITIVE = [name for name in NUMBERS if name not in (*NOT_NEGATIVE, *ANY_SIGN)]


def refusal(values: dict[str, Any]) -> str:
    """The message with which these values are refused."""
    with pytest.raises(ValueError, match=r".") as error:
        PAPER.override(values)
    assert isinstance(error.value, InvalidTable)
    assert "\n" not in str(error.value)
    return str(error.value)


BAD: list[tuple[list[str], list[object], str]] = [
    (NUMBERS, [True, "1_0", "0.1", None, [1.0]], " should be a valid number"),
    (NUMBERS, [1e300, -1e300, NAN, INF, -INF], ""),
    ([*POSITIVE, *NOT_NEGATIVE], [-1e-3], ""), (POSITIVE, [0.0], ""),
    (["pad.nu"], [0.5, 0.6, 1.0, -1.0, -2.0], ""),
    (["pad.elements_x"], [3, 120.5], ""), (["pad.elements_y"], [0], ""),
    (["pad.enclosed"], ["perhaps"], ""), (["pad.fidelity"], ["rigid"], ""),
    (["contact.friction"], ["stribeck"], ""),
]  # fmt: skip
"""Fields, values that none of them takes, and what is said after the field's name."""


@pytest.mark.parametrize(("names", "values", "words"), BAD)
def test_impossible_values_are_refused_by_name(names, values, words):
    for name in names:
        for value in values:
            assert f"{name}{words}" in refusal({name: value}), value


def test_a_mesh_that_would_not_fit_in_memory_is_refused():
    assert "pad.elements_x = 40000 by elements_y = 4 take about" in refusal(
        {"pad.elements_x": 40_000}
    )
    assert PAPER.override({"pad.elements_x": 1000}).pad.memory < 1.0


def test_the_bounds_of_a_parameter_can_be_asked_for():
    model = still()
    for name in NAMES:
        declared = model.quantity(name)
        low, high = declared.low, declared.high
        assert low < PAPER.table()[name]["value"] < high < INF
        check(name, PAPER.table()[name]["value"], "here")
        for value in (low - 1.0, 1.1 * high):
            with pytest.raises(InvalidTable, match="here should be"):
                check(name, value, "here")


def test_kinetic_friction_above_static_is_refused():
    message = refusal({"contact.mu_k": 0.9})
    assert "contact" in message
    assert "mu_k = 0.9 > mu_s = 0.8" in message
    assert PAPER.override({"contact.mu_k": 0.8}).contact.mu_k == 0.8  # equal is Coulomb's law


def test_a_tangential_spring_without_a_dashpot_is_refused():
    for friction in ("smooth", "coulomb"):
        assert "R_t must be positive" in refusal({"contact.friction": friction, "contact.R_t": 0.0})


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ({"disc.radius": 18.6e-3}, "apart"),
        ({"scenario.y_Br_grasp": 45.4e-3}, "give way"),  # through the pads
        ({"pad.height": 1e-3, "disc.radius": 22.9e-3}, "give way"),
    ],
)
def test_a_disc_that_does_not_fit_is_refused(values, word):
    message = refusal(values)
    assert "the disc does not fit" in message
    assert word in message
    assert "scenario.y_Br_grasp" in message
    assert "disc" in message
    assert "radius" in message


@pytest.mark.parametrize(
    "values",
    [
        {"scenario.travel": 60e-3},
        {"scenario.x_C0": 5e-3, "scenario.travel": 20e-3},
        {
            "scenario.travel": -56e-3
        },  # the centre stays on the pad, the contact's half-width of 5.4 mm does not
        {"pad.length": 0.06},
    ],
)
def test_a_trajectory_that_leaves_the_pad_is_refused(values):
    message = refusal(values)
    assert "leaves the pad" in message
    for name in ("scenario.x_C0", "scenario.travel", "pad.length"):
        assert name in message


def test_a_trajectory_that_just_stays_on_the_pad_is_accepted():
    assert PAPER.override({"scenario.travel": -54e-3}).scenario.travel == -54e-3


# the warning
# ----------------------------------------------------------------------


def test_a_slip_law_that_is_not_single_valued_is_warned_about():
    # (mu_s - mu_k) F_N / v_s = 0.1 * 10 N / 5 mm/s = 200 N.s/m against R_t
    with pytest.warns(UserWarning, match=r"not single-valued.*contact\.v_s"):
        PAPER.override({"contact.R_t": 199.0})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        PAPER.override({"contact.R_t": 201.0})
        PAPER.override({"contact.R_t": 199.0, "contact.v_s": 5.1e-3})
        PAPER.override({"contact.R_t": 199.0, "contact.mu_k": 0.8})
        PAPER.override({"contact.friction": "coulomb", "contact.R_t": 10.0})  # not its law


def test_default_and_paper_like_sets_do_not_warn():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert PAPER.contact.K_t == 1.2e5
        assert Parameters.paper_like().contact.K_t == 100.0


# override and table
# ----------------------------------------------------------------------


@pytest.mark.parametrize("name", ["pad.Young", "pad", "E", "pad.E.x", ""])
def test_override_refuses_an_unknown_name(name):
    with pytest.raises(ValueError, match=r"is not a parameter; known names: .*pad\.E") as error:
        PAPER.override({name: 1.0})
    assert f"`{name}`" in str(error.value)


def test_table_tells_published_from_assumed():
    table = PAPER.table()
    published = {name for name, row in table.items() if row["source"] == "published"}
    assert published == {
        "pad.length", "pad.height", "disc.radius", "control.K_81", "control.R_80", "control.K_98",
        "control.R_99", "control.senses", "scenario.x_C0", "scenario.y_Br_grasp",
        "scenario.grasp_time", "scenario.travel", "scenario.roll_time", "scenario.hold_time",
        "scenario.rest_time",
    }  # fmt: skip
    assert {row["source"] for row in table.values()} == {"published", "assumed"}
    assert table["disc.radius"] == {
        "value": 19.37e-3, "unit": "m", "source": "published", "meaning": "radius of the disc",
    }  # fmt: skip
    assert all(row["unit"] and row["meaning"] for row in table.values())


def test_published_numbers():
    p = PAPER
    assert p.compression == pytest.approx(1.5e-3, abs=1e-15)
    assert p.scenario.duration == 30.0


CHANGES = st.fixed_dictionaries(
    {},
    optional={
        "pad.E": st.floats(1e4, 1e9),
        "pad.nu": st.floats(-0.9, 0.4999),
        "pad.tau": st.floats(1e-4, 1.0),
        "pad.elements_x": st.integers(4, 1000),
        "pad.enclosed": st.booleans(),
        "pad.fidelity": st.sampled_from(["massless", "inertial"]),
        "contact.K_n": st.floats(1e-3, 1e9),
        "contact.v_s": st.floats(0.1, 10.0),
        "scenario.travel": st.floats(-0.05, 0.05),
        "scenario.gravity": st.floats(0.0, 30.0),
    },
)


def toml(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else repr(value)


@given(changes=CHANGES)
def test_overrides_arrive_in_the_table_and_undo(changes):
    changed = PAPER.override(changes)
    table, default = changed.table(), PAPER.table()
    for name, row in table.items():
        assert row["value"] == changes.get(name, default[name]["value"])
        assert row["source"] == (
            default[name]["source"] if row["value"] == default[name]["value"] else "assumed"
        )
    assert changed.override({name: default[name]["value"] for name in changes}) == PAPER
    assert PAPER.override({name: row["value"] for name, row in table.items()}) == changed


@given(changes=CHANGES)
def test_a_file_holds_the_same_parameters(changes, tmp_path_factory):
    changed = PAPER.override(changes)
    lines = [f"{name} = {toml(row['value'])}" for name, row in changed.table().items()]
    path = tmp_path_factory.getbasetemp() / "parameters.toml"
    path.write_text("\n".join(lines))
    assert Parameters.from_toml(path) == changed


# files
# ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[pad]\nYoung = 1e6", "pad: `Young` is not known here"),
        ("E = 1e6", "`E` is not known here"),
        ("[pad]\nnu = 0.5", "pad.nu"),
        ("[scenario]\ntravel = 0.1", "scenario.travel"),
        ("[pad]\nE = soft", "line 2"),
    ],
)
def test_a_file_that_is_wrong_is_refused_with_its_name(text, named, tmp_path):
    path = tmp_path / "soft.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"soft\.toml") as error:
        Parameters.from_toml(path)
    assert named in str(error.value).removeprefix(str(path))


def test_an_integer_that_no_float_holds_is_refused():
    assert "pad: length should be a valid number" in refusal({"pad.length": 10**400})
