"""Compiled kernels on disk: named after what they are made from, checked before they are used, done
without at need."""

import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import pytest

from torchsoft.solve.kernel import cache, compiled
from torchsoft.solve.kernel.run import run


def twice(x: float) -> float:
    return 2.0 * x


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The only folder of the cache, empty, at a start at which nothing has been said."""
    monkeypatch.setattr(cache, "FOLDERS", [tmp_path / "kernels"])
    monkeypatch.setattr(cache, "_said", set())
    return tmp_path / "kernels"


def start() -> Any:
    """The function as after a new start, called once."""
    cache._said.clear()
    kernel = compiled(twice, entry=True)
    assert kernel(3.0) == 6.0
    return kernel


def made(kernel: Any) -> bool:
    """Whether it had to be compiled."""
    return not sum(kernel.stats.cache_hits.values())


def only(folder: Path) -> Path:
    (path,) = folder.iterdir()
    return path


def test_what_is_kept_is_used_at_the_next_start(folder: Path, capsys: Any) -> None:
    assert made(start())
    assert only(folder).stat().st_mode & 0o777 == 0o644
    assert not made(start())
    assert capsys.readouterr().err == ""


def flipped(content: bytes) -> bytes:
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


class Trap:
    """Makes a folder when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.path),)


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda content: b"",
    "cut": lambda content: content[:-100],
    "half of the checksum": lambda content: content[:16],
    "one bit": flipped,
    "other bytes": lambda content: bytes(range(256)) * 100,
    "longer": lambda content: content + b"\0",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_noticed_and_made_again(folder: Path, damage: str, capsys: Any) -> None:
    start()
    path = only(folder)
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    assert made(start())
    assert (
        capsys.readouterr().err
        == f"torchsoft: note: {folder} holds damaged kernels, which are not used\n"
    )
    assert not made(start())


def test_no_file_stands_for_another(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    """Neither for another function's, nor for that of other sources."""
    start()
    thrice = compiled(lambda x: 3.0 * x, entry=True)
    assert thrice(3.0) == 9.0
    first, second = sorted(folder.iterdir())
    second.write_bytes(first.read_bytes())
    assert made(start()) == ("twice" in second.name)
    folder.rename(tmp_path / "changed")
    monkeypatch.setattr(cache, "FOLDERS", [tmp_path / "changed"])
    assert made(start())
    assert capsys.readouterr().err.endswith("changed holds damaged kernels, which are not used\n")


def test_a_planted_pickle_is_not_unpickled(folder: Path, tmp_path: Path) -> None:
    start()
    only(folder).write_bytes(pickle.dumps(Trap(tmp_path / "executed")))
    start()
    assert not (tmp_path / "executed").exists()


def test_what_others_may_change_is_not_used(folder: Path, capsys: Any) -> None:
    """Though its checksum is right."""
    start()
    only(folder).chmod(0o666)
    assert made(start())
    assert capsys.readouterr().err.endswith(
        "holds kernels that other users may change, which are not used\n"
    )
    if os.getuid() == 0:
        os.chown(only(folder), 12345, 12345)
        assert made(start())
    assert not made(start())


def test_where_nothing_can_be_kept_it_says_so_once(folder: Path, capsys: Any) -> None:
    folder.write_text("a file")
    for _ in range(2):
        assert made(start())
    err = capsys.readouterr().err
    assert (
        err
        == 2
        * f"torchsoft: note: compiled kernels cannot be kept in {folder}; compiling at every "
        "start\n"
    )


def test_a_folder_in_place_of_a_file_is_left_alone(folder: Path) -> None:
    start()
    path = only(folder)
    path.unlink()
    path.mkdir()
    assert made(start())
    assert only(folder).is_dir()


def test_a_second_folder_is_read_and_the_first_is_written(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start()
    monkeypatch.setattr(cache, "FOLDERS", [tmp_path / "mine", folder])
    assert not made(start())
    only(folder).unlink()
    assert made(start())
    assert [path.parent.name for path in tmp_path.rglob("*.kernel")] == ["mine"]


def test_the_name_says_everything_that_kernels_are_made_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert cache.NAME in run.stats.cache_path
    names = {cache.made_from()}
    assert names == {cache.NAME}
    with monkeypatch.context() as patch:
        patch.setattr(numba, "__version__", "0.0")
        names.add(cache.made_from())
    with monkeypatch.context() as patch:
        patch.setattr(cache.llvmlite, "__version__", "0.0")
        names.add(cache.made_from())
    with monkeypatch.context() as patch:
        patch.setattr(numba.config, "OPT", 1)
        names.add(cache.made_from())
    for name, text in (
        ("law.py", "a = 1"),
        ("step.py", "b = 2"),
        ("law.py", "a = 3"),
        ("more/law.py", "a = 3"),
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
        monkeypatch.setattr(cache, "SOURCES", (tmp_path,))
        names.add(cache.made_from())
        assert cache.made_from() in names
    assert len(names) == 8
    assert {path.name for path in cache.SOURCES} == {tmp_path.name}


def test_kernels_call_no_code_that_is_not_in_their_name() -> None:
    named = [
        path for root in cache.SOURCES for path in (root.rglob("*.py") if root.is_dir() else [root])
    ]
    assert Path(run.py_func.__code__.co_filename) in named
    assert {path.name for path in named} >= {"stage.py", "interface.py", "invoke.py", "cache.py"}


def test_code_that_changed_since_the_start_is_not_kept(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache, "NAME", "older")
    start()
    assert not folder.exists()


def test_other_processors_have_other_files(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    start()
    kernel = compiled(twice, entry=True)
    monkeypatch.setattr(kernel.targetctx.codegen(), "_tm_features", "+none")
    assert kernel(3.0) == 6.0
    assert made(kernel)
    assert len(list(folder.iterdir())) == 2


def test_folders(monkeypatch: pytest.MonkeyPatch) -> None:
    """NUMBA_CACHE_DIR alone, or beside the sources and in the user's cache, which not every user
    has."""
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(numba.config, "CACHE_DIR", "/chosen")
    assert cache.folders("name") == [Path("/chosen/torchsoft/name")]
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setenv("HOME", "/home/someone")
    beside = cache.HERE / "__pycache__" / "name"
    assert cache.folders("name") == [beside, Path("/home/someone/.cache/torchsoft/name")]
    monkeypatch.setenv("XDG_CACHE_HOME", "/caches")
    assert cache.folders("name") == [beside, Path("/caches/torchsoft/name")]
    monkeypatch.delenv("XDG_CACHE_HOME")

    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", homeless)
    assert cache.folders("name") == [beside]
