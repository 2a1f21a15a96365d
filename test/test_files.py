"""Files are written whole or not at all."""

import os
import signal
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


@pytest.mark.parametrize("name", ["pipe", "link"])
def test_a_pipe_is_refused_and_does_not_block(tmp_path, name):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("pipe")
    writers = [files.write_atomically, lambda path, _: files.check_writable(path)]
    for write in [*writers, lambda path, _: files.together(path.parent, [name]).__enter__()]:
        with pytest.raises(OSError, match="pipe or a device: expected a regular file"):
            write(tmp_path / name, b"graph")
    assert names(tmp_path) == ["link", "pipe"]


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


def temporary(folder: Path, suffix: str, number: int = 1) -> Path:
    return folder / f"{files.PREFIX}{number:032x}{suffix}"


# Before the kill; of seven: four old files away, three new ones in.
@pytest.mark.parametrize("moves", range(7))
def test_a_kill_between_two_renames_is_undone_or_completed_by_the_next_run(
    tmp_path, moves, monkeypatch
):
    write_run(tmp_path, 2)
    real, left = Path.rename, iter(range(moves))

    def rename(path, target):
        is_move = path.suffix != files.PARTIAL and files.READY in f"{path}{target}"
        if is_move and next(left, None) is None:
            os.kill(os.getpid(), signal.SIGKILL)
        return real(path, target)

    def write():
        monkeypatch.setattr(Path, "rename", rename)
        write_run(tmp_path, 5)

    killed(write, 0.3)
    assert len(run_in(tmp_path)) <= 1
    files.remove_left_overs(tmp_path)
    run = 2 if moves < 4 else 5
    assert run_in(tmp_path) == {b"%05d" % run} and names(tmp_path) == [*FILES[run % 2 :]]


def plant(folder: Path, ready: Path) -> None:
    """What a run leaves: a file for a place that is taken, and a link for a free one."""
    ready.mkdir(mode=0o700)
    (ready / "room.map").write_text("theirs")
    (ready / "graph.json").symlink_to("/etc/passwd")
    (folder / "room.map").write_text("ours")


@pytest.mark.parametrize("where", ["here", "owner", "mode", "name", "link"])
def test_what_others_plant_replaces_nothing(tmp_path, where):
    folder, elsewhere = tmp_path / "shared", tmp_path / "elsewhere"
    folder.mkdir()
    ready = temporary(folder, files.READY)
    if where == "link":
        plant(folder, elsewhere)
        ready.symlink_to(elsewhere)
    else:
        ready = ready if where != "name" else folder / f"{files.PREFIX}x{files.READY}"
        plant(folder, ready)
    if where == "mode":
        ready.chmod(0o777)
    if where == "owner":
        if os.geteuid():
            pytest.skip("needs root, to give a folder away")
        (folder / "room.map").unlink()  # not even a free place is taken
        os.chown(ready, 12345, 12345)
    before = set(names(folder))
    files.write_atomically(folder / "b", b"b")
    assert (folder / "room.map").exists() == (where != "owner")
    assert where == "owner" or (folder / "room.map").read_text() == "ours"
    # Only what this user alone can have left is removed.
    assert set(names(folder)) == {*before, "b"} - ({ready.name} if where == "here" else set())


def test_a_file_that_cannot_be_moved_away_keeps_the_files_of_the_run_before(tmp_path, monkeypatch):
    write_run(tmp_path, 2)
    real = Path.rename

    def rename(path, target):
        if path == tmp_path / "graph.json":  # of another user, in a sticky folder
            raise PermissionError(1, "Operation not permitted")
        return real(path, target)

    monkeypatch.setattr(Path, "rename", rename)
    with pytest.raises(PermissionError):
        write_run(tmp_path, 4)
    assert run_in(tmp_path) == {b"00002"} and names(tmp_path) == [*FILES]


@pytest.mark.parametrize("planted", ["link", "hard link", "owner"])
def test_a_planted_lock_is_refused_and_what_it_names_stays(tmp_path, planted):
    mine, lock = tmp_path / "mine", tmp_path / ".a.map.lock"
    mine.write_text("mine")
    if planted == "link":
        lock.symlink_to(mine)
    elif planted == "hard link":
        os.link(mine, lock)
    elif os.geteuid():
        pytest.skip("needs root, to give a file away")
    else:
        mine.rename(lock)
        os.chown(lock, 12345, 12345)
    with pytest.raises(OSError, match="symbolic links|not this user's own"):
        files.FileLock(tmp_path / "a.map")
    assert lock.read_text() == "mine"


def test_what_a_living_process_writes_is_no_left_over(tmp_path):
    temporary(tmp_path, files.PARTIAL).write_text("half")
    temporary(tmp_path, files.PARTIAL, 2).mkdir(mode=0o700)
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
