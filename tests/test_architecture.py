"""One-way flow: a layer of torchsoft imports only from those above it in the list, and no folder imports in circles."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import torchsoft

ROOT = Path(torchsoft.__file__).parent
FLOW = """
channels files parameters shapes multibond state pad contact control model ledger equilibrium stability kernels
kernel_inputs grid implicit stage_laws adjoint sensitivity unrolled torchdiffeq_solver continuous
trajectory simulate scenario excitation processes
plot sysid reduced datasets
cli __main__
"""
LAYERS = FLOW.split()
"""Modules and folders."""
APART = ("plot", "sysid", "reduced", "datasets")
"""Folders over the engine; of these, only `plot` may be imported by another."""
LONGEST = 350
"""Lines; a file that grows past them holds more than one idea."""
COMMAND = 20
"""Lines of a command that leaves the work to the package."""


def imports(path: Path) -> set[str]:
    """Modules of torchsoft that a file imports, wherever in it."""
    nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
    return {
        (node.module or "").removeprefix("torchsoft.") for node in nodes if (node.module or "").startswith("torchsoft")
    }


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {name_of(path): path for path in ROOT.rglob("*.py") if path != ROOT / "__init__.py"}


def layer(name: str) -> str:
    return name.partition(".")[0]


def test_every_module_has_a_layer() -> None:
    assert {layer(name) for name in MODULES} == set(LAYERS)


@pytest.mark.parametrize("name", sorted(MODULES))
def test_imports_point_upwards(name: str) -> None:
    mine = LAYERS.index(layer(name))
    below = {other for other in imports(MODULES[name]) if LAYERS.index(layer(other)) > mine}
    assert not below, f"{name} imports {below} from below it"


def test_no_imports_in_circles() -> None:
    TopologicalSorter({name: imports(path) for name, path in MODULES.items()}).prepare()


@pytest.mark.parametrize("folder", APART)
def test_applications_do_not_know_each_other(folder: str) -> None:
    used = {layer(other) for name, path in MODULES.items() if layer(name) == folder for other in imports(path)}
    assert not used & (set(APART) - {folder, "plot"})


def test_files_are_short() -> None:
    top = ROOT.parent
    for path in (*MODULES.values(), *(top / "experiments").glob("*.py")):
        assert len(path.read_text().splitlines()) <= LONGEST, path
    for path in (top / "data_gen").glob("*.py"):
        assert len(path.read_text().splitlines()) <= COMMAND, path
