"""Raw messages of whole, split and damaged bags."""

import shutil
import sqlite3

import numpy as np
import pytest
from rosbags.rosbag2 import CompressionMode
from support.recordings import camera_items, read_bag, stamp_ns, text_items, write_bag

from deworldsg_ros.recordings.bags.storage import RawBag
from deworldsg_ros.scene.errors import RecordingError

RGB = "/camera/color/image_raw/compressed"
COUNT = 40


@pytest.fixture(scope="module", params=["mcap", "sqlite3"])
def bag(request, tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp("bags") / "bag", camera_items(COUNT), request.param)


def storage_file(bag):
    return next(file for file in bag.iterdir() if file.suffix in (".mcap", ".db3"))


def test_folder_and_bare_file_give_all_messages_in_order(bag):
    for path in (bag, storage_file(bag)):
        messages, losses = read_bag(path, RGB)
        assert [m.log_time_ns for m in messages] == [stamp_ns(i) for i in range(COUNT)]
        assert not losses
    topics = RawBag(bag).topics
    assert {topic.count for topic in topics} == {COUNT}
    assert len(topics) == 4
    assert read_bag(bag, "/nothing") == ([], [])


def test_missing_metadata_is_reported_and_the_files_are_read(bag, tmp_path):
    folder = tmp_path / "killed"
    shutil.copytree(bag, folder)
    (folder / "metadata.yaml").unlink()
    messages, losses = read_bag(folder, RGB)
    assert len(messages) == COUNT
    assert "metadata.yaml is missing" in losses[0]


@pytest.mark.parametrize("kept", [0.95, 0.6])
def test_a_truncated_file_gives_its_beginning_and_reports_the_loss(bag, tmp_path, kept):
    file = storage_file(bag)
    cut = tmp_path / file.name
    content = file.read_bytes()
    cut.write_bytes(content[: int(len(content) * kept)])
    whole, _ = read_bag(file, RGB)
    messages, losses = read_bag(cut, RGB)
    assert losses
    assert all("lost" in loss or "damaged" in loss for loss in losses), losses
    # What is left is in order and unchanged, but for one that the end of the file may cut.
    assert 0 < len(messages) <= COUNT
    times_ns = [message.log_time_ns for message in messages]
    assert times_ns == sorted(set(times_ns))
    assert sum(message not in whole for message in messages) <= 1


def test_a_damaged_chunk_loses_only_its_own_messages(tmp_path):
    # Chunks of a megabyte: large messages make several.
    noise = np.random.default_rng(0).integers(65, 90, (12, 400_000), dtype=np.uint8)
    texts = [letters.tobytes().decode() for letters in noise]
    write_bag(tmp_path / "bag", text_items(enumerate(texts)), "mcap", CompressionMode.STORAGE)
    file = tmp_path / "bag" / "bag.mcap"
    whole, losses = read_bag(file, "/s")
    assert len(whole) == 12 and not losses
    content = bytearray(file.read_bytes())
    start = content.index(b"zstd", content.index(b"zstd") + 4)  # of the second chunk
    content[start + 19 : start + 2000] = b"\xff" * 1981
    file.write_bytes(content)
    messages, losses = read_bag(file, "/s")
    assert any("damaged" in loss for loss in losses)
    times_ns = [message.log_time_ns for message in messages]
    assert len(set(times_ns)) == len(times_ns) < 12
    assert {0, 11} <= set(times_ns)
    assert all(message in whole for message in messages)


def test_damaged_pages_of_a_database_lose_only_their_rows(tmp_path):
    bag = write_bag(tmp_path / "bag", camera_items(COUNT), "sqlite3")
    file = storage_file(bag)
    content = bytearray(file.read_bytes())
    # The middle of the file holds messages; the schema is in the first pages.
    start = len(content) // 2 // 4096 * 4096
    content[start : start + 4096] = b"\xff" * 4096
    file.write_bytes(content)
    messages, losses = read_bag(bag, RGB)
    assert messages
    assert len(messages) < COUNT or losses
    with sqlite3.connect(file) as database, pytest.raises(sqlite3.DatabaseError):
        database.execute("SELECT sum(length(data)) FROM messages").fetchall()


@pytest.mark.parametrize("content", [b"", b"nothing of the kind", b"\x89MCAP0\r\n"])
@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
def test_a_file_that_is_no_bag_is_refused_by_name(tmp_path, content, suffix):
    file = tmp_path / f"broken{suffix}"
    file.write_bytes(content)
    with pytest.raises(RecordingError, match="broken"):
        RawBag(file)


def test_a_folder_of_two_bags_is_refused(tmp_path):
    bag = write_bag(tmp_path / "bag", camera_items(1))
    for name in ("a.mcap", "b.mcap"):
        shutil.copy(storage_file(bag), tmp_path / name)
    with pytest.raises(RecordingError):
        RawBag(tmp_path)


def test_parts_of_a_split_bag_are_read_in_order_of_their_numbers(tmp_path):
    for part in range(12):
        items = [item for item in camera_items(12) if item[2] == stamp_ns(part)]
        bag = write_bag(tmp_path / f"part{part}", items)
        shutil.move(storage_file(bag), tmp_path / f"room_{part}.mcap")
        shutil.rmtree(bag)
    messages, _ = read_bag(tmp_path, RGB)
    assert [m.log_time_ns for m in messages] == [stamp_ns(part) for part in range(12)]
