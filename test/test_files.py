"""Files are written whole or not at all."""

import os
import stat
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from support.killing import full_disk, killed, names

from deworldsg_ros.base import files


@pytest.mark.parametrize("content", [b"", b"new", "new", lambda file: file.write(b"new")])
def test_the_file_is_replaced_and_nothing_else_stays(tmp_path, content):
    path = tmp_path / "a.json"
    path.write_bytes(b"old")
    files.write_atomically(path, content)
    assert path.read_bytes() == (b"" if content == b"" else b"new")
    assert names(tmp_path) == ["a.json"]


@pytest.mark.parametrize("error", [OSError("disk full"), ValueError("bad"), KeyboardInterrupt()])
def test_a_failed_write_keeps_the_old_file(tmp_path, error):
    path = tmp_path / "a.json"
    path.write_bytes(b"old")

    def fail(file):
        file.write(b"half")
        raise error

    with pytest.raises(type(error)):
        files.write_atomically(path, fail)
    assert path.read_bytes() == b"old" and names(tmp_path) == ["a.json"]


def test_writers_of_one_file_do_not_mix(tmp_path):
    path = tmp_path / "a.bin"
    contents = [bytes([value]) * 200_000 for value in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda content: files.write_atomically(path, content), contents * 4))
    assert path.read_bytes() in contents and names(tmp_path) == ["a.bin"]


def test_the_file_has_the_usual_permissions(tmp_path):
    (tmp_path / "usual").write_bytes(b"")
    files.write_atomically(tmp_path / "ours", b"")
    modes = [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("usual", "ours")]
    assert modes[0] == modes[1]


def test_a_folder_that_cannot_be_made_is_reported_before_writing(tmp_path):
    files.check_writable(tmp_path / "maps" / "a.map")
    assert names(tmp_path / "maps") == []
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OSError):
        files.check_writable(tmp_path / "file" / "a.map")
    with pytest.raises(IsADirectoryError):
        files.check_writable(tmp_path / "maps")


def test_a_link_stays_and_the_file_that_it_names_is_replaced(tmp_path):
    (tmp_path / "disk").mkdir()
    link = tmp_path / "a.map"
    link.symlink_to(tmp_path / "disk" / "a.map")
    files.write_atomically(link, b"1")
    files.write_atomically(link, b"2")
    assert link.is_symlink() and (tmp_path / "disk" / "a.map").read_bytes() == b"2"
    assert names(tmp_path / "disk") == ["a.map"]


def test_a_pipe_is_written_and_not_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    read: list[bytes] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()))
    reader.start()
    files.write_atomically(pipe, b"graph")
    reader.join(5)
    assert read == [b"graph"] and names(tmp_path) == ["pipe"]


def test_the_file_before_stays_under_its_name(tmp_path):
    path, previous = tmp_path / "a.map", tmp_path / "a.map.previous"
    for content in (b"1", b"2", b"3"):
        files.write_atomically(path, content, previous=previous)
    assert (path.read_bytes(), previous.read_bytes()) == (b"3", b"2")


@pytest.mark.parametrize("size", [0, 1, 4095, 8192, 99_999])
def test_a_full_disk_keeps_the_old_file(tmp_path, size):
    path = tmp_path / "a.json"
    path.write_bytes(b"old")
    with full_disk(size), pytest.raises(OSError, match="File too large"):
        files.write_atomically(path, bytes(100_000), previous=tmp_path / "before")
    assert path.read_bytes() == b"old" and names(tmp_path) == ["a.json"]


FILES = ("config.yaml", "graph.json", "graph.png", "run.json")


def write_run(folder: Path, run: int) -> None:
    """Files of one run, each with its number and complete by its length; odd runs lack one."""
    with files.together(folder, FILES) as staged:
        for name in FILES[run % 2 :]:
            (staged / name).write_bytes(b"%05d" % run * 2000)


def run_in(folder: Path) -> set[bytes]:
    """Numbers of the runs whose files are in a folder."""
    present = [folder / name for name in FILES if (folder / name).exists()]
    contents = [path.read_bytes() for path in present]
    assert all(content == content[:5] * 2000 for content in contents)
    return {content[:5] for content in contents}


def test_files_of_two_runs_are_never_side_by_side(tmp_path):
    (tmp_path / "theirs").write_text("theirs")
    for run in (2, 3, 4):
        write_run(tmp_path, run)
        assert names(tmp_path) == sorted(["theirs", *FILES[run % 2 :]])
        assert run_in(tmp_path) == {b"%05d" % run}


def test_a_name_that_is_a_folder_is_refused_at_the_start(tmp_path):
    (tmp_path / "run.json").mkdir()
    with pytest.raises(IsADirectoryError), files.together(tmp_path, FILES):
        pytest.fail("the run has begun")


def test_a_kill_between_two_renames_is_completed_by_the_next_run(tmp_path):
    write_run(tmp_path, 2)
    # As it is left: complete, one file is in place, one is to be removed.
    ready = tmp_path / f"{files.PREFIX}x{files.READY}"
    (ready / "config.yaml").mkdir(parents=True)
    (tmp_path / "graph.png").unlink()
    (tmp_path / "graph.json").write_bytes(b"00003" * 2000)
    for name in ("graph.png", "run.json"):
        (ready / name).write_bytes(b"00003" * 2000)
    files.remove_left_overs(tmp_path)
    assert run_in(tmp_path) == {b"00003"} and names(tmp_path) == [*FILES[1:]]


def test_what_a_living_process_writes_is_no_left_over(tmp_path):
    (tmp_path / f"{files.PREFIX}dead{files.PARTIAL}").write_text("half")
    (tmp_path / f"{files.PREFIX}dead2{files.PARTIAL}").mkdir()
    with files.temporary_folder(tmp_path) as folder:
        (folder / "a").write_text("a")
        files.write_atomically(tmp_path / "b", b"b")
        assert names(tmp_path) == sorted([folder.name, "b"])
        assert (folder / "a").exists()
    assert names(tmp_path) == ["b"]


def test_a_lock_is_held_once_and_a_dead_process_holds_none(tmp_path):
    path = tmp_path / "a.map"
    message = f"process {os.getpid()} writes it; end that"
    with (
        files.FileLock(path),
        files.FileLock.unless_held(path),
        pytest.raises(BlockingIOError, match=message),
    ):
        files.FileLock(path)
    assert names(tmp_path) == []
    killed(lambda: files.FileLock(path) and threading.Event().wait(), 0.1)
    assert names(tmp_path) == [".a.map.lock"]
    with files.FileLock(path):
        pass
    assert names(tmp_path) == []
