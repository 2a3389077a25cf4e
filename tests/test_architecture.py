"""One-way flow: a module or folder of torchsoft imports only from those above it in its list, and
never in circles."""

import ast
import re
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import torchsoft

ROOT = Path(torchsoft.__file__).parent
FLOWS = {
    "": """
        caller display extras diagnostic files parallel tables csvfile quantity codegen
        physics cost
        solve testing plan
        plot materials rigs sysid reduced datasets envs cli __main__
    """,
    "codegen": "graph operations trace emit . stops",
    "physics": """
        arguments mesh shapes state contact rate_and_state ageing material hyperelastic elements
        pads matched balance multibond parts
        names motion validity graph structure energy statics start channels namespace rig
        setup .
    """,
    "physics.mesh": "element mesh block files quads .",
    "physics.shapes": "shape rounded contour eccentric .",
    "solve": """
        kernel laws steps progress rig_arrays model parameters stepper gradients trajectory
        netcdf vtk mcap diagnostics simulate batch torchdiffeq .
    """,
    "sysid": """
        sentences extensions
        initial_state recording unknowns noise prediction runs alternatives assumptions problem
        first_samples
        synthetic fit stages prechecks
        residual_tests colour assumption_tests search assumption_checks suspect_findings estimate
        result profile conclusion identification compare
        design_criterion columns configuration measured design figures report .
    """,
    "testing": "energy laws gradients .",
    "plan": "knots problem search sqp planning .",
    "rigs": """
        fields places parts control motion outputs schema naming geometry initial built assembly
        build excite written recorded findings check goal run .
    """,
    "cli": "results rigs plan identify profile design material dataset reduce plot .",
    "solve.kernel": """
        table arrays objects . invoke linear sources contacts condensed nodal transport pads domain
        stage step run adjoint tangent build
    """,
}
"""For every folder with layers its modules and folders from the top down; "." is what the folder's
own file imports."""
APART = ("plot", "materials", "rigs", "sysid", "reduced", "datasets", "envs")
"""Folders over the engine; of these, only `SHARED` may be imported by another."""
SHARED_RIGS = ("build", "built", "excite", "fields", "initial", "places", "written")
SHARED = ("plot", "materials.presets", *(f"rigs.{name}" for name in SHARED_RIGS))
FACADES = {"plot", "animate", "to_xarray", "to_vtk", "to_mcap", "save", "load"}
"""Methods of a trajectory that lead to what is made of it further down."""
TOP = {"quantity", "csvfile", "files", "display", "parallel", "caller"}


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {name_of(path): path for path in ROOT.rglob("*.py") if path != ROOT / "__init__.py"}


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imports(name: str) -> frozenset[str]:
    """Modules of torchsoft that one imports, inside functions and for type checkers too."""
    skipped = {
        node
        for outer in ast.walk(parsed(MODULES[name]))
        if name == "solve.trajectory" and getattr(outer, "name", "") in FACADES
        for node in ast.walk(outer)
    }
    found = set[str]()
    for node in ast.walk(parsed(MODULES[name])):
        if node in skipped:
            continue
        if isinstance(node, ast.Import):
            found |= {one.name.removeprefix("torchsoft.") for one in node.names} & MODULES.keys()
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("torchsoft"):
            module = (node.module or "").removeprefix("torchsoft").removeprefix(".")
            inner = (f"{module}.{alias.name}".removeprefix(".") for alias in node.names)
            found |= {one if one in MODULES else module for one in inner}
    return frozenset(found - {""})


def layer(name: str, folder: str = "") -> str | None:
    """The layer of a folder's flow that a module belongs to; None outside the folder."""
    if name == folder:
        return "."
    if folder and not name.startswith(folder + "."):
        return None
    return name.removeprefix(folder).removeprefix(".").partition(".")[0]


@pytest.mark.parametrize("folder", FLOWS)
def test_imports_point_upwards(folder):
    layers = FLOWS[folder].split()
    for name in MODULES:
        if (mine := layer(name, folder)) is None:
            continue
        assert mine in layers, f"{name} has no layer"
        below = [x for x in imports(name) if (its := layer(x, folder))
                 and layers.index(its) > layers.index(mine)]  # fmt: skip
        assert not below, f"{name} imports from below it"


def test_no_imports_in_circles():
    TopologicalSorter({name: imports(name) for name in MODULES}).prepare()


def test_folders_know_only_what_they_need():
    """Physics does not know how it is solved, code generation no physics, kernels no law, and
    applications not each other; only a run of a rig file draws."""
    engine = {"physics": {"physics"} | TOP, "codegen": {"codegen"}}
    for name in MODULES:
        used, own = imports(name), layer(name)
        layers = {layer(one) for one in used}
        assert layers <= engine.get(own or "", layers), name
        if own in APART:
            others = {layer(one) for one in used if not one.startswith(SHARED)}
            assert not others & ({*APART} - {own}), name
        assert own != "rigs" or "plot" not in layers or name == "rigs.run", name
        kernels = {one for one in used if layer(one, "solve") == "kernel"}
        if layer(name, "solve") == "kernel":
            assert used - kernels <= {"files"}, name
        else:
            called = {f"solve.kernel.{one}" for one in ("table", "arrays", "objects", "invoke")}
            assert kernels <= called, name


def test_calls_keep_house_rules():
    """Bars are for terminals, since a log would hold a carriage return for every step; warnings
    point to the caller; text names its encoding, whatever the terminal's is."""
    programs = (ROOT.parent / x for x in ("data_gen", "experiments", "examples"))
    for path in (path for folder in (ROOT, *programs) for path in folder.rglob("*.py")):
        for call in (node for node in ast.walk(parsed(path)) if isinstance(node, ast.Call)):
            of, given = ast.unparse(call.func), {keyword.arg for keyword in call.keywords}
            values = [*call.args, *(keyword.value for keyword in call.keywords)]
            modes = [x.value for x in values if isinstance(x, ast.Constant)]
            binary = any(isinstance(x, str) and "b" in x and len(x) <= 3 for x in modes)
            opens = re.search(r"\b(open|fdopen|read_text|write_text)$", of)
            opens = opens and not of.startswith("os.") and not binary
            where = f"{path}:{call.lineno}"
            assert of != "tqdm" or "disable" in given, where
            assert of != "warnings.warn" or path.name == "caller.py", where
            assert not opens or "encoding" in given, where
