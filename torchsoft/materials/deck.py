"""Prony series of Abaqus input decks.

`*ELASTIC` or a neo-Hookean or Mooney-Rivlin `*HYPERELASTIC` gives the elasticity of a material,
`*VISCOELASTIC, TIME=PRONY` rows of g_i, k_i, tau_i: G(t) = G_0 (1 - sum g_i (1 - exp(-t / tau_i))).
A deck has no units: the one of its stresses is asked for, its times are seconds.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchsoft.files import check_file
from torchsoft.materials.measured import Array, instant_time
from torchsoft.physics.material import Prony
from torchsoft.tables import line

LARGEST = 2e9
"""Size [B] of a deck at the most."""

INCOMPRESSIBLE = 0.4995
"""Poisson's ratio that stands for a material that a deck calls incompressible."""

OF_MATERIALS = {
    "DAMPING", "DENSITY", "DEPVAR", "ELASTIC", "EXPANSION", "HYPERELASTIC", "TRS",
    "USER MATERIAL", "VISCOELASTIC",
}  # fmt: skip
"""Keywords that may follow *MATERIAL; any other ends it."""

Keyword = tuple[str, dict[str, str], list[list[str]]]
"""Name, parameters and rows of data of a keyword."""


@dataclass(frozen=True)
class Deck:
    """A material of a deck: `values` of the relaxed E [Pa], E_i [Pa], tau_i [s] and nu."""

    path: Path
    name: str
    values: Mapping[str, float]
    notices: tuple[str, ...]
    kind: str = "prony"

    @property
    def terms(self) -> int:
        return (len(self.values) - 2) // 2

    def listed(self, symbol: str) -> list[float]:
        """The values of a symbol, by term."""
        return [self.values[f"{symbol}_{k}"] for k in range(1, self.terms + 1)]

    def table(self) -> dict[str, Any]:
        """The arguments of the material's constructor that the deck tells, and tau_instant."""
        tau = self.listed("tau")
        return {
            "E": self.values["E"], "moduli": self.listed("E"), "tau": tau,
            "tau_instant": instant_time(tau), "nu": self.values["nu"],
        }  # fmt: skip

    def material(self, *, rho: float, depth: float) -> Prony:
        """The material, with stated values where a deck has none."""
        return Prony(**self.table(), rho=rho, depth=depth)

    def relaxation(self, t: Array) -> Array:
        """The stress per held strain [Pa] (n,) at times t (n,) [s]."""
        E, tau = np.array(self.listed("E")), np.array(self.listed("tau"))
        return self.values["E"] + np.exp(-t[:, None] / tau) @ E


def read_deck(path: str | Path, *, unit: float, name: str | None = None) -> Deck:
    """The material `name` of a deck, or its only one with a Prony series; `unit` is that of its
    stresses [Pa]. Raises `ValueError` naming file and keyword, and `OSError`."""
    path = Path(path)
    found = {
        one: keywords
        for one, keywords in materials(path).items()
        if any(keyword == "VISCOELASTIC" for keyword, _, _ in keywords)
    }
    if name is None and len(found) != 1:
        raise ValueError(
            f"{path} has {len(found)} materials with *VISCOELASTIC"
            f"{', say which: ' + ', '.join(found) if found else ''}"
        )
    name = next(iter(found)) if name is None else name.upper()
    if name not in found:
        raise ValueError(f"{path} has no *VISCOELASTIC material {name}; it has {', '.join(found)}")
    return prony(path, name, found[name], unit)


