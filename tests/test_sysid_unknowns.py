"""Unknowns: no search goes beyond what a parameter may be, whether its bounds are given or not."""

from types import SimpleNamespace
from typing import Any

import pytest
from conftest import still

from torchsoft.sysid.estimate import nuisance_unit
from torchsoft.sysid.unknowns import (
    NUISANCES,
    Coordinate,
    Coordinates,
    Prior,
    Unknown,
    in_full,
)

RIG = still()
FRICTION, ALPHA = "laws.steel_on_rubber.friction", "contacts.L.law.friction.alpha"
GIVEN = {
    "materials.rubber.E": 0.75e6, "materials.rubber.nu": 0.45, f"{FRICTION}.mu_s": 0.8,
    f"{FRICTION}.mu_k": 0.7, ALPHA: 2.0,
}  # fmt: skip


def full(name: str) -> str:
    """The full name of a number by a short one, with `__` for a dot."""
    name = name.replace("__", ".")
    return ALPHA if name == "contact.alpha" else RIG.full(name)


def coordinates(*others: dict[str, float], **unknowns: dict[str, Any]) -> Coordinates:
    """Of a recording `one` and more of them, `two` and so on, with other values."""
    tables = {
        full(name): Unknown(**{k: full(x) if k == "ratio_to" else x for k, x in one.items()})
        for name, one in unknowns.items()
    }
    values = [GIVEN | {full(name): x for name, x in one.items()} for one in ({}, *others)]
    recordings: list[Any] = [
        SimpleNamespace(name=name, rig=RIG, parameters=own, start_coordinates=())
        for name, own in zip(("one", "two", "three"), values)
    ]
    return Coordinates(tables, {}, recordings)


def ends(found: Coordinates, name: str) -> tuple[float, float]:
    (one,) = (c for c in found.all if c.name == full(name))
    return one.low, one.high


def test_bounds_that_are_not_given_end_where_the_parameters_do():
    assert ends(coordinates(pad__nu={}), "pad.nu") == (0.045, 0.4999)
    assert ends(coordinates(pad__E={}), "pad.E") == (0.75e5, 0.75e7)
    assert ends(coordinates(contact__mu_k={}), "contact.mu_k")[1] == GIVEN[f"{FRICTION}.mu_s"]
    assert ends(coordinates(contact__mu_s={}), "contact.mu_s")[0] == GIVEN[f"{FRICTION}.mu_k"]
    ratio = coordinates(contact__mu_k={"ratio_to": "contact.mu_s"}, contact__mu_s={})
    assert ends(ratio, "contact.mu_k")[1] == 1.0
    assert ends(ratio, "contact.mu_s")[0] == pytest.approx(0.08)
    assert ends(coordinates(contact__alpha={}), "contact.alpha") == (0.2, 20.0)


@pytest.mark.parametrize(
    ("unknowns", "message"),
    [
        (
            {"pad__nu": {"high": 4.5}},
            r"^unknowns\.materials\.rubber\.nu\.high = 4\.5 is beyond what materials\.rubber\.nu "
            r"may be, from -0\.999 to 0\.4999$",
        ),
        (
            {"pad__nu": {"scale": "linear", "low": -2.0, "high": 0.4}},
            r"unknowns\.materials\.rubber\.nu\.low = -2 is beyond",
        ),
        (
            {"pad__E": {"nominal": 1e20}},
            r"rubber\.E\.nominal = 1e\+20 is beyond",
        ),
        (
            {"contact__mu_k": {"high": 0.9}},
            r"unknowns\..*friction\.mu_k\.high = 0\.9 is beyond",
        ),
        (
            {"contact__mu_k": {"ratio_to": "contact.mu_s", "high": 1.2}},
            r"high = 1\.2 is beyond what laws\..*\.friction\.mu_k / laws\..*\.friction\.mu_s",
        ),
        (
            {"contact__mu_k": {}, "contact__mu_s": {}},
            r"give unknowns\.laws\..*\.friction\.mu_k\.ratio_to = 'laws\..*\.friction\.mu_s'",
        ),
        (
            {"pad__E": {"prior": Prior(median=1e8, sd=1e3)}},
            r"^unknowns\.materials\.rubber\.E\.prior\.median = 1e\+08 is not between",
        ),
        (
            {
                "pad__E": {
                    "low": 8e4,
                    "high": 1.4e6,
                    "prior": Prior(median=1.5e6, sd=0.1, kind="log-normal"),
                }
            },
            r"prior\.median = 1\.5e\+06 is not between low = 80000 and high = 1\.4e\+06$",
        ),
        (
            {"pad__E": {"low": 1e6, "high": 2e6}},
            r"rubber\.E\.nominal = 750000 is not between",
        ),
        ({"pad__E": {"low": 2e6, "high": 1e6}}, "low = 2000000.0 must be below"),
        ({"pad__E": {"scale": "linear"}}, "needs `low` and `high`"),
        ({"pad__E": {"nominal": -1.0}}, "needs nominal > 0"),
        ({"contact__mu_k": {"ratio_to": "friction"}}, "ratio_to = 'friction'"),
        ({"pad__Young": {}}, r"^unknowns: `pad\.Young` cannot be identified; known: .*materials\."),
    ],
)
def test_bounds_beyond_are_refused_by_their_field(unknowns, message):
    with pytest.raises(ValueError, match=message):
        coordinates(**unknowns)


