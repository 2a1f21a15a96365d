"""Training clips: read from folders, or cropped from data sets as at run time."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.evaluation import write_dataset
from support.recordings import many_scans
from support.sequences import (
    BLOCKS,
    HEIGHT,
    RELATIONS,
    ROWS,
    WIDTH,
    instance_image,
    write_sequence,
    write_surface,
)

from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.scene.errors import ConfigurationError, RecordingError, RefusedInput
from deworldsg_ros.training.clips import (
    ClipChoice,
    Scan,
    Seen,
    cut_clips,
    of_length,
    read_boxes,
    read_clip_folder,
    read_clips,
    read_frames,
)

CHOICE = ClipChoice(clip_length=4, clips_per_pair=2)
# Blue, green, red of each block.
COLOURS = {1: (250, 10, 10), 2: (10, 250, 10), 3: (10, 10, 250)}


def write_lists(rio, **lists):
    for split, scans in lists.items():
        text = "".join(f"{scan}\n" for scan in scans)
        (rio / "3DSSG_subset" / f"{split}_scans.txt").write_text(text)


def write_rooms(rio, rescans):
    """Write 3RScan.json: the rescans of each reference scan."""
    rooms = [
        {"reference": room, "scans": [{"reference": scan} for scan in scans]}
        for room, scans in rescans.items()
    ]
    (rio / "3RScan.json").write_text(json.dumps(rooms))


@pytest.fixture
def rio(tmp_path):
    """3RScan's layout: one scan of three blocks in a row, whose images are rotated."""
    objects = [(name, number) for number, name, _, _ in BLOCKS]
    root = write_dataset(tmp_path / "set", {"a": (objects, RELATIONS)}, layout="3rscan")
    write_lists(root, train=["a"], test=[])
    write_rooms(root, {"a": []})
    write_surface(write_sequence(root / "data" / "a", frames=10))
    picture = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    for number, colour in COLOURS.items():
        picture[instance_image() == number] = colour
    for path in (root / "data" / "a" / "sequence").glob("*.color.jpg"):
        cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, 100])
    return root


def test_clips_of_3rscan_are_upright_and_show_visible_objects(rio):
    clips = read_clips(rio, CHOICE)
    # Boxes are computed in every eighth frame: the first and the ninth.
    assert [clip.predicates for clip in clips] == [("near",)] * 2 + [("on",)] * 2
    assert {clip.group for clip in clips} == {"a"}
    clip = clips[0].read()
    length, height, width, _ = clip.shape
    assert length == 4
    # Rotated by 90 degrees, columns are rows. Points are pixel centres: one pixel of tolerance.
    assert width == pytest.approx(ROWS[1] - ROWS[0], abs=2)
    assert height == pytest.approx(BLOCKS[1][3] - BLOCKS[0][2], abs=2)
    for sample, object_id in zip(clips[0].boxes.reshape(2, 4), (1, 2)):
        x1, y1, x2, y2 = sample * (width, height, width, height)
        middle = clip[-1, int((y1 + y2) / 2), int((x1 + x2) / 2)]
        assert np.abs(middle[::-1].astype(int) - COLOURS[object_id]).max() < 60


@pytest.mark.parametrize("harm", [lambda jpeg: many_scans(jpeg, 101), lambda jpeg: jpeg[:100]])
def test_a_frame_that_cannot_be_decoded_refuses_its_clip(rio, harm):
    clip = read_clips(rio, CHOICE)[0]
    for path in (rio / "data" / "a" / "sequence").glob("*.color.jpg"):
        path.write_bytes(harm(path.read_bytes()))
    with pytest.raises(RefusedInput, match="cannot be decoded") as refused:
        clip.read()
    assert refused.value.reason == "unreadable_clip"


def test_hidden_objects_and_unreadable_frames_have_no_boxes(rio):
    sequence = rio / "data" / "a" / "sequence"
    (sequence / "frame-000000.pose.txt").write_text("no matrix")
    assert [clip.predicates for clip in read_clips(rio, CHOICE)] == [("near",), ("on",)]
    for path in sequence.glob("*.depth.pgm"):
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        depth[:, BLOCKS[1][2] :] = 1000  # something else is in front of the table and the book
        cv2.imwrite(str(path), depth)
    with pytest.raises(ConfigurationError, match="no frame of the split 'train'"):
        read_clips(rio, CHOICE)


