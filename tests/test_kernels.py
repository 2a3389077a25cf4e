"""Object files of the kernels: named after what they are made from, checked before they are used,
made again where they are missing; and the tables that kernels take."""

import copy
import os
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite.binding as llvm
import numpy as np
import pytest
from hostile.damage import BYTES, Victim, damage

from torchsoft.solve.kernel import objects, table
from torchsoft.solve.kernel.table import Array, IndexMatrix

MACHINE_CODE = bytes(range(256)) * 10


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The only folder for objects, empty, in a process that has said nothing yet."""
    monkeypatch.setattr(objects, "FOLDERS", [tmp_path / "kernels"])
    monkeypatch.setattr(objects, "_said", set())
    return tmp_path / "kernels"


def kept(name: str = "run") -> Path:
    """The file of an object that was just kept."""
    objects.keep(name, objects.level(), MACHINE_CODE)
    return objects.FOLDERS[0] / f"{name}-{objects.level()}.o"


def test_an_object_is_found_again(folder, capsys):
    assert objects.found("run") is None
    assert kept().stat().st_mode & 0o777 == 0o644
    assert objects.found("run") == MACHINE_CODE
    assert objects.found("backward") is None
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("kind", BYTES)
def test_a_damaged_object_is_not_used(folder, kind, capsys):
    damage(BYTES[kind], Victim(kept(), np.random.default_rng(0)))
    assert objects.found("run") is None
    said = capsys.readouterr().err
    assert said == f"torchsoft: note: {folder} holds damaged kernels, which are not used\n"
    kept()
    assert objects.found("run") == MACHINE_CODE


def test_no_object_stands_for_another(folder, monkeypatch):
    """Neither for another kernel's, nor for another processor's, nor for that of other sources."""
    path = kept()
    for other in (f"backward-{objects.level()}.o", "run-elsewhere.o"):
        (folder / other).write_bytes(path.read_bytes())
    assert objects.found("backward") is None
    monkeypatch.setattr(objects, "level", lambda: "elsewhere")
    assert objects.found("run") is None
    monkeypatch.undo()
    changed = folder.rename(folder.parent / "changed")
    monkeypatch.setattr(objects, "FOLDERS", [changed])
    assert objects.found("run") is None


def test_an_object_that_others_may_change_is_not_used(folder, capsys):
    """Though its checksum is right."""
    kept().chmod(0o666)
    assert objects.found("run") is None
    said = capsys.readouterr().err
    assert said.endswith("holds kernels that other users may change, which are not used\n")
    if os.getuid() == 0:
        os.chown(kept(), 12345, 12345)
        assert objects.found("run") is None


def test_where_nothing_can_be_kept_one_line_says_so(folder, capsys):
    folder.write_text("a file")
    kept()
    kept()
    assert capsys.readouterr().err == (
        f"torchsoft: note: compiled kernels cannot be kept in {folder}; compiling at every start\n"
    )


def test_a_folder_in_place_of_an_object_is_left_alone(folder):
    path = kept()
    path.unlink()
    path.mkdir()
    assert objects.found("run") is None
    kept()
    assert path.is_dir()


def test_a_second_folder_is_read_and_the_first_is_written(folder, tmp_path, monkeypatch):
    first, name = tmp_path / "first" / "name", f"run-{objects.level()}.o"
    monkeypatch.setattr(objects, "FOLDERS", [tmp_path / "name"])
    kept()
    monkeypatch.setattr(objects, "FOLDERS", [first, tmp_path / "name"])
    assert objects.found("run") == MACHINE_CODE
    assert kept() == first / name


def test_objects_are_named_after_all_that_is_compiled(tmp_path):
    assert objects.digest(objects.HERE) == objects.NAME
    assert {"stage.py", "contacts.py", "arrays.py", "invoke.py", "table.py", "build.py"} <= {
        path.name for path in objects.HERE.glob("*.py")
    }
    names = set()
    for name, text in (
        ("law.py", "a = 1"),
        ("step.py", "b = 2"),
        ("law.py", "a = 3"),
        ("more/law.py", "a = 3"),
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
        names.add(objects.digest(tmp_path))
    assert len(names) == 4


def test_sources_that_changed_since_the_start_are_refused(folder, monkeypatch):
    """What they compile to takes other tables than this process makes."""
    monkeypatch.setattr(objects, "NAME", "older")
    with pytest.raises(RuntimeError, match="start it again"):
        objects.load("run")
    assert not folder.exists()


def test_a_second_process_waits_for_the_first_and_takes_its_kernels(folder, monkeypatch, capsys):
    monkeypatch.setattr(objects, "compile_missing", lambda name: pytest.fail("compiled twice"))
    with ThreadPoolExecutor(1) as pool:
        with objects.alone():
            second = pool.submit(objects.build, "run")
            with pytest.raises(TimeoutError):
                second.result(0.2)
            kept()
        assert second.result(10) == MACHINE_CODE
    assert f"another process compiles kernels for {folder}" in capsys.readouterr().err


def test_folders(monkeypatch):
    """TORCHSOFT_CACHE_DIR alone, or beside the sources and in the user's cache, which not every
    user has."""
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("TORCHSOFT_CACHE_DIR", "/chosen")
    assert objects.folders("name") == [Path("/chosen/name")]
    monkeypatch.setenv("TORCHSOFT_CACHE_DIR", "")
    monkeypatch.setenv("HOME", "/home/someone")
    beside = objects.HERE / "objects" / "name"
    assert objects.folders("name") == [beside, Path("/home/someone/.cache/torchsoft/name")]
    monkeypatch.setenv("XDG_CACHE_HOME", "/caches")
    assert objects.folders("name") == [beside, Path("/caches/torchsoft/name")]
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # of a user without a home
    assert objects.folders("name") == [beside]


@pytest.mark.parametrize(
    ("system", "features", "name"),
    [
        (("Linux", "x86_64"), {*objects.NEEDED["linux-x86-64-v3"], "avx512f"}, "linux-x86-64-v3"),
        (("Linux", "x86_64"), objects.NEEDED["linux-x86-64-v2"], "linux-x86-64-v2"),
        (("Linux", "x86_64"), {"sse2"}, "native"),
        (("Linux", "aarch64"), {"neon"}, "linux-aarch64"),
        (("Darwin", "arm64"), {"neon"}, "native"),
        (("Windows", "AMD64"), objects.NEEDED["linux-x86-64-v3"], "native"),
    ],
)
def test_a_processor_gets_the_best_level_that_it_can_run(system, features, name, monkeypatch):
    monkeypatch.setattr(objects.platform, "system", lambda: system[0])
    monkeypatch.setattr(objects.platform, "machine", lambda: system[1])
    monkeypatch.setattr(llvm, "get_host_cpu_features", lambda: dict.fromkeys(features, True))
    assert objects.level.__wrapped__() == name


@pytest.mark.slow
def test_kernels_are_built_for_every_level_and_here_to_the_same_bytes(tmp_path):
    """So that a run from an object has the bits of one that was compiled for it."""
    levels = [name for name in objects.LEVELS if name != "native" or objects.level() == name]
    chosen = [word for name in levels for word in ("--level", name)]
    command = [sys.executable, "-m", "torchsoft.solve.kernel.build", "rates", "--out", tmp_path]
    subprocess.run([*command, *chosen], check=True, capture_output=True)
    made = {path.name: path.read_bytes() for path in (tmp_path / objects.NAME).iterdir()}
    assert set(made) == {f"rates-{name}.o" for name in levels}
    assert made[f"rates-{objects.level()}.o"] == (objects.found("rates") or objects.build("rates"))
    machines = {name: content[18] for name, content in made.items() if content[:4] == b"\x7fELF"}
    assert machines.get("rates-linux-aarch64.o") == 183
    assert machines.get("rates-linux-x86-64-v2.o") == 62


@table.table
class Inner(NamedTuple):
    """Of a table."""

    length: float


@table.table
class Outer(NamedTuple):
    """Of every kind of field."""

    count: int
    values: Array
    numbers: IndexMatrix
    inner: Inner


def outer(**changed: Any) -> Any:
    own: dict[str, Any] = {
        "count": 3, "values": np.zeros(4), "numbers": np.zeros((2, 5), np.int64),
        "inner": Inner(0.5),
    }  # fmt: skip
    return Outer(**own | changed)


def test_the_words_of_a_table():
    made = outer()
    values, numbers = (x.__array_interface__["data"][0] for x in (made.values, made.numbers))
    assert list(made.packed) == [3, values, 4, numbers, 2, 5, table.address(made.inner)]
    assert made.inner.packed.tobytes() == np.float64(0.5).tobytes()
    assert [field.word for field in table.layout(Outer)] == [0, 1, 3, 6]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("values", np.zeros(4, np.float32)),
        ("values", np.zeros((2, 2))),
        ("values", np.zeros(8)[::2]),
        ("numbers", np.zeros((2, 5))),
        ("numbers", np.zeros((5, 2), np.int64).T),
    ],
)
def test_an_array_of_another_kind_is_refused(name, value):
    with pytest.raises(TypeError, match=f"`{name}` of Outer must be a C-contiguous array of"):
        table.address(outer(**{name: value}))


@pytest.mark.parametrize("again", [copy.copy, lambda x: pickle.loads(pickle.dumps(x))])
def test_a_copy_of_a_table_has_words_of_its_own(again):
    made = outer()
    table.address(made)
    other = again(made)
    assert table.address(other) != table.address(made)
    assert other.packed[1] == other.values.__array_interface__["data"][0]
