"""The object file of the kernels: named after what it is made from, checked before it is used, made
again where it is missing; and the tables that kernels take."""

import errno
import os
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
    """The only folder for objects, empty, in a process that has warned of nothing yet."""
    monkeypatch.setattr(objects, "FOLDERS", [tmp_path / "kernels"])
    monkeypatch.setattr(objects, "_said", set())
    return tmp_path / "kernels"


def kept() -> Path:
    """The file of an object that was just kept."""
    objects.keep(objects.level(), MACHINE_CODE)
    return objects.FOLDERS[0] / f"{objects.level()}.o"


def test_an_object_is_found_in_any_folder_and_written_to_the_first(folder, monkeypatch, capsys):
    assert objects.found() is None
    assert kept().stat().st_mode & 0o777 == 0o644
    first = folder.parent / "first"
    monkeypatch.setattr(objects, "FOLDERS", [first, folder])
    assert objects.found() == MACHINE_CODE
    assert kept().parent == first
    assert capsys.readouterr().err == ""


UNUSABLE: dict[str, tuple[Any, str]] = {
    **{kind: (lambda path, how=how: damage(how, Victim(path, np.random.default_rng(0))), "damaged")
       for kind, how in BYTES.items()},
    "others may write": (lambda path: path.chmod(0o666), "that other users may change"),
    "a folder": (lambda path: (path.unlink(), path.mkdir()), ""),
    "another level's": (lambda path: (objects.keep("other", MACHINE_CODE),
                                      path.with_name("other.o").replace(path)), "damaged"),
}  # fmt: skip
if os.getuid() == 0:
    UNUSABLE["of another user"] = (lambda path: os.chown(path, 12345, 12345), "other users")


@pytest.mark.parametrize("kind", UNUSABLE)
def test_an_object_that_may_be_another_is_not_used(folder, kind, capsys):
    """One line says why, and it is made again."""
    spoil, why = UNUSABLE[kind]
    spoil(kept())
    assert objects.found() is None
    told = capsys.readouterr().err
    assert why in told
    assert told.count("\n") == bool(why)
    assert kept().is_dir() or objects.found() == MACHINE_CODE


def test_objects_are_named_after_all_that_is_compiled_and_the_processor(
    folder, tmp_path, monkeypatch
):
    assert objects.digest(objects.HERE) == objects.NAME
    names = set()
    for name, text in (("law.py", "a"), ("step.py", "b"), ("law.py", "c"), ("more/law.py", "c")):
        path = tmp_path / "sources" / name
        path.parent.mkdir(exist_ok=True, parents=True)
        path.write_text(text)
        names.add(objects.digest(tmp_path / "sources"))
    assert len(names) == 4
    content = kept().read_bytes()
    (folder / "elsewhere.o").write_bytes(content)
    monkeypatch.setattr(objects, "level", lambda: "elsewhere")
    assert objects.found() is None
    monkeypatch.setattr(objects, "NAME", "older")  # the sources changed since this process started
    with pytest.raises(RuntimeError, match="start it again"):
        objects.load()


def full(*_: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("why", ["a file is there", "the disk is full"])
def test_where_nothing_can_be_kept_one_line_says_so(folder, monkeypatch, capsys, why):
    if why == "the disk is full":
        monkeypatch.setattr(Path, "replace", full)
    else:
        folder.write_text("a file")
    kept()
    kept()
    (told,) = capsys.readouterr().err.splitlines()
    assert f"compiled kernels cannot be kept in {folder}" in told
    assert not [*folder.glob("*")]


def test_a_second_process_waits_for_the_first_and_takes_its_kernels(folder, monkeypatch, capsys):
    monkeypatch.setattr(objects, "compile_missing", lambda: pytest.fail("compiled twice"))
    with ThreadPoolExecutor(1) as pool:
        with objects.alone():
            second = pool.submit(objects.build)
            with pytest.raises(TimeoutError):
                second.result(0.2)
            kept()
        assert second.result(10) == MACHINE_CODE
    assert f"another process compiles kernels for {folder}" in capsys.readouterr().err


BESIDE = str(objects.HERE / "objects")


@pytest.mark.parametrize(
    ("variables", "folders"),
    [
        ({"TORCHSOFT_CACHE_DIR": "/chosen"}, ["/chosen"]),
        ({"TORCHSOFT_CACHE_DIR": "", "HOME": "/a"}, [BESIDE, "/a/.cache/torchsoft"]),
        ({"HOME": "/a", "XDG_CACHE_HOME": "/caches"}, [BESIDE, "/caches/torchsoft"]),
        ({}, [BESIDE]),
    ],
)
def test_folders(variables, folders, monkeypatch):
    """Not every user has a home."""
    for name in ("XDG_CACHE_HOME", "TORCHSOFT_CACHE_DIR", "HOME"):
        monkeypatch.delenv(name, raising=False)
    if "HOME" not in variables:
        monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert objects.folders("name") == [Path(folder) / "name" for folder in folders]


@pytest.mark.parametrize(
    ("system", "features", "name"),
    [
        (("Linux", "x86_64"), {*objects.NEEDED["linux-x86-64-v3"], "avx512f"}, "linux-x86-64-v3"),
        (("Linux", "x86_64"), objects.NEEDED["linux-x86-64-v2"], "linux-x86-64-v2"),
        (("Linux", "x86_64"), {"sse2"}, "native"),
        (("Linux", "aarch64"), {"neon"}, "linux-aarch64"),
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
    command = [sys.executable, "-m", "torchsoft.solve.kernel.build", "--out", tmp_path]
    subprocess.run([*command, *chosen], check=True, capture_output=True)
    made = {path.name: path.read_bytes() for path in (tmp_path / objects.NAME).iterdir()}
    assert set(made) == {f"{name}.o" for name in levels}
    assert made[f"{objects.level()}.o"] == (objects.found() or objects.build())
    machines = {name: content[18] for name, content in made.items() if content[:4] == b"\x7fELF"}
    assert machines.get("linux-aarch64.o") == 183
    assert machines.get("linux-x86-64-v2.o") == 62


# tables
# ----------------------------------------------------------------------


@table.table
class Arrays(NamedTuple):
    """Of two kinds."""

    values: Array
    numbers: IndexMatrix


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("values", np.zeros(4, np.float32)),
        ("values", np.zeros((2, 2))),
        ("values", np.zeros(8)[::2]),
        ("numbers", np.zeros((5, 2), np.int64).T),
    ],
)
def test_an_array_of_another_kind_is_rejected(name, value):
    right = Arrays(np.zeros(4), np.zeros((2, 5), np.int64))
    table.address(right)
    with pytest.raises(TypeError, match=f"`{name}` of Arrays must be a C-contiguous array of"):
        table.address(right._replace(**{name: value}))
