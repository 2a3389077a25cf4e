"""Every block of the README and of every page of the documentation: Python as it stands but for a
shorter manipulation, fewer elements and a looser tolerance, commands, TOML; links exist, and so do
quoted messages. The reference is generated from the declarations in the code."""

import os
import re
import runpy
import shlex
import subprocess
import sys
import textwrap
import tomllib
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).parents[1]
GENERATED = ROOT / "docs" / "reference"
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *(page for page in sorted((ROOT / "docs").rglob("*.md")) if GENERATED not in page.parents),
    *(
        ROOT / folder / "README.md"
        for folder in ("experiments", "experiments/validation", "data_gen", "examples/identify")
    ),
]
SHORTER = {
    'RigFile.ready("paper")': 'RigFile.ready("paper").override({"outputs.duration": 0.5, '
    '"outputs.interval": 5e-3, "outputs.snapshots": [], "pad.elements_x": 60, '
    '"pad.elements_y": 2})',
    '"light shaking").build()': '"light shaking").override({"outputs.duration": 0.9}).build()',
    "nominal=4e5": "nominal=8e5",
    'theta_C"][1000]': 'theta_C"][50]',
    "run.at(10)": "100",
    "run.at(5)": "50",
    "times=(0.375, 5.0, 10.0)": "times=(0.375,)",
    "identify(problem, ": 'identify(problem, rtol=3e-3, tightenings=0, assumptions="trusted", ',
}
ELSEWHERE = {
    "pip install": "an installation",
    "rehearse fit.toml": "test_sysid_rigs.py",
    "explain drive.csv": "test_sysid_suspects.py",
    "out/logs": "test_datasets.py",
    "stable_baselines3": "test_envs.py",
    "out/rolling": "test_datasets_read.py",
}
"""Parts of blocks that need more than a test has, and where they are tried instead."""
LONG = "laboratory", "identification", "reduced"
"""Pages that take seconds."""
DATASET = "data_gen"
"""Page whose Python reads what its commands have made."""
CLI = (".venv/bin/torchsoft", ".venv/bin/python")
FENCE = re.compile(r"```(?:\{code-cell\} )?(python|sh|toml)\n(.*?)```", re.DOTALL)


@cache
def reference() -> SimpleNamespace:
    """The generator of the reference."""
    pytest.importorskip("sphinx")
    return SimpleNamespace(**runpy.run_path(str(GENERATED.with_suffix(".py"))))


@cache
def generated() -> dict[str, str]:
    """Pages of the reference by the names of their files."""
    return reference().pages()


def blocks(page: Path, *kinds: str) -> list[str]:
    found = FENCE.findall(page.read_text(encoding="utf-8"))
    return [textwrap.dedent(text) for kind, text in found if kind in kinds]


def code(page: Path) -> str:
    text = "\n".join(
        block for block in blocks(page, "python") if not any(part in block for part in ELSEWHERE)
    )
    text = re.sub(r"^[%:].*$", "", text, flags=re.MULTILINE)  # of notebooks
    for long, short in SHORTER.items():
        text = text.replace(long, short)
    return text


def commands(page: Path) -> list[str]:
    lines = [line for block in blocks(page, "sh") for line in block.splitlines()]
    lines = [line for line in lines if not line.startswith("make ")]
    return [line for line in lines if not any(part in line for part in ELSEWHERE)]


