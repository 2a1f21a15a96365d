"""Results are complete and of one run, whatever happens while they are written."""

import itertools
import re
import time
from contextlib import closing
from pathlib import Path

import pytest
from support.cli import DEMO_ROOM, printed, refusal
from support.killing import full_disk, killed, moments_s, names
from support.recordings import camera_items, write_bag
from support.view import make_room

from deworldsg_ros.base.files import PREFIX, remove_left_overs, write_atomically
from deworldsg_ros.cli import outputs
from deworldsg_ros.config import Config, OutputConfig
from deworldsg_ros.graph.graph_files import GRAPH_FILE, read_graph, write_graph
from deworldsg_ros.recordings.recording import open_source
from deworldsg_ros.recordings.replaying import write_mcap

PACKAGE = Path(outputs.__file__).resolve().parents[1]
# Whatever writes a file without `deworldsg_ros/base/files.py`.
WRITES = re.compile(
    r"write_text|write_bytes|open\([^)]*[\"'][wax]b?\+?[\"']|imwrite\(|savetxt\(|\.tofile\(|to_csv\("
    r"|json\.dump\(|pickle\.dump\(|save_file\(|torch\.save\(|tempfile"
)
# The log of a process and the journal of a store grow; a journal's torn end is cut off. The third
# is a lock, which stays empty.
ALLOWED = {"base/files.py", "cli/demo.py", "store/store.py", "store/database.py"}


def test_nothing_is_written_past_the_helper():
    found = [
        f"{path.relative_to(PACKAGE)}: {line.strip()}"
        for path in sorted(PACKAGE.rglob("*.py"))
        if str(path.relative_to(PACKAGE)) not in ALLOWED
        for line in path.read_text().splitlines()
        if WRITES.search(line)
    ]
    assert not found
    assert all(WRITES.search((PACKAGE / name).read_text()) for name in ALLOWED)


def write_results(out: Path, run: int) -> None:
    with outputs.writing(out, Config()) as staged:
        write_graph(staged, make_room(3))
        for name in outputs.RESULTS[2:]:
            write_atomically(staged / name, f"{run} " * 2000)


def runs_in(out: Path) -> set[str]:
    texts = [(out / name).read_text() for name in outputs.RESULTS[2:] if (out / name).exists()]
    assert all(text.count(" ") == 2000 for text in texts)
    return {word for text in texts for word in text.split()}


def test_an_interrupted_run_leaves_the_results_of_the_run_before(tmp_path):
    write_results(tmp_path, 1)
    before = {name: (tmp_path / name).read_bytes() for name in names(tmp_path)}
    assert set(before) == set(outputs.RESULTS)
    changed = Config(output=OutputConfig(top_k=2))
    with pytest.raises(KeyboardInterrupt), outputs.writing(tmp_path, changed):
        raise KeyboardInterrupt
    assert {name: (tmp_path / name).read_bytes() for name in names(tmp_path)} == before


def test_a_kill_leaves_results_of_one_run(tmp_path):
    write_results(tmp_path, 0)
    for kill, moment_s in enumerate(moments_s(50, 0.03), start=1):
        killed(lambda run=kill: write_results(tmp_path, run), 0.005 + moment_s)
        assert len(runs_in(tmp_path)) <= 1
        if (tmp_path / GRAPH_FILE).exists():
            assert read_graph(tmp_path).nodes
        remove_left_overs(tmp_path)
        assert len(runs_in(tmp_path)) == 1 and set(names(tmp_path)) == set(outputs.RESULTS)


def test_a_kill_leaves_no_half_recording(tmp_path):
    with closing(open_source(write_bag(tmp_path / "bag", camera_items(6)))) as source:
        messages = list(source.raw_messages())
    out = tmp_path / "out"
    out.mkdir()
    numbers = itertools.count()

    def convert():
        write_mcap(messages, out / f"{next(numbers)}.mcap")

    started_s = time.monotonic()
    convert()
    longest_s, whole = 8 * (time.monotonic() - started_s), 0
    (out / "0.mcap").unlink()
    # A busy machine gives a child no time: then some live longer.
    longer = (longest_s * 2**index for index in range(1, 7))
    for index, moment_s in enumerate(itertools.chain(moments_s(20, longest_s), longer)):
        if index >= 20 and whole:
            break
        killed(convert, 0.005 + moment_s)
        remove_left_overs(out)
        for path in out.iterdir():
            assert path.suffix == ".mcap"
            with closing(open_source(path)) as converted:
                assert len(list(converted.raw_messages())) == len(messages)
            path.unlink()
            whole += 1
    assert whole


def error_of(*command: object) -> str:
    """The one line of a command that fails."""
    (line,) = refusal(*command).strip().splitlines()
    return line


@pytest.mark.parametrize("size", [0, 2000])
def test_convert_on_a_full_disk_or_to_a_read_only_place_is_one_line(tmp_path, size):
    bag = write_bag(tmp_path / "bag", camera_items(6))
    with full_disk(size):
        line = error_of("convert", "auto", bag, tmp_path / "out.mcap")
    assert line == f"error: output {tmp_path}/out.mcap: cannot be written (File too large)"
    assert names(tmp_path) == ["bag"]
    assert "/proc/self/out.mcap" in error_of("convert", "auto", bag, "/proc/self/out.mcap")


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_run_on_a_full_disk_is_one_line_and_keeps_the_results(tmp_path):
    trajectory, room = tmp_path / "poses.txt", tmp_path / "room.map"
    command = ["run", DEMO_ROOM, "--out", tmp_path / "out", "--max-frames", 6]
    command += ["--save-trajectory", trajectory, "--map", room]
    printed(*command)
    files = [*(tmp_path / "out").iterdir(), trajectory, room]
    before = [path.read_bytes() for path in files]
    with full_disk(30_000):
        line = error_of(*command)
    assert re.fullmatch(r"error: --out .*: cannot be written \(File too large\); give .*", line)
    assert [path.read_bytes() for path in files] == before
    everything = [*tmp_path.rglob("*"), *tmp_path.rglob(".*")]
    assert not [path for path in everything if path.name.startswith(PREFIX)]
