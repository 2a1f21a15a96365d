"""Training clips are cropped from data sets as at run time."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from support.images import many_scans
from support.sequences import (
    BLOCKS,
    HEIGHT,
    RELATIONS,
    ROWS,
    WIDTH,
    instance_image,
    write_dataset,
    write_sequence,
    write_surface,
)

from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput
from deworldsg_ros.training.clips import ClipChoice, read_clips

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
    height, width = clip.shape[1:3]
    assert clip.shape[0] == 4
    # Rotated by 90 degrees, columns are rows. Points are pixel centres: one pixel of tolerance.
    assert (
        abs(width - (ROWS[1] - ROWS[0])) <= 2 and abs(height - (BLOCKS[1][3] - BLOCKS[0][2])) <= 2
    )
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


def test_hidden_objects_have_no_boxes(rio):
    for path in (rio / "data" / "a" / "sequence").glob("*.depth.pgm"):
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        depth[:, BLOCKS[1][2] :] = 1000  # something else is in front of the table and the book
        cv2.imwrite(str(path), depth)
    with pytest.raises(
        ConfigurationError, match="no frame of the split 'train' shows a related pair"
    ):
        read_clips(rio, CHOICE)


def test_an_unreadable_frame_has_no_boxes(rio):
    sequence = rio / "data" / "a" / "sequence"
    (sequence / "frame-000000.pose.txt").write_text("no matrix")
    clips = read_clips(rio, CHOICE)
    assert [clip.predicate for clip in clips] == ["near", "on"]


@pytest.mark.parametrize(
    "lists, split, message",
    [
        ({"train": [], "test": ["a"]}, "train", "has no scans of the split 'train'.*lists 0"),
        ({"train": ["absent"], "test": []}, "train", "has no scans of the split 'train'.*lists 1"),
        ({"train": ["a"], "test": ["a"]}, "train", "'train'.* are test scans, too, first 'a'"),
        ({"validation": ["a"], "test": ["a"]}, "validation", "'validation'.* are test scans"),
    ],
)
def test_scans_outside_of_the_split_are_refused(rio, lists, split, message):
    write_lists(rio, **lists)
    with pytest.raises(ConfigurationError, match=message):
        read_clips(rio, ClipChoice(4, 2, split))


def test_test_scans_are_taken_only_when_named(rio):
    write_lists(rio, train=[], test=["a"])
    assert {clip.group for clip in read_clips(rio, ClipChoice(4, 2, "test"))} == {"a"}


def test_the_valid_interval_of_3rscan_goes_across_frames_without_boxes(rio):
    """Boxes are known in every eighth frame; both objects are seen in all of them."""
    window = ClipChoice(10, 2, window="valid_interval")
    lengths = [len(np.unique(clip.read(), axis=0)) for clip in read_clips(rio, window)]
    whole = [len(np.unique(clip.read(), axis=0)) for clip in read_clips(rio, ClipChoice(10, 2))]
    assert lengths == whole
