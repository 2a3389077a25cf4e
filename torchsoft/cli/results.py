"""The folder that a command writes its results to."""

from pathlib import Path
from tempfile import TemporaryFile

from torchsoft.files import make_folder


def try_folder(out: Path) -> None:
    """Make the folder, and try that files can be written to it. Raises `ValueError` where they cannot."""
    try:
        make_folder(out)
        with TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise ValueError(
            f"--out: results cannot be written to {out} ({error.filename or out}: {error.strerror}); name a folder, a new one "
            "or one that may be written to"
        ) from None
