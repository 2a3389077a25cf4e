"""One-way flow: a module or folder of torchsoft imports only from those above it in its list, and
never in circles."""

import ast
import re
from collections.abc import Iterator
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
        plot materials rigs sysid reduced datasets envs experiment cli __main__
    """,
    "codegen": "graph operations trace emit . stops",
    "physics": """
        arguments mesh shapes state contact rate_and_state ageing material hyperelastic elements
        pads matched balance multibond parts
        names motion validity graph structure energy statics start channels namespace rig
        extensions setup .
    """,
    "physics.mesh": "mesh block files quads .",
    "physics.shapes": "shape rounded contour eccentric .",
    "solve": """
        kernel laws steps progress model system stepper trajectory gradients formats
        diagnostics simulate batch torchdiffeq .
    """,
    "sysid": """
        initial_state recording unknowns noise prediction runs assumptions problem first_samples
        synthetic fit plan prechecks
        residual_tests colour refits assumption_tests new_fits sensitivity suspects estimate
        result profile posterior identification compare
        planner columns configuration measured design figures report .
    """,
    "testing": "energy laws gradients .",
    "plan": "knots problem search planning .",
    "rigs": """
        fields places parts control motion outputs geometry initial built build excite written
        course recorded gripped alone check goal run .
    """,
    "cli": "results rigs plan identify design material dataset reduce plot .",
    "solve.kernel": """
        table arrays objects . invoke linear sources contacts condensed nodal pads domain stage step
        run adjoint tangent build
    """,
}
"""For every folder with layers its modules and folders from the top down; "." is what the folder's
own file imports."""
APART = ("plot", "materials", "rigs", "sysid", "reduced", "datasets", "envs")
"""Folders over the engine; of these, only what is `SHARED` may be imported by another."""
SHARED_RIGS = ("build", "built", "excite", "fields", "initial", "places", "written")
SHARED = ("plot", "materials.presets", *(f"rigs.{name}" for name in SHARED_RIGS))
FACADES = {
    "solve.trajectory": (
        "plot", "animate", "to_xarray", "to_vtk", "to_mcap", "save", "load",
    )
}  # fmt: skip
"""Methods by which people reach, from a result, what is made of it further down; nothing else is
done in them, and only their imports point downwards."""
OUTSIDE = ("data_gen", "experiments", "examples")
"""Folders of programs that use the package."""
COMMAND = 20
"""Most lines of a command that leaves the work to the package."""


def imports(path: Path) -> set[str]:
    """Modules of torchsoft that a file imports, inside functions and for checkers of types too, but
    for those of `FACADES`."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    facades = {
        node
        for outer in ast.walk(tree)
        if isinstance(outer, ast.FunctionDef) and outer.name in FACADES.get(name_of(path), ())
        for node in ast.walk(outer)
    }
    found = set()
    for node in ast.walk(tree):
        if node in facades:
            continue
        if isinstance(node, ast.Import):
            found |= {one.name.removeprefix("torchsoft.") for one in node.names} & MODULES.keys()
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("torchsoft"):
            module = (node.module or "").removeprefix("torchsoft").removeprefix(".")
            for alias in node.names:  # `from torchsoft.solve import adjoint` imports the module
                inner = f"{module}.{alias.name}".removeprefix(".")
                found.add(inner if inner in MODULES else module)
    return found - {""}


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {name_of(path): path for path in ROOT.rglob("*.py") if path != ROOT / "__init__.py"}


def layer(name: str, folder: str) -> str | None:
    """The layer of a folder's flow that a module belongs to; None outside the folder."""
    if name == folder:
        return "."
    if folder and not name.startswith(folder + "."):
        return None
    return name.removeprefix(folder).removeprefix(".").partition(".")[0]


@pytest.mark.parametrize("folder", FLOWS)
def test_every_module_has_a_layer(folder):
    assert {layer(name, folder) for name in MODULES} - {None} == set(FLOWS[folder].split())


@pytest.mark.parametrize("folder", FLOWS)
def test_imports_point_upwards(folder):
    layers = FLOWS[folder].split()
    for name, path in MODULES.items():
        mine = layer(name, folder)
        if mine is None:
            continue
        for other in imports(path):
            its = layer(other, folder)
            assert its is None or layers.index(its) <= layers.index(mine), (
                f"{name} imports {other} from below it"
            )


