"""Training clips: read from folders, or cropped from data sets as at run time."""

import json

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

from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput
from deworldsg_ros.training.clips import (
    ClipChoice,
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


@pytest.fixture
def rio(tmp_path):
    """3RScan's layout: one scan of three blocks in a row, whose images are rotated."""
    objects = [(name, number) for number, name, _, _ in BLOCKS]
    root = write_dataset(tmp_path / "set", {"a": (objects, RELATIONS)}, layout="3rscan")
    write_lists(root, train=["a"], test=[])
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
    assert [clip.predicate for clip in clips] == ["near", "near", "on", "on"]
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
    assert [clip.predicate for clip in read_clips(rio, CHOICE)] == ["near", "on"]
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
    for number in range(8):
        path = tmp_path / f"{number}.png"
        cv2.imwrite(str(path), np.full((40, 60, 3), 10 * number, np.uint8))
        boxes = {1: np.array([5.0, 5, 25, 20]), 2: np.array([14.0 + number, 10, 50, 35])}
        if number in (2, 7):
            del boxes[2]
        frames.append((path, None if number == 4 else boxes))
    relations = [(2, 1, "on"), (1, 9, "near")]
    options = {"clip_length": 6, "clips_per_pair": 9, "window": window}
    clips = cut_clips("scan", frames, (60, 40), relations, **options)
    assert {(c.group, c.pair, c.predicate) for c in clips} == {("scan", "scan 1 2", "on")}
    assert len({clip.key for clip in clips}) == len(clips) == 5
    last = clips[-1].read()
    assert last.shape == (6, 31, 46, 3)  # pixels 5 to 50 by 5 to 35, the union
    assert last[:, 0, 0, 0].tolist() == shown
    np.testing.assert_allclose(clips[-1].boxes[4:], [0, 0, 20 / 46, 15 / 31])
    assert cut_clips("scan", [], (60, 40), relations, **options) == []


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
    assert (clip.group, clip.pair, clip.predicate) == ("room 1", "room 1 1 2", "on")
    assert clip.boxes.tolist() == [0, 0, 0.5, 0.5, 0, 0.5, 1, 1]
    assert of_length(clip.read(), 2).shape == (2, 8, 9, 3)
    for wrong, reported in (
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
    assert (clip.group, clip.predicate) == ("room", "on")
    frames = clip.read()
    assert frames.shape == (3, 24, 32, 3)
    assert frames[..., 0].min() > 200 and frames[..., 2].max() < 60
    np.savez(tmp_path / "a.npz", frames=np.zeros((2, 3, 3), np.uint8))
    np.savez(tmp_path / "b.npz", other=np.zeros(2))
    (tmp_path / "c.mp4").write_bytes(b"no video")
    for name, reported in (("a.npz", "expected uint8"), ("b.npz", "array"), ("c.mp4", "no frame")):
        with pytest.raises(RefusedInput, match=reported):
            read_frames(tmp_path / name)