def prony(path: Path, name: str, keywords: list[Keyword], unit: float) -> Deck:
    """The series of a material's keywords."""
    by_name = {keyword: (options, rows) for keyword, options, rows in keywords}
    options, rows = by_name["VISCOELASTIC"]
    if options.get("TIME") != "PRONY":
        raise ValueError(
            f"{path}, material {name}: *VISCOELASTIC must say TIME=PRONY; a table of a test goes "
            "into a file of its own"
        )
    series = [numbers(path, name, row, 3) for row in rows]
    if not series:
        raise ValueError(f"{path}, material {name}: *VISCOELASTIC has no rows")
    g, k, tau = np.array(sorted(series, key=lambda row: row[2])).T
    G, nu, stated = elasticity(path, name, by_name)
    if not ((g > 0).all() and g.sum() < 1 and (tau > 0).all()):
        raise ValueError(
            f"{path}, material {name}: every g_i and tau_i must be above zero, and the g_i below "
            f"one in sum, which is {g.sum():.4g}"
        )
    meant = {"INSTANTANEOUS": "instantaneous", "": "of the long term, since MODULI is not said"}
    notices = [f"the deck's elasticity is {meant.get(stated, 'of the long term')}"]
    E = 2 * (1 + nu) * G * unit
    instant = E if stated == "INSTANTANEOUS" else E / (1 - g.sum())
    if not np.array_equal(g, k):
        bulk = np.full(2, 2 * G * (1 + nu) / (3 * (1 - 2 * nu)))
        shear = np.array((1.0, 1 - g.sum())) * instant / (2 * (1 + nu) * unit)
        bulk *= np.array((1.0, 1 - k.sum())) / (1 if stated == "INSTANTANEOUS" else 1 - k.sum())
        exact = 9 * bulk * shear / (3 * bulk + shear) * unit
        off = exact[0] / exact[1] * (1 - g.sum()) - 1
        notices.append(
            "k_i are not g_i, and pads have one Poisson's ratio at all times: E relaxes as G does "
            f"here, from first to last {off:+.1%} beside the deck's"
        )
    numbered = range(1, len(g) + 1)
    values = {
        "E": float(instant * (1 - g.sum())),
        **{f"E_{i}": float(instant * x) for i, x in zip(numbered, g)},
        **{f"tau_{i}": float(x) for i, x in zip(numbered, tau)},
        "nu": nu,
    }
    return Deck(path, name, values, tuple(notices))


def elasticity(
    path: Path, name: str, by_name: Mapping[str, tuple[dict[str, str], list[list[str]]]]
) -> tuple[float, float, str]:
    """Shear modulus in the deck's unit, Poisson's ratio, and which moduli they are."""
    if "ELASTIC" in by_name:
        options, rows = by_name["ELASTIC"]
        if options.get("TYPE", "ISOTROPIC") != "ISOTROPIC" or len(rows) != 1:
            raise ValueError(f"{path}, material {name}: *ELASTIC must be isotropic, in one row")
        E, nu = numbers(path, name, rows[0], 2)
        return E / (2 * (1 + nu)), min(nu, INCOMPRESSIBLE), options.get("MODULI", "")
    if "HYPERELASTIC" in by_name:
        options, rows = by_name["HYPERELASTIC"]
        mooney = "MOONEY-RIVLIN" in options
        if not (mooney or "NEO HOOKE" in options) or len(rows) != 1:
            raise ValueError(
                f"{path}, material {name}: *HYPERELASTIC must be NEO HOOKE or MOONEY-RIVLIN, with "
                "one row of coefficients"
            )
        *C, D = numbers(path, name, [*rows[0], "0"][: 3 if mooney else 2], 3 if mooney else 2)
        G = 2 * math.fsum(C)
        K = 2 / D if D > 0 else math.inf
        nu = 0.5 if math.isinf(K) else (3 * K - 2 * G) / (2 * (3 * K + G))
        return G, min(nu, INCOMPRESSIBLE), options.get("MODULI", "")
    raise ValueError(f"{path}, material {name}: there is no *ELASTIC and no *HYPERELASTIC")


def numbers(path: Path, name: str, cells: list[str], count: int) -> list[float]:
    """The first `count` cells as finite numbers; an empty one is zero."""
    try:
        out = [float(cell.replace("D", "E") or 0) for cell in cells[:count]]
    except ValueError:
        out = []
    if len(out) != count or not all(math.isfinite(x) for x in out):
        raise ValueError(
            f"{path}, material {name}: `{line(', '.join(cells), 60)}` should be {count} numbers"
        )
    return out


def materials(path: Path) -> dict[str, list[Keyword]]:
    """The keywords of every material of a deck, by its name."""
    check_file(path, LARGEST)
    out: dict[str, list[Keyword]] = {}
    rows: list[list[str]] | None = None
    here: list[Keyword] | None = None
    for text in path.read_text(encoding="utf-8", errors="replace").upper().splitlines():
        text = text.strip()
        if text.startswith("**") or not text:
            continue
        cells = [cell.strip() for cell in text.lstrip("*").split(",")]
        if not text.startswith("*"):
            if rows is not None:
                rows.append(cells)
            continue
        rows, (keyword, *given) = [], cells
        options = {one.partition("=")[0].strip(): one.partition("=")[2].strip() for one in given}
        if keyword == "MATERIAL":
            here = out.setdefault(options.get("NAME", ""), [])
        elif here is not None and keyword in OF_MATERIALS:
            here.append((keyword, options, rows))
        else:
            here = None
    return out