def test_no_imports_in_circles():
    TopologicalSorter({name: imports(path) for name, path in MODULES.items()}).prepare()


def test_physics_does_not_know_how_it_is_solved():
    """Nor does code generation know any physics."""
    for name, path in MODULES.items():
        own, others = layer(name, ""), {layer(other, "") for other in imports(path)}
        if own in ("physics", "codegen"):
            assert others <= (
                {"physics", "quantity", "csvfile", "files", "display", "parallel", "caller"}
                if own == "physics"
                else {"codegen"}
            ), name


def test_the_kernels_know_no_law():
    """They call compiled laws by address, and use nothing else of torchsoft; their objects are
    files. Nobody imports them, but for what tables they take and who calls them."""
    own = {name for name in MODULES if layer(name, "solve") == "kernel"}
    told = {f"solve.kernel.{name}" for name in ("table", "arrays", "objects", "invoke")}
    for name, path in MODULES.items():
        if name in own:
            allowed = own | ({"files"} if name == "solve.kernel.objects" else set())
            assert imports(path) <= allowed, name
        else:
            assert imports(path) & own <= told, name


def test_rigs_are_drawn_in_one_room():
    """Whatever else they do needs no matplotlib."""
    drawing = {
        name
        for name, path in MODULES.items()
        if layer(name, "") == "rigs" and "plot" in {layer(other, "") for other in imports(path)}
    }
    assert drawing == {"rigs.run"}


@pytest.mark.parametrize("folder", APART)
def test_applications_do_not_know_each_other(folder):
    used = {
        other
        for name, path in MODULES.items()
        if layer(name, "") == folder
        for other in imports(path)
    }
    apart = {layer(other, "") for other in used if not other.startswith(SHARED)}
    assert not apart & (set(APART) - {folder})


@pytest.mark.parametrize(
    "folder", ["solve", "physics", "sysid", "datasets", "plan", "envs", "plot", "reduced"]
)
def test_no_rig_is_special(folder):
    """Whatever is known of the paper's rig stands in its file."""
    special = r"paper's rig|SoftGrasp|torchsoft\.paper|steel_on_rubber"
    parts = r"|(\b|_)(disc|bracket)\b" if folder == "solve" else ""
    words = re.compile(special + parts)
    for path in (ROOT / folder).rglob("*.py"):
        assert not words.findall(path.read_text(encoding="utf-8")), path


def test_commands_leave_the_work_to_the_package():
    for path in (ROOT.parent / "data_gen").glob("*.py"):
        assert len(path.read_text().splitlines()) <= COMMAND, path


def calls(*folders: Path) -> Iterator[tuple[Path, ast.Call]]:
    """All calls in the modules of some folders, with their file."""
    for path in (path for folder in folders for path in folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call):
                yield path, node


def test_bars_are_for_terminals_and_warnings_point_to_the_caller():
    """A log would hold a carriage return for every step of a bar, and a number of frames is wrong
    wherever pydantic or a decorator is between."""
    for path, call in calls(ROOT, ROOT.parent / "experiments"):
        name, given = ast.unparse(call.func), {keyword.arg for keyword in call.keywords}
        assert name != "tqdm" or "disable" in given, f"{path}:{call.lineno}"
        assert name != "warnings.warn" or path.name == "caller.py", f"{path}:{call.lineno}"


def opens_text(call: ast.Call) -> bool:
    """Whether a call opens, reads or writes a file as text."""
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    low_level = isinstance(call.func, ast.Attribute) and getattr(call.func.value, "id", "") == "os"
    modes = [
        x.value
        for x in (*call.args, *(k.value for k in call.keywords))
        if isinstance(x, ast.Constant)
    ]
    binary = any(isinstance(mode, str) and "b" in mode and len(mode) <= 3 for mode in modes)
    return name in ("open", "fdopen", "read_text", "write_text") and not low_level and not binary


def test_text_names_its_encoding():
    """Or a file would be read and written otherwise where the terminal knows ASCII only."""
    found = [
        f"{path.name}:{call.lineno}"
        for path, call in calls(ROOT, *(ROOT.parent / x for x in OUTSIDE))
        if opens_text(call) and "encoding" not in {keyword.arg for keyword in call.keywords}
    ]
    assert found == []