def having(content: object) -> list[Path]:
    return [page for page in PAGES if content(page)]


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with what the repository has, where results do no harm."""
    for one in ("examples", "data_gen", "experiments"):
        (tmp_path / one).symlink_to(ROOT / one)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=name(page), marks=[pytest.mark.slow] * (page.stem in LONG))
        for page in having(lambda p: code(p) and DATASET not in str(p))
    ],
)
def test_python_runs(page, folder):
    if "IPython" in code(page):
        pytest.importorskip("IPython")
    names: dict[str, object] = {}
    exec(code(page), names)
    if page.stem == "running":
        assert names["s"].sensitivities.shape == (101, 10, 2)
    if page == ROOT / "README.md":
        assert (folder / "rolling.nc").stat().st_size > 0


@pytest.mark.slow
@pytest.mark.parametrize("page", having(commands), ids=name)
def test_commands_run(page, folder):
    rows = "".join(f"{t / 10},2,{10 + 5 * 0.8**t + 0.1 * (t % 3)}\n" for t in range(60))
    (folder / "relaxation.csv").write_text(f"t [s],strain [%],stress [kPa]\n{rows}")
    pull = "".join(f"{x / 10};{x / 8};23\n" for x in range(120)).replace(".", ",")
    (folder / "pull.csv").write_text(f"Weg;Standardkraft;Temperatur\nmm;N;C\n{pull}")
    for test, wide in (("tension", lambda x: x - x**-2), ("shear", lambda x: x - 1)):
        rows = "".join(f"{x / 40},{100 * wide(1 + x / 40)}\n" for x in range(1, 41))
        (folder / f"{test}.csv").write_text(f"strain [1],stress [kPa]\n{rows}")
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    for line in commands(page):
        program, *rest = shlex.split(line, comments=True)
        assert program in CLI, line
        module = ["-m", "torchsoft"] if program == CLI[0] else []
        done = subprocess.run(
            [sys.executable, *module, *rest], env=environment, capture_output=True, text=True,
            check=False,
        )  # fmt: skip
        assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
    if DATASET in str(page):
        exec(code(page), {"__name__": "page"})


@pytest.mark.parametrize("page", having(lambda p: blocks(p, "toml")), ids=name)
def test_toml_is_toml(page):
    for block in blocks(page, "toml"):
        assert tomllib.loads(block)


def test_targets_of_make_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for page in PAGES:
        for target in re.findall(r"^make ([\w-]+)", "\n".join(blocks(page, "sh")), re.MULTILINE):
            assert f"\n{target}:" in makefile, target


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
        there = (page.parent / target).resolve()
        if there.parent == GENERATED:
            assert there.name in generated(), target
        else:
            assert target.startswith("http") or there.exists(), target


def test_the_reference_has_every_key():
    """Keys of rig files with type, unit, bounds, default and meaning; links between its tables."""
    rigs, laws = generated()["rigs.md"], generated()["laws.md"]
    gravity = "| `gravity` | number ≥ 0, ≤ 1000 | m/s2 | `9.81` | gravitational acceleration"
    assert gravity in rigs
    assert '| `K_n` | `"auto"` or number ≥ 0.001, ≤ 1e+12 | N/m | required |' in laws
    for kind in ("smooth", "coulomb", "rate_and_state", "ageing", "python"):
        assert f"## `{kind}`" in laws
    for name, text in generated().items():
        for page, anchor in re.findall(r"\]\((\w+\.md)#([\w-]+)\)", text):
            headings = re.findall(r"^## (.*)$", generated()[page], re.MULTILINE)
            slugs = [re.sub(r"[^\w -]", "", one.lower()).replace(" ", "-") for one in headings]
            assert anchor in slugs, name


def test_a_key_without_a_meaning_is_rejected():
    from torchsoft.tables import Table

    class Undescribed(Table):
        width: float = 1.0

    with pytest.raises(ValueError, match=r"Undescribed\.width has no meaning; write one where"):
        reference().keys(Undescribed, {})


def test_quoted_messages_are_those_of_the_sources():
    sources = "".join(
        re.sub(r'"\s*\n\s*f?"', "", path.read_text(encoding="utf-8"))
        for path in (ROOT / "torchsoft").rglob("*.py")
    )
    page = (ROOT / "docs" / "messages.md").read_text(encoding="utf-8")
    quoted = re.findall(r"^### `([^`]+)`$", page, re.MULTILINE)
    assert quoted
    assert not [part for part in quoted if part not in sources]


def test_the_api_is_documented():
    """Public names of the package, and of its namespaces for users, stand on a page of the API."""
    import torchsoft
    from torchsoft import datasets, envs, plan, reduced, rigs, sysid, testing

    text = "".join(
        page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "api").glob("*.md")
    )
    documented = set(
        re.findall(r"(?:auto|py:)\w+:: torchsoft(?:\.\w+)*?\.(\w+)$", text, re.MULTILINE)
    )
    modules = datasets, plan, envs, rigs, sysid, reduced, testing
    wanted = {*dir(torchsoft)}.union(*(module.__all__ for module in modules))
    for module in re.findall(r"automodule:: (torchsoft\S+)", text):
        documented |= set(vars(__import__(module, fromlist=["_"])))
    assert sorted(wanted - documented) == []


@pytest.mark.slow
def test_pages_are_built_without_a_warning(tmp_path):
    """Chapters and gallery unexecuted: references, docstrings, tables of contents."""
    pytest.importorskip("sphinx")
    asked = ["-q", "-W", "--keep-going", "-D", "plot_gallery=0", "-D", "nb_execution_mode=off"]
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *asked, ROOT / "docs", tmp_path / "html"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    pages = "".join(
        path.read_text(encoding="utf-8") for path in (tmp_path / "html").rglob("*.html")
    )
    assert not re.findall(r'(?:src|href)="https?://[^"]+\.(?:js|css|woff2?)"', pages)
