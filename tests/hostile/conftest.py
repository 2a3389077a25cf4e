"""The fixtures that count and that are quick to write to, and the table at the end."""

from hostile.processes import memory
from hostile.trial import pytest_terminal_summary, tally

__all__ = ["memory", "pytest_terminal_summary", "tally"]
