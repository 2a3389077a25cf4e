"""Python of the README and of every page of the documentation, run as it stands but for a shorter
manipulation, fewer elements and a looser tolerance; links exist."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LINKED = [
    *PAGES,
    *(
        ROOT / folder / "README.md"
        for folder in ("experiments", "experiments/validation", "data_gen")
    ),
]
SHORTER = {
    "torch.linspace(0, 30, 3001": "torch.linspace(0, 0.5, 101",
    'theta"][1000]': 'theta"][50]',
    '"contact.v_s": 0.05}': '"contact.v_s": 0.05, "pad.elements_x": 60, "pad.elements_y": 2}',
    "identify(problem, ": 'identify(problem, rtol=1e-3, assumptions="trusted", ',
}
LONGEST = 150
"""Lines of the README."""


def code(page: Path) -> str:
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    text = "\n".join(blocks)
    for long, short in SHORTER.items():
        text = text.replace(long, short)
    return text


@pytest.mark.parametrize("page", [page for page in PAGES if code(page)], ids=lambda page: page.stem)
def test_the_examples_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "rigs").symlink_to(ROOT / "rigs")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(code(page), names)
    if page.stem == "running":
        assert names["s"].sensitivities.shape == (101, 10, 2)  # pyright: ignore[reportAttributeAccessIssue]
        assert (tmp_path / "rolling.nc").stat().st_size > 0


@pytest.mark.parametrize("page", LINKED, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
        assert target.startswith("http") or (page.parent / target).exists(), target


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= LONGEST
