"""The README's Python, run as it stands but for a shorter manipulation."""

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"
SHORTER = {"torch.linspace(0, 30, 3001": "torch.linspace(0, 0.5, 51", 'theta"][1000]': 'theta"][50]'}


def test_the_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = "\n".join(re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL))
    for long, short in SHORTER.items():
        assert long in code
        code = code.replace(long, short)
    (tmp_path / "rigs").symlink_to(README.parent / "rigs")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(code, names)
    assert names["s"].sensitivities.shape == (51, 10, 2)  # pyright: ignore[reportAttributeAccessIssue]
    assert (tmp_path / "rolling.nc").stat().st_size > 0
