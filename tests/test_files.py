"""Files appear whole or not at all, last, and leave nothing behind."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from torchsoft import csvfile, files
from torchsoft.files import (
    PARTIAL,
    check_seal,
    claim,
    held,
    remove_partials,
    replacing,
    seal,
    write_json,
)
from torchsoft.physics.mesh.quads import read_quads
from torchsoft.rigs.control import LOOP, read_network
from torchsoft.rigs.motion import read_column
from torchsoft.solve.netcdf import load
from torchsoft.sysid.result import load_answer
from torchsoft.tables import line, plain, read_toml

DIE = """
import os, sys
from pathlib import Path
from torchsoft.files import replacing
with replacing(sys.argv[1]) as partial:
    partial.write_bytes(b"half")
    os._exit(9)
"""


def write(path: Path, data: bytes) -> None:
    with replacing(path) as partial:
        partial.write_bytes(data)


def fail(path: Path, error: BaseException) -> None:
    with replacing(path) as partial:
        partial.write_bytes(b"half")
        raise error


def test_a_file_is_replaced_at_the_end(tmp_path):
    path = tmp_path / "new" / "folder" / "file"
    write(path, b"old")
    with replacing(path) as partial:
        partial.write_bytes(b"new")
        assert path.read_bytes() == b"old"
        assert PARTIAL.search(partial.name)
    assert path.read_bytes() == b"new"
    assert os.listdir(path.parent) == ["file"]


def test_a_folder_is_not_replaced_by_a_file(tmp_path):
    with pytest.raises(IsADirectoryError) as refusal:
        write(tmp_path, b"new")
    assert str(refusal.value) == f"{tmp_path} is a folder; name a file, perhaps one in it"
    assert os.listdir(tmp_path) == []
    assert not [path for path in tmp_path.parent.iterdir() if PARTIAL.search(path.name)]


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path, error):
    path = tmp_path / "file"
    write(path, b"old")
    with pytest.raises(type(error)):
        fail(path, error)
    assert (path.read_bytes(), os.listdir(tmp_path)) == (b"old", ["file"])


def test_what_a_killed_writer_left_goes_with_the_next_one(tmp_path):
    """But not the file of one that lives, nor other people's."""
    path = tmp_path / "file"
    assert subprocess.run([sys.executable, "-c", DIE, str(path)], check=False).returncode == 9
    (dead,) = tmp_path.iterdir()
    for name in ("file.partial", "file.old.partial", "other.0123456789abcdef.partial"):
        (tmp_path / name).write_bytes(b"mine")
    with replacing(path) as mine:
        assert not dead.exists()
        write(path, b"another writer")
        remove_partials(tmp_path.iterdir())
        assert mine.exists()
        mine.write_bytes(b"done")
    assert path.read_bytes() == b"done"
    assert sorted(os.listdir(tmp_path)) == ["file", "file.old.partial", "file.partial"]


def test_a_new_name_is_taken_where_another_process_holds_a_partial_file(tmp_path, monkeypatch):
    """One that takes it for a file that a killed writer left."""
    locks, taken = [None], []
    own = lambda path: taken.append(path) or (locks.pop() if locks else held(path))
    monkeypatch.setattr(files, "held", own)
    with replacing(tmp_path / "a.txt") as partial:
        partial.write_text("whole")
    assert (tmp_path / "a.txt").read_text() == "whole"
    assert len({one for one in taken if one.suffix == ".partial"}) == 2


def test_a_sealed_file_is_read_as_it_was_written_or_not_at_all(tmp_path):
    path, content = tmp_path / "file", bytes(range(32))
    path.write_bytes(content)
    seal(path)
    whole = path.read_bytes()
    assert whole.startswith(content)
    assert check_seal(path) == path
    for i in range(len(whole)):
        for damaged in (whole[:i] + bytes([whole[i] ^ 1]) + whole[i + 1 :], whole[:i]):
            path.write_bytes(damaged)
            with pytest.raises(ValueError, match=r"is damaged|no checksum"):
                check_seal(path)


@pytest.mark.parametrize(
    ("read", "name"),
    [
        (read_toml, "a.toml"),
        (lambda path: csvfile.read(path, {}, lambda *_: ""), "a.csv"),
        (lambda path: read_column(path, "x", "m"), "a.csv"),
        (lambda path: read_network(path, LOOP), "a.npz"),
        (lambda path: read_quads(path, "m"), "a.msh"),
        (load, "a.nc"),
        (load_answer, "a.json"),
    ],
)
def test_only_regular_files_of_a_stated_size_are_read(read, name, tmp_path):
    pipe, device, large = (tmp_path / kind / name for kind in ("pipe", "device", "large"))
    for path in (pipe, device, large):
        path.parent.mkdir()
    os.mkfifo(pipe)
    device.symlink_to("/dev/zero")
    with large.open("wb") as file:
        file.truncate(2**42)  # a hole
    for path, words in (
        (pipe, "is not a regular file"),
        (device, "is not a regular file"),
        (large, "MB, but at most"),
    ):
        with pytest.raises(ValueError, match=words) as refusal:
            read(path)
        assert str(path) in str(refusal.value)


def test_a_folder_of_other_files_is_not_written_to(tmp_path):
    other, own = tmp_path / "other", tmp_path / "own"
    other.mkdir()
    (other / "summary.json").write_text("mine")
    with pytest.raises(
        ValueError, match=r"--out: .*other holds summary\.json, which is no result .* use --force"
    ):
        claim(other)
    claim(other, force=True)
    for _ in range(2):
        claim(own)
        write_json(own / "summary.json", {"torchsoft": "0"})


def test_characters_that_a_terminal_obeys_are_escaped():
    assert plain("a\x1b[31mb\u202ec\u200b\nd é µ") == "a\\x1b[31mb\\u202ec\\u200b\nd é µ"
    assert line("a\x07\n b") == "a\\x07 b"