@pytest.mark.parametrize(
    "others", [({"contact.mu_s": 0.3},), ({}, {"contact.mu_s": 0.3}), ({"contact.mu_s": 0.3}, {})]
)
def test_bounds_hold_in_every_recording(others):
    assert ends(coordinates(*others, contact__mu_k={"nominal": 0.2}), "contact.mu_k") == (0.02, 0.3)
    for field, value in (("high", 0.5), ("nominal", 0.5)):
        with pytest.raises(
            ValueError,
            match=f"mu_k.{field} = 0.5 is beyond what .* may be in all recordings, from 0 to 0.3",
        ):
            coordinates(*others, contact__mu_k={"nominal": 0.2, field: value})


def test_a_search_starts_where_all_rigs_are():
    assert ends(coordinates({}, pad__E={}), "pad.E") == (0.75e5, 0.75e7)
    for others, second in ((({"pad.E": 1e6},), "two"), (({}, {"pad.E": 1e6}), "three")):
        with pytest.raises(
            ValueError,
            match=f"`one` and 1e\\+06 in that of `{second}`: say by `nominal` where the search",
        ):
            coordinates(*others, pad__E={})
        assert len(coordinates(*others, pad__E={"nominal": 1e6})) == 1


def test_friction_coefficients_may_both_be_free_where_they_cannot_cross():
    found = coordinates(contact__mu_k={"high": 0.75}, contact__mu_s={"low": 0.75})
    assert (ends(found, "contact.mu_k")[1], ends(found, "contact.mu_s")[0]) == (0.75, 0.75)


def test_a_name_means_one_thing_and_is_given_once():
    other: Any = SimpleNamespace(short={"theta": "theta_ball"})
    assert in_full([RIG, other], {"F_x": 1, "theta_C": 2}) == {"effort_x": 1, "theta_C": 2}
    with pytest.raises(ValueError, match="`theta_C` and `theta` are one, given twice"):
        in_full([RIG], {"theta": 1, "theta_C": 2})
    with pytest.raises(
        ValueError, match="`theta` is short for theta_C and theta_ball in different"
    ):
        in_full([RIG, other], {"theta": 1})


def test_a_tied_ratio_leaves_its_base_free():
    """The file's own number of a tied parameter is no limit of what it is tied to."""
    for more in ({}, {"nominal": 0.9}):
        tie = {"ratio_to": "contact.mu_s", "fixed": True, **more}
        found = coordinates(contact__mu_k=tie, contact__mu_s={"low": 0.1, "high": 2.0})
        assert ends(found, "contact.mu_s") == (0.1, 2.0)
        values = found.values(found.start, "one", GIVEN)
        assert values[full("contact.mu_k")] == pytest.approx(more.get("nominal", 0.7 / 0.8) * 0.8)
    found = coordinates(contact__mu_s={"ratio_to": "contact.mu_k"}, contact__mu_k={})
    assert ends(found, "contact.mu_s")[0] == 1.0
    assert ends(found, "contact.mu_k") == pytest.approx((0.07, 7.0))
    known = {"ratio_to": "contact.mu_s", "fixed": True, "nominal": 0.5}  # of a number that is known
    assert ends(coordinates(contact__mu_k=known), "contact.mu_k")[1] == 1.0


def test_two_ratios_to_one_number_are_compared_as_ratios():
    def tied(mu_k: float, mu_s: float) -> Coordinates:
        both = {"ratio_to": "contact.alpha", "fixed": True}
        mu = {"contact__mu_k": both | {"nominal": mu_k}, "contact__mu_s": both | {"nominal": mu_s}}
        return coordinates(**mu, contact__alpha={})

    assert len(tied(0.3, 0.4)) == 3
    with pytest.raises(ValueError, match=r"mu_k must not exceed .*, but may be up to 0\.4 "):
        tied(0.4, 0.3)


def test_a_tie_that_may_cross_a_known_number_is_refused():
    tie = {"ratio_to": "contact.alpha", "fixed": True, "nominal": 0.3}
    with pytest.raises(
        ValueError, match=r"mu_k must not exceed .*, but may be up to 6 .* to 0\.8: give"
    ):
        coordinates(contact__mu_k=tie, contact__alpha={})


def test_every_fault_of_a_sensor_has_a_unit():
    problem: Any = SimpleNamespace(unit=lambda channel: "rad")
    found = {
        kind: nuisance_unit(Coordinate("theta", kind, None, 0.0, -1.0, 1.0), problem)
        for kind in NUISANCES
    }
    assert found == {
        "bias": "rad", "delay": "s", "gain": "1", "drift": "rad/s", "misalignment": "rad",
        "inertia": "kg", "clock": "1", "lag": "s", "backlash": "rad",
    }  # fmt: skip
