"""Checks of recorded motions, and of motions that outputs do not show."""

from collections.abc import Iterator

from torchsoft.diagnostic import Diagnostic, Severity
from torchsoft.physics.motion import Sampled
from torchsoft.rigs.built import BuiltRig
from torchsoft.rigs.motion import CsvTable, quantum

LONGER = 100.0
"""Duration of a recorded motion over that of the run from which its unit is doubted."""

OUTPUTS_PER_PERIOD = 4
"""Fewest outputs in a period of a motion."""


def recordings(ready: BuiltRig) -> Iterator[Diagnostic]:
    """Findings on recorded motions that do not cover the run, and on waves too fast for the
    outputs."""
    outputs = ready.file.outputs
    for name, motion in ready.file.motion.items():
        one, fastest = ready.rig.reference[name], motion.fastest()
        if isinstance(motion, CsvTable) and isinstance(one, Sampled):
            for severity, sentence in recorded(one, outputs.duration, ready.file.unit(name)):
                yield Diagnostic(severity, f"motion.{name}.file", f"{motion.file} {sentence}")
        if fastest * outputs.interval * OUTPUTS_PER_PERIOD > 1:
            yield Diagnostic(
                "warning", "outputs.interval",
                f"outputs every {outputs.interval:g} s do not show motion.{name}, which goes up to "
                f"{fastest:g} Hz; take {1 / (OUTPUTS_PER_PERIOD * fastest):.2g} s or less",
            )  # fmt: skip


def recorded(one: Sampled, end: float, unit: str) -> Iterator[tuple[Severity, str]]:
    """Findings on a recorded motion, in a unit, of a run until `end` [s]."""
    first, last = float(one.times[0]), float(one.times[-1])
    if first >= end:
        yield (
            "error",
            f"begins at {first:g} s, and the run ends at {end:g} s: where its times are of a "
            "clock, set from_first = true",
        )
    elif last > LONGER * end:
        yield (
            "warning",
            f"lasts {last:g} s, and the run shows {end:g} s of it: are its times in milliseconds?",
        )
    elif first > 0:
        yield "warning", f"begins at {first:g} s; until then its first value holds"
    if step := quantum(one.values.detach().numpy()):
        each = float(one.times.diff().median())
        yield (
            "warning",
            f"is in steps of {step:.3g} {unit}, as of an encoder: rates of the set-point jump by "
            f"{step / each:.2g} {unit}/s from row to row; smooth the column",
        )
    if last < end * (1 - 1e-9):
        yield (
            "error",
            f"ends at {last:g} s, but the run lasts until {end:g} s: nothing says what is wanted "
            f"then; shorten outputs.duration to {last:g}, or record longer",
        )
