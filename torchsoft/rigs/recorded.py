"""Checks of recorded motions, and of motions that outputs do not show."""

from collections.abc import Iterator

from torchsoft.diagnostic import Diagnostic
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
    file, end = ready.file, ready.file.outputs.duration
    interval = file.outputs.interval
    for name, motion in file.motion.items():
        one, fastest = ready.rig.reference[name], motion.fastest()
        if isinstance(motion, CsvTable) and isinstance(one, Sampled):
            first, last = float(one.times[0]), float(one.times[-1])
            if first >= end:
                yield Diagnostic(
                    "error", f"motion.{name}.file",
                    f"{motion.file} begins at {first:g} s, and the run ends at "
                    f"{end:g} s: where its times are of a clock, say "
                    "from_first = true",
                )  # fmt: skip
            elif last > LONGER * end:
                yield Diagnostic(
                    "warning", f"motion.{name}.file",
                    f"{motion.file} lasts {last:g} s, and the run shows "
                    f"{end:g} s of it: are its times in milliseconds?",
                )  # fmt: skip
            elif first > 0:
                sentence = f"{motion.file} begins at {first:g} s; until then its first value holds"
                yield Diagnostic("warning", f"motion.{name}.file", sentence)
            if step := quantum(one.values.detach().numpy()):
                each = float(one.times.diff().median())
                yield Diagnostic(
                    "warning", f"motion.{name}.file",
                    f"{motion.file} is in steps of {step:.3g} {file.unit(name)}, as of an "
                    f"encoder: rates of the set-point jump by {step / each:.2g} "
                    f"{file.unit(name)}/s from row to row; smooth the column",
                )  # fmt: skip
            if last < end * (1 - 1e-9):
                yield Diagnostic(
                    "error", f"motion.{name}.file",
                    f"{motion.file} ends at {last:g} s, but the run lasts until "
                    f"{end:g} s: nothing says what is wanted then; shorten "
                    f"outputs.duration to {last:g}, or record longer",
                )  # fmt: skip
        if fastest * interval * OUTPUTS_PER_PERIOD > 1:
            yield Diagnostic(
                "warning", "outputs.interval",
                f"outputs every {interval:g} s do not show motion.{name}, which goes up to "
                f"{fastest:g} Hz; take {1 / (OUTPUTS_PER_PERIOD * fastest):.2g} s or less",
            )  # fmt: skip
