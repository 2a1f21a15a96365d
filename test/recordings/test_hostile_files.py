"""Sizes, depths, numbers and text of files from outside are checked before work is done."""

import os
import pickle
import struct
import zlib
from pathlib import Path

import cv2
import lz4.frame
import numpy as np
import pytest
from support.recordings import SCAN, many_scans

from deworldsg_ros.base.files import parse_any_json, parse_yaml, read_regular
from deworldsg_ros.base.words import stamp_ns_from_text
from deworldsg_ros.cli.configuration import effective_config
from deworldsg_ros.evaluation.predictions import load_pickle, read_predictions
from deworldsg_ros.recordings.bags.storage import MAX_CHUNK_BYTES, bound_decompression, decompress
from deworldsg_ros.recordings.folders.frame_files import read_pose
from deworldsg_ros.scene.errors import ConfigurationError, EvaluationError, RefusedInput
from deworldsg_ros.streams.images import decode, encoded_size

YAML = (
    *("[" * 100_000, "- " * 100_000, "? " * 100_000, "a: &a [1]\nb: *a", "x: 2020-13-45"),
    *("x: " + "1" * 5000, "\udcff", "a: b: c", "a: 1\nb:\n  - c: 2\n    c: 3"),
)
JSON = ("[" * 100_000, '"\\ud800"', "{", "1" * 5000)
STAMPS = ("1e9999999", "1e400", "nan", "-inf", "sNaN", "2147483648", "x")
OPTIONS = (".inf", ".nan", "1e400", "[" * 1000, "1" * 5000, "\udcff")


@pytest.mark.parametrize("text", YAML)
def test_yaml_is_bounded_and_has_one_error(tmp_path, text):
    content = text.encode(errors="surrogateescape")
    with pytest.raises(ValueError, match=r"\w"):
        parse_yaml(content)
    (tmp_path / "config.yaml").write_bytes(content)
    with pytest.raises(ConfigurationError, match=r"config\.yaml: \w"):
        effective_config(tmp_path / "config.yaml")


@pytest.mark.parametrize(
    ("reader", "text"),
    [*((parse_any_json, text) for text in JSON), *((stamp_ns_from_text, text) for text in STAMPS)],
)
def test_json_and_stamps_have_one_error(reader, text):
    with pytest.raises(ValueError):
        reader(text.encode() if reader is parse_any_json else text)


@pytest.mark.parametrize("value", OPTIONS)
def test_options_are_finite_numbers(value):
    with pytest.raises(ConfigurationError, match="--set"):
        effective_config(None, [f"inputs.max_depth_m={value}"])


def test_a_pose_file_of_megabytes_is_not_parsed(tmp_path):
    path = tmp_path / "frame-000000.pose.txt"
    path.write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n" + " " * 65_536)
    with pytest.raises(RefusedInput, match="65568 bytes: expected at most 65536"):
        read_pose(path)


def test_the_size_of_an_image_is_known_before_it_is_decoded():
    content = b"\x89PNG\r\n\x1a\n"
    for kind, data in (
        (b"IHDR", struct.pack(">IIBBBBB", 65535, 65535, 8, 0, 0, 0, 0)),
        (b"IDAT", zlib.compress(bytes(1 << 20))),
        (b"IEND", b""),
    ):
        content += struct.pack(">I", len(data)) + kind + data
        content += struct.pack(">I", zlib.crc32(kind + data))
    assert encoded_size(content) == (65535, 65535) and len(content) < 5000
    for other in (content, b"", b"GIF89a", b"\xff\xd8\xff", b"P5 1 1"):
        with pytest.raises(ValueError):
            decode(other, cv2.IMREAD_UNCHANGED)


def test_a_jpeg_has_a_bounded_number_of_scans():
    pixels = np.full((64, 64, 3), 128, np.uint8)
    content = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    assert content.count(SCAN) == 10 and decode(content, cv2.IMREAD_COLOR).shape == (64, 64, 3)
    with pytest.raises(ValueError, match="101 scans"):
        decode(many_scans(content, 101), cv2.IMREAD_COLOR)
    decode(memoryview(many_scans(content, 100)), cv2.IMREAD_COLOR)


def nested(depth: int) -> list:
    item: list = []
    for _ in range(depth):
        item = [item, item]
    return item


def in_itself() -> list:
    item: list = []
    item.append(item)
    return item


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (pickle.dumps(nested(60)), "stands for more than"),
        (pickle.dumps(in_itself()), "contains itself"),
        (b"]r\xff\xff\xff\x7f.", "memo index"),
        (b'{"num_classes": 1000000000000, "num_predicates": 1, "scans": {}}', "10000"),
    ],
    ids=["shared lists", "itself", "large memo", "many classes"],
)
def test_predictions_without_end_are_refused(tmp_path, content, words):
    path = tmp_path / "predictions.json"
    path.write_bytes(content)
    with pytest.raises(EvaluationError, match=words):
        read_predictions(path) if content[:1] == b"{" else load_pickle(content, "x.pkl")


def test_chunks_unpack_to_what_they_declare():
    bound_decompression()
    packed = lz4.frame.compress(bytes(1 << 24))
    assert decompress("lz4", packed, 1 << 24) == bytes(1 << 24)
    for size in (1, (1 << 24) + 1, MAX_CHUNK_BYTES + 1):
        with pytest.raises(ValueError, match="a chunk"):
            decompress("lz4", packed, size)


def test_only_regular_files_of_a_size_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "large").write_bytes(bytes(9))
    (tmp_path / "good").write_bytes(b"12345678")
    for path in (tmp_path / "pipe", tmp_path / "large", tmp_path, Path("/dev/zero"), Path("\0")):
        with pytest.raises(OSError):
            read_regular(path, 8)
    assert read_regular(tmp_path / "good", 8) == b"12345678"
