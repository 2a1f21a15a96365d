"""A bag is data: it runs no program, fills no memory, and no file of it leads to another."""

import os
import sqlite3
import struct
from pathlib import Path

import pytest
from rosbags.rosbag2 import CompressionMode
from support.recordings import STRING, camera_items, read_bag, stamp_ns, text_items, write_bag

from deworldsg_ros.recordings.bags import storage
from deworldsg_ros.recordings.bags.storage import RawBag, salvage_sqlite
from deworldsg_ros.recordings.recording import open_recording, open_source
from deworldsg_ros.recordings.replaying import write_mcap
from deworldsg_ros.recordings.source import CAMERA_INFO, POSE_STAMPED, typestore
from deworldsg_ros.scene.errors import RecordingError

COUNT = 4


def text_bag(folder: Path, storage: str, mode: CompressionMode, times: list[int]) -> Path:
    """A bag of texts of 600 kB, two in a chunk, which pack to almost nothing."""
    items = text_items((time_ns, "x" * 600_000) for time_ns in times)
    return write_bag(folder, items, storage, mode)


# --- SQLite ----------------------------------------------------------------------------------

ROWS = "WITH c(x) AS (VALUES (1), (2)) SELECT x AS id, 1 AS topic_id, x AS timestamp"
PROGRAMS = {
    "view": f"DROP TABLE messages; CREATE VIEW messages AS {ROWS}, zeroblob(16) AS data FROM c",
    "view called a table": f"""
        DROP TABLE messages; CREATE VIEW messages AS {ROWS}, zeroblob(16) AS data FROM c;
        PRAGMA writable_schema = ON; UPDATE sqlite_master SET type = 'table' WHERE type = 'view'""",
    "generated column": """
        DROP TABLE messages; CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp,
        data BLOB GENERATED ALWAYS AS (zeroblob(16))); INSERT INTO messages VALUES(1, 1, 1)""",
    "short form": """
        DROP TABLE messages; CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp,
        "data"as/**/(zeroblob(16))); INSERT INTO messages VALUES(1, 1, 1)""",
    "view of topics": """
        DROP TABLE topics; CREATE VIEW topics AS SELECT 1 AS id, '/s' AS name, 'x' AS type,
        'cdr' AS serialization_format, '' AS offered_qos_profiles, '' AS type_description_hash""",
    "virtual table": "CREATE VIRTUAL TABLE x USING fts3(y)",
    "trigger": "CREATE TRIGGER x INSERT ON messages BEGIN SELECT 1; END",
}


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("place", ["folder", "folder, other name", "salvaged", "file"])
def test_a_database_that_computes_its_rows_is_refused(tmp_path, program, place):
    bag = write_bag(tmp_path / "bag", camera_items(2), "sqlite3")
    file = bag / "bag.db3"
    with sqlite3.connect(file) as database:
        database.executescript(PROGRAMS[program])
    database.close()
    if place == "folder, other name":
        file.rename(bag / "notes.txt")
        metadata = (bag / "metadata.yaml").read_text()
        (bag / "metadata.yaml").write_text(metadata.replace("bag.db3", "notes.txt"))
    if place == "salvaged":
        (bag / "metadata.yaml").unlink()
    with pytest.raises(RecordingError, match="is computed"):
        read_bag(file if place == "file" else bag)


@pytest.mark.parametrize("name", ["a#1.db3", "new?mode=rwc&x=.db3", "..%2Foutside%2Foutside.db3"])
def test_a_database_is_the_file_of_its_name(tmp_path, name):
    write_bag(tmp_path / "outside", camera_items(1), "sqlite3")
    bag = write_bag(tmp_path / "bag", camera_items(COUNT), "sqlite3")
    bag = bag.rename(tmp_path / "50%2Fb #1?mode=rwc&x=")
    file, metadata = (bag / "bag.db3").rename(bag / name), bag / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("bag.db3", name))
    before = sorted(tmp_path.rglob("*"))
    (messages, losses), (of_file, _) = read_bag(bag), read_bag(file)
    assert len(messages) == len(of_file) == 4 * COUNT
    assert not losses
    assert len(list(salvage_sqlite(file, print))) == 4 * COUNT
    assert sorted(tmp_path.rglob("*")) == before


# --- zstd ------------------------------------------------------------------------------------


def test_a_compressed_file_unpacks_to_a_multiple_of_its_size(tmp_path, monkeypatch):
    bag = text_bag(tmp_path / "bag", "sqlite3", CompressionMode.FILE, [1, 2, 3])
    assert [message.log_time_ns for message in read_bag(bag)[0]] == [1, 2, 3]
    monkeypatch.setattr(storage, "MIN_FILE_BYTES", 1_000_000)
    with pytest.raises(RecordingError, match="more than 1000000 bytes"):
        read_bag(bag)


