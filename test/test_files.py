"""Files are written whole or not at all."""

from __future__ import annotations

import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from deworldsg_ros.files import check_writable, write_atomically


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("content", [b"", b"new", lambda file: file.write(b"new")])
def test_the_file_is_replaced_and_nothing_else_stays(tmp_path, content):
    path = tmp_path / "a.json"
    path.write_bytes(b"old")
    write_atomically(path, content)
    assert path.read_bytes() == (content if isinstance(content, bytes) else b"new")
    assert names(tmp_path) == ["a.json"]


@pytest.mark.parametrize("error", [OSError("disk full"), ValueError("bad"), KeyboardInterrupt()])
def test_a_failed_write_keeps_the_old_file(tmp_path, error):
    path = tmp_path / "a.json"
    path.write_bytes(b"old")

    def fail(file):
        file.write(b"half")
        raise error

    with pytest.raises(type(error)):
        write_atomically(path, fail)
    assert path.read_bytes() == b"old" and names(tmp_path) == ["a.json"]


def test_writers_of_one_file_do_not_mix(tmp_path):
    path = tmp_path / "a.bin"
    contents = [bytes([value]) * 200_000 for value in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda content: write_atomically(path, content), contents * 4))
    assert path.read_bytes() in contents and names(tmp_path) == ["a.bin"]


def test_the_file_has_the_usual_permissions(tmp_path):
    (tmp_path / "usual").write_bytes(b"")
    write_atomically(tmp_path / "ours", b"")
    modes = [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("usual", "ours")]
    assert modes[0] == modes[1]


def test_a_folder_that_cannot_be_made_is_reported_before_writing(tmp_path):
    check_writable(tmp_path / "maps" / "a.map")
    assert names(tmp_path / "maps") == []
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OSError):
        check_writable(tmp_path / "file" / "a.map")