@pytest.mark.parametrize(
    ("lists", "split", "message"),
    [
        ({"train": [], "test": ["a"]}, "train", "no scans of the split 'train'.*lists 0"),
        ({"train": ["absent"], "test": []}, "train", "no scans of the split 'train'.*lists 1"),
        ({"train": ["a"], "test": ["a"]}, "train", "'train'.* are test scans, too, first 'a'"),
        ({"validation": ["a"], "test": ["a"]}, "validation", "'validation'.* are test scans"),
    ],
)
def test_scans_outside_of_the_split_are_refused(rio, lists, split, message):
    write_lists(rio, **lists)
    with pytest.raises(ConfigurationError, match=message):
        read_clips(rio, ClipChoice(4, 2, split))
    # Test scans are taken only when named.
    if "a" in lists["test"]:
        assert {clip.group for clip in read_clips(rio, ClipChoice(4, 2, "test"))} == {"a"}


@pytest.mark.parametrize(
    ("window", "shown"),
    [
        ("last_frames", [10, 20, 30, 40, 50, 60]),
        # It begins when both objects are seen.
        ("valid_interval", [30, 40, 50, 60, 60, 60]),
    ],
)
def test_clips_show_the_union_of_both_boxes(tmp_path, window, shown):
    """Frame 2 shows one object, frame 4 is not annotated, frame 7 shows one object."""
    frames = []
    for number in range(9):
        path = tmp_path / f"{number}.png"
        cv2.imwrite(str(path), np.full((40, 60, 3), 10 * number, np.uint8))
        seen = {
            1: Seen(np.array([5.0, 5, 25, 20]), 2.0),
            # Eq. 8 refuses the depth of frame 8.
            2: Seen(np.array([14.0 + number, 10, 50, 35]), 2.5 if number == 8 else 2.2),
        }
        if number in (2, 7):
            del seen[2]
        frames.append((path, None if number == 4 else seen))
    scan = Scan("scan", "room", frames, (60, 40))
    relations = [(2, 1, "on"), (1, 9, "near"), (2, 1, "near"), (2, 1, "on")]
    choice = ClipChoice(clip_length=6, clips_per_pair=9, window=window)
    clips = cut_clips(scan, relations, choice)
    # One clip has both predicates of its pair: equal clips with other labels would contradict.
    names = {(c.scan, c.group, c.pair, c.predicates) for c in clips}
    assert names == {("scan", "room", "room 1 2", ("on", "near"))}
    assert len({clip.key for clip in clips}) == len(clips) == 5
    last = clips[-1].read()
    assert last.shape == (6, 31, 46, 3)  # pixels 5 to 50 by 5 to 35, the union
    assert last[:, 0, 0, 0].tolist() == shown
    np.testing.assert_allclose(clips[-1].boxes[4:], [0, 0, 20 / 46, 15 / 31])
    every = replace(choice, geo_cost_threshold=1.0)
    assert len(cut_clips(scan, relations, every)) == 6
    assert cut_clips(replace(scan, frames=[]), relations, choice) == []


def test_training_clips_have_the_regions_of_clips_at_run_time(tmp_path):
    frames = []
    for number in range(3):
        path = tmp_path / f"{number}.png"
        cv2.imwrite(str(path), np.tile(np.arange(60, dtype=np.uint8)[:, None], (40, 1, 3)))
        boxes = np.array([[5.0, 5, 20, 20], [10, 8, 25, 30]]) + [10 * number, 0] * 2
        frames.append((path, {end: Seen(boxes[end], 2.0) for end in (0, 1)}))
    scan = Scan("scan", "room", frames, (60, 40))
    columns = {}
    for crop in ("last_frame", "clip_union", "each_frame"):
        clip = cut_clips(scan, [(0, 1, "on")], ClipChoice(3, 9, crop=crop))[-1]
        columns[crop] = clip.read()[:, 0, [0, -1], 0].tolist()
        width = columns[crop][-1][1] - columns[crop][-1][0] + 1
        left = columns[crop][-1][0]
        np.testing.assert_allclose(clip.boxes[[0, 2]] * width + left, [25, 40], atol=1e-4)
    assert columns["last_frame"] == [[25, 45]] * 3 and columns["clip_union"] == [[5, 45]] * 3
    assert columns["each_frame"] == [[5, 25], [15, 35], [25, 45]]


