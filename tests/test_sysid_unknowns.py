"""Unknowns: no search goes beyond what a parameter may be, whether its bounds are given or not."""

import tomllib
from types import SimpleNamespace

import pytest
from conftest import still

from torchsoft.sysid.unknowns import Coordinates, Prior, Unknown, in_full

RIG = still()
FRICTION, ALPHA = "laws.steel_on_rubber.friction", "contacts.L.law.friction.alpha"
TIED = 'mu_k.ratio_to = "mu_s"\nmu_k.fixed = true'
GIVEN = {
    "materials.rubber.E": 0.75e6, "materials.rubber.nu": 0.45, f"{FRICTION}.mu_s": 0.8,
    f"{FRICTION}.mu_k": 0.7, ALPHA: 2.0,
}  # fmt: skip


def full(name: str) -> str:
    """The full name of a parameter by a short one: E, mu_s, alpha."""
    kind = "pad" if name in ("E", "nu", "Young") else "contact"
    return ALPHA if name == "alpha" else RIG.full(f"{kind}.{name}")


def coordinates(unknowns: str, *others: dict[str, float]) -> Coordinates:
    """Of a recording `one` and more of them, `two` and so on, with other values."""
    tables = {
        full(name): Unknown(**{k: full(x) if k == "ratio_to" else x for k, x in one.items()})
        for name, one in tomllib.loads(unknowns).items()
    }
    recordings = [
        SimpleNamespace(
            name=name, rig=RIG, start_coordinates=(),
            parameters=GIVEN | {full(key): x for key, x in one.items()},
        )
        for name, one in zip(("one", "two", "three"), ({}, *others))
    ]  # fmt: skip
    return Coordinates(tables, {}, recordings)


@pytest.mark.parametrize(
    ("unknowns", "name", "ends"),
    [
        ("nu = {}", "nu", (0.045, 0.4999)),
        ("E = {}", "E", (0.75e5, 0.75e7)),
        ("alpha = {}", "alpha", (0.2, 20.0)),
        ("mu_k = {}", "mu_k", (0.07, 0.8)),
        ("mu_s = {}", "mu_s", (0.7, 8.0)),
        ('mu_k.ratio_to = "mu_s"\nmu_s = {}', "mu_k", (0.7 / 8, 1.0)),
        ('mu_k.ratio_to = "mu_s"\nmu_s = {}', "mu_s", (0.08, 8.0)),
        ('mu_s.ratio_to = "mu_k"\nmu_k = {}', "mu_s", (1.0, 80 / 7)),
        # coefficients that cannot cross may both be free
        ("mu_k.high = 0.75\nmu_s.low = 0.75", "mu_k", (0.07, 0.75)),
        # the file's value of a tied parameter does not bound what it is tied to
        (f"{TIED}\nmu_s = {{low = 0.1, high = 2.0}}", "mu_s", (0.1, 2.0)),
        (f"{TIED}\nmu_k.nominal = 0.5", "mu_k", (0.05, 1.0)),
    ],
)
def test_bounds_that_are_not_given_end_where_the_parameters_do(unknowns, name, ends):
    found = coordinates(unknowns)
    (one,) = (c for c in found.all if c.name == full(name))
    assert (one.low, one.high) == pytest.approx(ends)


@pytest.mark.parametrize(("nominal", "ratio"), [("", 0.7 / 0.8), ("mu_k.nominal = 0.9", 0.9)])
def test_a_tied_parameter_follows_its_base(nominal, ratio):
    found = coordinates(f"{TIED}\n{nominal}\nmu_s = {{low = 0.1, high = 2.0}}")
    values = found.values(found.start, "one", GIVEN)
    assert values[full("mu_k")] == pytest.approx(ratio * 0.8)


TO_ALPHA = 'mu_k.ratio_to = "alpha"\nmu_k.fixed = true\nalpha = {}'
BOTH = f'{TO_ALPHA}\nmu_k.nominal = 0.4\nmu_s = {{ratio_to = "alpha", fixed = true, nominal = 0.3}}'


