"""Results of runs on disk, as data with checksums: what makes an identification resume, to the bit.

A journal is a folder of its own, which a marker says, so that nothing of others' is ever taken for a result or removed. A file
that is damaged, or holds the result of another run, is not used: its run is made again.
"""

import io
import re
import warnings
from collections.abc import Sequence
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from torchsoft.files import CHECKPOINT, SEALED, check_file, make_folder, remove_partials, replacing
from torchsoft.solve.kernel.cache import digest
from torchsoft.sysid.problem.prediction import FailedRun, Misfit, Prediction
from torchsoft.sysid.problem.recording import Recording

MEANING = "Runs of an identification that is not done; torchsoft removes the .run files in this folder when it is.\n"

RUN = re.compile(r"[0-9a-f]{64}\.run")
"""Names of the results."""

KINDS = {kind.__name__: kind for kind in (Prediction, Misfit, FailedRun)}
"""What can be the result of a run."""

PROGRAM = (
    digest(Path(__file__).parents[2]),
    *(version(name) for name in ("torchsoft", "torch", "numpy", "scipy", "numba")),
)
"""Everything but the data that decides a run."""


def encoded(result: Any) -> bytes:
    """A result as numpy's archive of its fields, without those that are None."""
    fields = {name: np.asarray(value) for name, value in result._asdict().items() if value is not None}
    archive = io.BytesIO()
    contents: Any = {"kind": np.asarray(type(result).__name__)} | fields
    np.savez(archive, **contents)
    return archive.getvalue()


def decoded(content: bytes) -> Any:
    """The result that `encoded` was given, to the bit."""
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        fields = {name: archive[name] if archive[name].ndim else archive[name].item() for name in archive.files}
    kind: Any = KINDS[fields.pop("kind")]
    return kind(**fields)


class Journal:
    """The results of runs of some recordings in a folder, by the run, which is any object whose `repr` says all of it.

    Raises `ValueError` for a folder that holds anything else.
    """

    def __init__(self, folder: Path, recordings: Sequence[Recording]) -> None:
        self.folder, self._warned = folder, False
        self._own = repr((PROGRAM, [recording.fingerprint for recording in recordings]))
        self._open()

    def _open(self) -> None:
        """Make the folder, and mark it unless it is someone else's."""
        if self.folder.exists() and not self.folder.is_dir():
            raise ValueError(f"the checkpoint {self.folder} is a file; give a new or an empty folder")
        make_folder(self.folder)
        if not (self.folder / CHECKPOINT).is_file():
            if any(self.folder.iterdir()):
                raise ValueError(f"the checkpoint {self.folder} holds other files; give a new or an empty folder")
            (self.folder / CHECKPOINT).write_text(MEANING, encoding="utf-8")

    def _place(self, run: object) -> tuple[bytes, Path]:
        """What the checksum of a run's file begins with, and the file."""
        name = sha256((self._own + repr(run)).encode())
        return name.digest(), self.folder / f"{name.hexdigest()}.run"

    def recall(self, run: object) -> Any:
        """The result of a run; None where it is not there, or damaged."""
        name, path = self._place(run)
        if not path.is_file():
            return None
        try:
            content = check_file(path, SEALED).read_bytes()
            if content[:32] == sha256(name + content[32:]).digest():
                return decoded(content[32:])
        except Exception:  # a reader meets a forged archive in a hundred ways
            pass
        if not self._warned:
            warnings.warn(
                f"the checkpoint {self.folder} holds damaged results, whose runs are made again", stacklevel=2
            )
            self._warned = True
        return None

    def keep(self, run: object, result: Any) -> None:
        """Write the result of a run, so that it lasts."""
        name, path = self._place(run)
        content = encoded(result)
        if not (self.folder / CHECKPOINT).is_file():  # another identification was done with the folder
            self._open()
        with replacing(path) as partial:
            partial.write_bytes(sha256(name + content).digest() + content)


def forget(folder: Path) -> None:
    """Remove a journal's own files, and the folder unless it holds anything else; other folders are left alone."""
    if not (folder / CHECKPOINT).is_file():
        return
    for path in folder.iterdir():
        if RUN.fullmatch(path.name) and path.is_file():
            path.unlink(missing_ok=True)
    remove_partials(path for path in folder.glob("*.partial") if RUN.match(path.name))
    if [path.name for path in folder.iterdir()] == [CHECKPOINT]:
        (folder / CHECKPOINT).unlink(missing_ok=True)
        folder.rmdir()
