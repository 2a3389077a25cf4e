"""The fixture that counts, and the table at the end."""

from hostile.trial import pytest_terminal_summary, tally

__all__ = ["pytest_terminal_summary", "tally"]
