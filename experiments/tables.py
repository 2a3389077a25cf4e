"""Writes the tables of all pages from stored results.

A page holds a table between the lines `<!-- table PROGRAM NAME -->` and `<!-- end -->`. The tables
of a program, with the commit that they belong to, are stored in `experiments/results/PROGRAM.json`.

Command: .venv/bin/python -m experiments.tables [SUMMARY.json ...]
Every summary is stored first, as the result of the program whose name its folder has.
"""

import json
import re
import sys
from pathlib import Path
from typing import Any

from experiments.frame import Table
from torchsoft.files import save_text, write_json

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "experiments" / "results"
PAGES = ("experiments/README.md", "experiments/validation/README.md", "docs/paper.md",
         "docs/comparison.md", "docs/contact_theory.md",
         "docs/validation_identification.md")  # fmt: skip
MARKED = re.compile(r"(<!-- table (\S+) (.+?) -->\n).*?(<!-- end -->)", re.DOTALL)


def store(summary: Path) -> None:
    """Keep the tables of a summary, and their commit, as the results of its program.

    Raises `ValueError` for a summary without tables or of a smoke run.
    """
    found = json.loads(summary.read_text(encoding="utf-8"))
    if not found.get("tables") or found["config"]["smoke"]:
        raise ValueError(f"{summary}: give the summary of a whole run, which has tables")
    path = RESULTS / f"{summary.resolve().parent.name}.json"
    known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    write_json(
        path, known | {n: {"commit": found["commit"], **t} for n, t in found["tables"].items()}
    )


def filled(page: str) -> str:
    """The text of a page with its tables. Raises `ValueError` for a table that is not stored."""

    def table(mark: re.Match[str]) -> str:
        start, program, name, end = mark.groups()
        path = RESULTS / f"{program}.json"
        stored: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if name not in stored:
            raise ValueError(f"{path} has no table {name!r}; it has {', '.join(stored)}")
        one = stored[name]
        return f"{start}\n{Table(one['head'], one['rows'])}\n\nCommit: {one['commit']}.\n{end}"

    return MARKED.sub(table, page)


def main() -> None:
    for summary in sys.argv[1:]:
        store(Path(summary))
    for path in (ROOT / page for page in PAGES):
        save_text(path, filled(path.read_text(encoding="utf-8")))


if __name__ == "__main__":
    main()
