"""Packages that only some of the users need."""

import importlib
from types import ModuleType


def needed(module: str, extra: str) -> ModuleType:
    """A module of an optional package. Raises `ModuleNotFoundError` with the remedy."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as missing:
        if (missing.name or "").partition(".")[0] != module.partition(".")[0]:
            raise
        package = module.partition(".")[0]
        raise ModuleNotFoundError(
            f"this needs the package {package}: pip install 'torchsoft[{extra}]'", name=missing.name
        ) from None