def test_scans_of_one_room_are_one_group(rio, caplog):
    """3RScan.json names the rescans of a room; Replica has six scans of one apartment."""
    shutil.copytree(rio / "data" / "a", rio / "data" / "b")
    for name in ("3DSSG/objects.json", "3DSSG_subset/relationships20.json"):
        scans = json.loads((rio / name).read_text())["scans"]
        (rio / name).write_text(json.dumps({"scans": [*scans, {**scans[0], "scan": "b"}]}))
    write_lists(rio, train=["a", "b"], test=["c"])
    write_rooms(rio, {"b": ["a"], "c": []})
    clips = read_clips(rio, CHOICE)
    assert {(clip.scan, clip.group) for clip in clips} == {("a", "b"), ("b", "b")}
    assert {clip.pair for clip in clips} == {"b 1 2", "b 2 3"} and not caplog.messages
    write_rooms(rio, {"c": ["a"], "b": []})
    assert len({clip.group for clip in read_clips(rio, CHOICE)}) == 2
    assert "1 rooms of the split 'train'" in caplog.text
    write_rooms(rio, {"a": []})
    with pytest.raises(RecordingError, match="does not list scan 'b'"):
        read_clips(rio, CHOICE)
    (rio / "3RScan.json").write_text('[{"scans": []}]')
    with pytest.raises(RecordingError, match="expected a list of rooms"):
        read_clips(rio, CHOICE)
    (rio / "3RScan.json").unlink()
    with pytest.raises(RecordingError, match="3RScan.json is missing; .* from the page of 3RScan"):
        read_clips(rio, CHOICE)
    replica = Annotations(write_dataset(rio.parent / "replica", {}), "replica")
    names = ("frl_apartment_0", "frl_apartment_5", "apartment_1", "apartment_2")
    assert [replica.room(name) for name in names] == ["frl_apartment"] * 2 + list(names[2:])


def test_an_index_names_groups_and_boxes(tmp_path):
    path = tmp_path / "bb.txt"
    assert read_boxes(path) == {}
    path.write_text("3 1 2 30 40\n\n")
    assert read_boxes(path)[3].tolist() == [1, 2, 30, 40]
    path.write_text("3 1 2 30\n")
    with pytest.raises(RefusedInput, match="line 1: .*, expected id"):
        read_boxes(path)
    np.savez(tmp_path / "a.npz", frames=np.zeros((3, 8, 9, 3), np.uint8))
    line = {"clip": "a.npz", "predicate": "on", "group": "room 1", "pair": "1 2"}
    boxes = {"subject_box": [0, 0, 0.5, 0.5], "object_box": [0, 0.5, 1, 1]}
    index = tmp_path / "index.jsonl"
    index.write_text(json.dumps({**line, **boxes}) + "\n\n")
    (clip,) = read_clip_folder(tmp_path)
    assert (clip.group, clip.pair, clip.predicates) == ("room 1", "room 1 1 2", ("on",))
    assert clip.boxes.tolist() == [0, 0, 0.5, 0.5, 0, 0.5, 1, 1]
    assert of_length(clip.read(), 2).shape == (2, 8, 9, 3)
    index.write_text(json.dumps({**line, "predicate": ["on", "near"]}))
    assert read_clip_folder(tmp_path)[0].predicates == ("on", "near")
    for wrong, reported in (
        ({"predicate": []}, "line 2"),
        ({"clip": "b.npz"}, "line 2: .*'b.npz'"),
        ({"group": 3}, "line 2"),
        ({"colour": "red"}, "line 2"),
        ({"subject_box": [0, 0, 9, 9]}, "line 2"),
    ):
        index.write_text(f"{json.dumps(line)}\n{json.dumps({**line, **wrong})}\n")
        with pytest.raises(ConfigurationError, match=reported):
            read_clip_folder(tmp_path)


def test_videos_are_read_as_rgb_and_unreadable_clips_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="contains no clips"):
        read_clip_folder(tmp_path)
    with pytest.raises(ConfigurationError, match="absent.* is not a folder"):
        read_clip_folder(tmp_path / "absent")
    path = tmp_path / "on" / "room__1.avi"
    path.parent.mkdir()
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (32, 24))
    for _ in range(3):
        writer.write(np.full((24, 32, 3), (0, 0, 250), np.uint8))  # red, in BGR
    writer.release()
    (clip,) = read_clip_folder(tmp_path)
    assert (clip.group, clip.predicates) == ("room", ("on",))
    frames = clip.read()
    assert frames.shape == (3, 24, 32, 3)
    assert frames[..., 0].min() > 200 and frames[..., 2].max() < 60
    np.savez(tmp_path / "a.npz", frames=np.zeros((2, 3, 3), np.uint8))
    np.savez(tmp_path / "b.npz", other=np.zeros(2))
    (tmp_path / "c.mp4").write_bytes(b"no video")
    for name, reported in (("a.npz", "expected uint8"), ("b.npz", "array"), ("c.mp4", "no frame")):
        with pytest.raises(RefusedInput, match=reported):
            read_frames(tmp_path / name)