@pytest.mark.parametrize(
    ("unknowns", "message"),
    [
        ("nu.high = 4.5", r"^unknowns\.mat.*\.nu\.high = 4\.5 is beyond .* to 0\.4999$"),
        ("E.nominal = 1e20", r"rubber\.E\.nominal = 1e\+20 is beyond"),
        ("mu_k.high = 0.9", r"friction\.mu_k\.high = 0\.9 is beyond"),
        ('mu_k = {ratio_to = "mu_s", high = 1.2}', r"high = 1\.2 is beyond .*mu_k / .*mu_s may"),
        ("mu_k = {}\nmu_s = {}", r"give unknowns\..*mu_k\.ratio_to = '.*mu_s'"),
        ("E.prior = {median = 1e8, sd = 1e3}", r"prior\.median = 1e\+08 is not between"),
        ("E = {low = 1e6, high = 2e6}", r"rubber\.E\.nominal = 750000 is not between"),
        ('mu_k.ratio_to = "friction"', "ratio_to = .*friction' is not another parameter"),
        ('mu_k.ratio_to = "mu_s"\nmu_s.ratio_to = "mu_k"', "is a ratio itself"),
        ("Young = {}", r"^unknowns: `pad\.Young` cannot be identified; known: .*materials\."),
        # two ratios to one parameter are compared as ratios, one with a known value as a value
        (BOTH, r"mu_k must not exceed .*, but may be up to 0\.4 "),
        (
            f"{TO_ALPHA}\nmu_k.nominal = 0.3",
            r"mu_k must not exceed .*, but may be up to 6 .* to 0\.8: give",
        ),
    ],
)
def test_unknowns_that_may_leave_the_possible_are_rejected_by_their_field(unknowns, message):
    with pytest.raises(ValueError, match=message):
        coordinates(unknowns)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"low": 2e6, "high": 1e6}, "low = 2000000.0 must be below"),
        ({"scale": "linear"}, "needs `low` and `high`"),
        ({"nominal": -1.0}, "needs nominal > 0"),
        ({"fixed": True, "prior": Prior(median=1.0, sd=1.0)}, "a fixed unknown needs no prior"),
        (None, "log-normal prior needs median > 0"),
    ],
)
def test_tables_that_contradict_themselves_are_rejected(table, message):
    with pytest.raises(ValueError, match=message):
        Prior(median=-1.0, sd=1.0, kind="log-normal") if table is None else Unknown(**table)


@pytest.mark.parametrize("others", [({"mu_s": 0.3},), ({}, {"mu_s": 0.3}), ({"mu_s": 0.3}, {})])
def test_bounds_hold_in_every_recording(others):
    assert coordinates("mu_k.nominal = 0.2", *others).all[0].high == 0.3
    with pytest.raises(ValueError, match=r"mu_k\.high = 0\.5 is .* all recordings, from 0 to 0\.3"):
        coordinates("mu_k = {nominal = 0.2, high = 0.5}", *others)


@pytest.mark.parametrize(("others", "name"), [(({"E": 1e6},), "two"), (({}, {"E": 1e6}), "three")])
def test_a_search_starts_where_all_rigs_are_or_where_nominal_states(others, name):
    with pytest.raises(
        ValueError, match=rf"`one` and 1e\+06 in that of `{name}`: set by `nominal`"
    ):
        coordinates("E = {}", *others)
    assert len(coordinates("E.nominal = 1e6", *others)) == 1


def test_a_name_means_one_thing_and_is_given_once():
    other = SimpleNamespace(short={"theta": "theta_ball"})
    assert in_full([RIG, other], {"F_x": 1, "theta_C": 2}) == {"effort_x": 1, "theta_C": 2}
    with pytest.raises(ValueError, match="`theta_C` and `theta` are one, given twice"):
        in_full([RIG], {"theta": 1, "theta_C": 2})
    with pytest.raises(ValueError, match="`theta` is short for theta_C and theta_ball in"):
        in_full([RIG, other], {"theta": 1})