@pytest.mark.parametrize("plugin", ["mcap", "sqlite3"])
def test_a_compressed_message_unpacks_to_a_limit(tmp_path, monkeypatch, plugin):
    bag = text_bag(tmp_path / "bag", plugin, CompressionMode.MESSAGE, [1, 2])
    whole, _ = read_bag(bag)
    assert [len(message.data) for message in whole] == [600_009] * 2
    metadata = (bag / "metadata.yaml").rename(tmp_path / "metadata.yaml")
    assert read_bag(bag)[0] == whole
    metadata.rename(bag / "metadata.yaml")
    monkeypatch.setattr(storage, "MAX_CHUNK_BYTES", 500_000)
    messages, losses = read_bag(bag)
    assert messages == [] and "unpacks to more than" in losses[0]


def test_chunks_that_overlap_in_time_are_few(tmp_path, monkeypatch):
    orders = {"a": list(range(12)), "b": [0, 9, 1, 8, 2, 7, 3, 6]}
    one_by_one, overlapping = (
        text_bag(tmp_path / name, "mcap", CompressionMode.STORAGE, times)
        for name, times in orders.items()
    )
    assert len(read_bag(overlapping)[0]) == 8
    monkeypatch.setattr(storage, "MAX_BYTES_AT_ONCE", 4_000_000)
    assert len(read_bag(one_by_one)[0]) == 12
    for path in (overlapping, overlapping / "b.mcap"):
        with pytest.raises(RecordingError, match=r"4800\d+ bytes"):
            read_bag(path)


def test_empty_records_of_a_chunk_end_it(tmp_path, monkeypatch):
    monkeypatch.setattr(storage._Tables, "take", None)  # no record is looked at
    size = 9 * 1000
    packed = storage.zstd.compress(bytes(size))
    chunk = struct.pack("<QQQI", 0, 1, size, 0) + struct.pack("<I4sQ", 4, b"zstd", len(packed))
    path = tmp_path / "zeros.mcap"
    record = struct.pack("<BQ", storage.CHUNK, len(chunk + packed)) + chunk + packed
    path.write_bytes(storage.MAGIC + record)
    with pytest.raises(RecordingError, match="no message"):
        RawBag(path)


@pytest.mark.parametrize("place", ["first", "salvaged"])
def test_a_record_of_gigabytes_is_not_read(tmp_path, place):
    size = 12 << 30
    bag = write_bag(tmp_path / "bag", camera_items(1), "mcap")
    (file,) = bag.glob("*.mcap")
    content = file.read_bytes()
    huge = struct.pack("<BQ", 0x01 if place == "first" else 0x0A, size)
    with file.open("wb") as out:
        out.write(storage.MAGIC + huge)
        out.truncate(out.tell() + size)  # takes no space on the disk
        out.seek(0, os.SEEK_END)
        out.write(content[8:])
    (bag / "metadata.yaml").unlink()
    messages, losses = read_bag(bag)
    assert len(messages) == 4
    assert any(f"{size} bytes and is left out" in loss for loss in losses)


# --- topics of two types -----------------------------------------------------------------------

DEPTH = "/camera/depth/image_raw/compressedDepth"
RGB = "/camera/color/image_raw/compressed"
INFO = "/camera/color/camera_info"


@pytest.mark.parametrize("plugin", ["mcap", "sqlite3"])
@pytest.mark.parametrize("has_metadata", [True, False])
@pytest.mark.parametrize(
    ("topic", "other"),
    [(DEPTH, CAMERA_INFO), ("/camera/pose", CAMERA_INFO), (INFO, POSE_STAMPED),
     (RGB, POSE_STAMPED), (RGB, STRING)],
)  # fmt: skip
def test_a_topic_of_two_types_is_read_by_one(tmp_path, plugin, has_metadata, topic, other):
    items = camera_items(COUNT)
    messages = {msgtype: message for _, msgtype, _, message in items}
    messages[STRING] = typestore().types[STRING](data="x" * 50)
    wrong = [(topic, other, stamp_ns(index), messages[other]) for index in range(COUNT)]
    write_bag(tmp_path / "bag", [*wrong, *items], plugin)
    if not has_metadata:
        (tmp_path / "bag" / "metadata.yaml").unlink()
    recording = open_recording(tmp_path / "bag")
    assert len(list(recording.frames())) == COUNT
    assert not recording.drops
    source = open_source(tmp_path / "bag")
    assert write_mcap(source.raw_messages(), tmp_path / "out.mcap") == len(items)
