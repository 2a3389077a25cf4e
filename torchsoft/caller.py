"""Warnings that point to the line of the caller, however deep they arise."""

import os
import sys
import warnings
from pathlib import Path
from sysconfig import get_paths

LIBRARIES = "stdlib", "platstdlib", "purelib", "platlib"
FOLDERS = Path(__file__).parent, *(get_paths()[name] for name in LIBRARIES)
INSIDE = tuple(f"{folder}{os.sep}" for folder in FOLDERS)
"""Folders of this package and of the libraries that it calls, which call it back."""


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn, at the innermost line outside of this package and of libraries."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_code.co_filename.startswith(INSIDE):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)
