"""A fitted material as files: a table in TOML, a summary of how it was made, a figure."""

import json
import re
from collections.abc import Mapping
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path

from torchsoft.files import finite, replacing, write_json
from torchsoft.materials.figure import fitted
from torchsoft.materials.fit import Fit
from torchsoft.plot.figures import save

UNITS = {"E": "Pa", "moduli": "Pa", "J": "1", "tau": "s", "tau_instant": "s", "nu": "1", "rho": "kg/m3", "depth": "m"}

FILES = ("material.toml", "summary.json", "fit.png")
"""What is written."""


def write(fit: Fit, folder: Path, assumed: Mapping[str, float], options: Mapping[str, object]) -> None:
    """Write `FILES`. `assumed` are nu, rho and depth, which a test in one dimension does not tell; `options` are those of
    the command. Each file appears whole or not at all."""
    with replacing(folder / "material.toml") as partial:
        partial.write_text(toml(fit, assumed), encoding="utf-8")
    write_json(folder / "summary.json", summary(fit, assumed, options))
    save(fitted(fit), folder / "fit.png")


def toml(fit: Fit, assumed: Mapping[str, float]) -> str:
    """The material as a table with the names of the constructor's arguments, in comments what must be known of it."""
    name = fit.measured.path.stem
    key = name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name)
    rows = [f"[materials.{key}]", f'kind = "{fit.kind}"']
    for argument, value in fit.table().items():
        note = ", small: the instantaneous spring's" if argument == "tau_instant" else ""
        rows.append(f"{argument} = {value!r}  # [{UNITS[argument]}]{note}")
    rows += [f"{name} = {value!r}  # [{UNITS[name]}] not of this test: assumed" for name, value in assumed.items()]
    head = [
        f"Fitted to {fit.measured.path.name} ({fit.measured.test} test) by torchsoft {version('torchsoft')}.",
        *fit.notices,
    ]
    return "\n".join([*(f"# {' '.join(text.split())}" for text in head), "", *rows]) + "\n"


def summary(fit: Fit, assumed: Mapping[str, float], options: Mapping[str, object]) -> dict[str, object]:
    """What was found, from what, and how, in SI units."""
    m = fit.measured
    return {
        "made_by": {"torchsoft": version("torchsoft"), "command": "torchsoft material fit", "options": dict(options)},
        "data": {
            "file": m.path.name, "sha256": sha256(m.path.read_bytes()).hexdigest(), "rows": len(m.t), "test": m.test,
            "resolved_s": list(m.window), "largest_strain": None if m.per_load else float(abs(m.strain).max()),
        },
        "method": "nonnegative least squares on a logarithmic grid of times, then least squares in strengths and times "
                  "together; the number of terms by Schwarz's criterion (BIC)",
        "kind": fit.kind,
        "coefficients": {name: finite({"value": x, "sd": fit.sd[name]}) for name, x in fit.values.items()},
        "assumed": dict(assumed),
        "criterion": {str(count): score for count, score in fit.scores.items()},
        "residual_rms_over_largest": fit.rms,
        "residual_correlation": fit.correlation,
        "notices": list(fit.notices),
    }  # fmt: skip


def printed(fit: Fit) -> str:
    """The coefficients with 95 % intervals, and the notices."""
    units = {"E": "Pa", "t": "s", "J": "1"}
    rows = [
        f"{name:<7}{value:<12.5g}{units[name[0]]:<3}+- {196 * fit.sd[name] / value:.2g} %"
        for name, value in fit.values.items()
    ]
    head = (
        f"{fit.measured.path.name}: {fit.measured.test} test, {fit.kind} of {fit.terms} terms, residual {fit.rms:.2%}"
    )
    return "\n".join([head, *rows, *(f"note: {notice}" for notice in fit.notices)])
