"""One-way flow: a module of torchsoft imports only from those above it in the list."""

import ast
from pathlib import Path

import pytest

import torchsoft

ROOT = Path(torchsoft.__file__).parent
FLOW = """
channels files parameters shapes multibond state pad contact control model ledger equilibrium stability
kernels kernels.node kernels.linear kernels.pad kernels.stage kernels.run kernels.adjoint kernels.sensitivity
kernel_inputs grid implicit stage_laws adjoint sensitivity unrolled torchdiffeq_solver continuous
trajectory simulate scenario excitation processes
plot plot.scene plot.figures plot.animation plot.diagram
sysid.recording sysid.unknowns sysid.prediction sysid.workers sysid.problem
sysid.information sysid.fit sysid.plan
sysid.result sysid.solve sysid.synthetic sysid.columns sysid.measured sysid sysid.figures sysid.report
reduced.rollout reduced.ode reduced.records reduced.terms reduced.fit reduced
datasets.reader datasets datasets.config datasets.design datasets.schema datasets.simulation
datasets.store datasets.coverage datasets.check datasets.generate
cli __main__
"""
FOLDERS = ("kernels", "plot", "sysid", "reduced", "datasets")
APART = ("plot", "sysid", "reduced", "datasets")
"""Folders over the engine; of these, only `plot` may be imported by another."""
ORDER = FLOW.split()
LONGEST = 380
"""Lines; a file that grows past them holds more than one idea."""


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def imports(path: Path) -> set[str]:
    """Modules of torchsoft that a file imports, wherever in it."""
    nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
    return {
        (node.module or "").removeprefix("torchsoft.") for node in nodes if (node.module or "").startswith("torchsoft")
    }


def test_every_module_has_a_place() -> None:
    assert sorted(name_of(path) for path in ROOT.rglob("*.py")) == sorted(["__init__", *ORDER])


@pytest.mark.parametrize("name", ORDER)
def test_imports_point_upwards(name: str) -> None:
    path = ROOT / (name.replace(".", "/") + ("/__init__.py" if name in FOLDERS else ".py"))
    below = {other for other in imports(path) if ORDER.index(other) >= ORDER.index(name)}
    assert not below, f"{name} imports {below} from below it"
    assert len(path.read_text().splitlines()) <= LONGEST


@pytest.mark.parametrize("folder", APART)
def test_applications_do_not_know_each_other(folder: str) -> None:
    used = {name.partition(".")[0] for path in (ROOT / folder).rglob("*.py") for name in imports(path)}
    assert not used & (set(APART) - {folder, "plot"})
