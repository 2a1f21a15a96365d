"""Masks on the image, the best photo of each object, and the way of the camera."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from deworldsg_ros.scene.frame_graph import LocalGraph, Relations, Vocabulary
from deworldsg_ros.view.live import camera as camera_module
from deworldsg_ros.view.live.camera import BestViews, CameraView, Shot, Shots, view_of, with_masks
from deworldsg_ros.view.live.state import LiveState
from deworldsg_ros.wire import messages as wire

WIDTH, HEIGHT = 640, 480


def view(boxes, node_ids, pixels, score=1.0, stamp_ns=1):
    """A grey image with a red rectangle for each object."""
    rgb = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    instances = np.zeros((HEIGHT, WIDTH), np.uint16)
    for value, (x1, y1, x2, y2) in enumerate(boxes, start=1):
        rgb[y1:y2, x1:x2] = (200, 30, 30)
        instances[y1:y2, x1:x2] = value
    count = len(boxes)
    local = LocalGraph(
        stamp_ns=stamp_ns,
        frame_id="map",
        width=WIDTH,
        height=HEIGHT,
        T_world_camera=np.eye(4),
        vocabulary=Vocabulary(("cup",), ("on",)),
        instance_ids=np.arange(1, count + 1),
        boxes_xyxy=np.array(boxes, np.float64).reshape(-1, 4),
        class_probabilities=np.ones((count, 1)),
        scores=np.full(count, score),
        means_world=np.zeros((count, 3)),
        covariances_world=np.tile(0.01 * np.eye(3), (count, 1, 1)),
        depths_m=np.ones(count),
        pixel_counts=np.array(pixels, np.int64),
        surface_points_world=[np.full((10, 3), node_id, np.float32) for node_id in node_ids],
        relations=Relations.none(1),
    )
    return view_of(local, node_ids, rgb, instances)


def test_masks_have_the_colours_of_their_nodes():
    image = with_masks(view([(100, 100, 300, 300), (400, 100, 500, 200)], [7, 8], [9, 9]), {
        7: "#00ff00"
    })  # fmt: skip
    assert image is not None and image.shape[1] == camera_module.SHOWN_WIDTH_PX
    scale = camera_module.SHOWN_WIDTH_PX / WIDTH
    known, unknown, outside = (
        image[round(y * scale), round(x * scale)] for x, y in ((200, 200), (450, 150), (20, 20))
    )
    assert known[1] > 100 and known[0] < 150, "green over red"
    assert unknown.tolist() != [200, 30, 30] and abs(int(unknown[1]) - int(unknown[2])) < 20
    assert outside.tolist() == [90, 90, 90]


def test_a_view_without_image_or_masks_is_shown_as_it_is():
    assert with_masks(CameraView(1, np.eye(4)), {}) is None
    plain = with_masks(CameraView(1, np.eye(4), np.full((48, 64, 3), 5, np.uint8)), {})
    assert plain is not None and (plain == 5).all()


def test_the_photo_with_the_most_mask_pixels_stays():
    crops = BestViews()
    crops.add(view([(100, 100, 200, 200)], [7], [500], stamp_ns=1))
    crops.add(view([(100, 100, 300, 300)], [7], [2000], stamp_ns=2))
    crops.add(view([(100, 100, 150, 150)], [7], [100], stamp_ns=3))
    crop = crops[7]
    assert crop is not None and crop.stamp_ns == 2
    image = cv2.imdecode(np.frombuffer(crop.image, np.uint8), cv2.IMREAD_COLOR)
    assert max(image.shape[:2]) <= 192
    assert image[image.shape[0] // 2, image.shape[1] // 2, 2] > 150, "the red object, in BGR"
    assert crops[8] is None


@pytest.mark.parametrize("box", [(0, 100, 200, 300), (440, 100, 640, 300), (100, 280, 300, 480)])
def test_a_whole_object_is_preferred_to_a_larger_part(box):
    crops = BestViews()
    crops.add(view([(100, 100, 200, 200)], [7], [900], stamp_ns=1))
    crops.add(view([box], [7], [2000], stamp_ns=2))
    crop = crops[7]
    assert crop is not None and crop.stamp_ns == 1


def test_photos_are_bounded_and_follow_merges():
    crops = BestViews(most=2)
    for node_id in (1, 2, 3):
        crops.add(view([(100, 100, 200, 200)], [node_id], [100 * node_id]))
    assert len(crops) == 2 and crops[1] is None
    crops.merge([wire.RemovedNode(3, merged_into=2), wire.RemovedNode(9)])
    kept = crops[2]
    assert len(crops) == 1 and kept is not None and kept.score == 300


def test_the_way_is_kept_and_only_the_newest_images(monkeypatch):
    monkeypatch.setattr(camera_module, "MOST_IMAGES", 3)
    shots = Shots()
    for stamp_ns in range(6):
        shots.add(Shot(stamp_ns, np.eye(4), 1.0, 1.0, b"image"))
    assert [bool(shot.image) for shot in shots.until(None)] == [False] * 3 + [True] * 3
    assert [shot.stamp_ns for shot in shots.until(2)] == [0, 1, 2]


def test_points_of_the_frames_stand_in_for_those_of_the_graph():
    state = LiveState()
    state.look(view([(100, 100, 200, 200)], [7], [500]))
    assert len(state.points()[0]) == 0, "not of a node that is not in the graph"
    assert len(state.frames()) == 1
