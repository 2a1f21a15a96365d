"""Masks on the image, the best photo of each object, the way of the camera, parts of a frame."""

import json
from dataclasses import replace
from itertools import permutations

import cv2
import numpy as np
import pytest
from support.merging import local_graph
from support.view import make_graph, make_node

from deworldsg_ros.view.live import camera
from deworldsg_ros.view.live.camera import view_of  # as it is before a fixture replaces it
from deworldsg_ros.view.live.state import LiveState, PageView
from deworldsg_ros.wire import messages as wire

WIDTH, HEIGHT = 640, 480


def view(*objects, stamp_ns=1):
    """A grey image with a red rectangle for each object: box, node and number of pixels."""
    rgb = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    instances = np.zeros((HEIGHT, WIDTH), np.uint16)
    for value, ((x1, y1, x2, y2), _, _) in enumerate(objects, start=1):
        rgb[y1:y2, x1:x2] = (200, 30, 30)
        instances[y1:y2, x1:x2] = value
    boxes, nodes, pixels = zip(*objects)
    count = len(objects)
    covariances = np.tile(0.01 * np.eye(3), (count, 1, 1))
    points = tuple(np.full((10, 3), node, np.float32) for node in nodes)
    local = replace(
        local_graph(stamp_ns, np.zeros((count, 3)), covariances, np.eye(4)[:count], points=points),
        boxes_xyxy=np.array(boxes, np.float64),
        pixel_counts=np.array(pixels, np.int64),
        scores=np.ones(count),
    )
    return view_of(local, nodes, rgb, instances)


def test_masks_have_the_colours_of_their_nodes():
    shown = view(((100, 100, 300, 300), 7, 9), ((400, 100, 500, 200), 8, 9))
    image = camera.with_masks(shown, {7: "#00ff00"})
    assert image is not None and image.shape[1] == camera.SHOWN_WIDTH_PX
    scale = camera.SHOWN_WIDTH_PX / WIDTH
    known, unknown, outside = (
        image[round(y * scale), round(x * scale)] for x, y in ((200, 200), (450, 150), (20, 20))
    )
    assert known[1] > 100 and known[0] < 150, "green over red"
    assert unknown.tolist() != [200, 30, 30] and abs(int(unknown[1]) - int(unknown[2])) < 20
    assert outside.tolist() == [90, 90, 90]
    assert camera.with_masks(camera.CameraView(1, np.eye(4)), {}) is None
    image = np.full((48, 64, 3), 5, np.uint8)
    plain = camera.with_masks(camera.CameraView(1, np.eye(4), image), {})
    assert plain is not None and (plain == 5).all()


def test_the_photo_with_the_most_mask_pixels_stays():
    crops = camera.BestViews()
    for stamp_ns, (side, pixels) in enumerate([(100, 500), (200, 2000), (50, 100)], start=1):
        box = (100, 100, 100 + side, 100 + side)
        crops.add(view((box, 7, pixels), stamp_ns=stamp_ns))
    crop = crops[7]
    assert crop is not None and crop.stamp_ns == 2
    image = cv2.imdecode(np.frombuffer(crop.image, np.uint8), cv2.IMREAD_COLOR)
    assert max(image.shape[:2]) <= 192
    assert image[image.shape[0] // 2, image.shape[1] // 2, 2] > 150, "the red object, in BGR"
    assert crops[8] is None


@pytest.mark.parametrize("box", [(0, 100, 200, 300), (440, 100, 640, 300), (100, 280, 300, 480)])
def test_a_whole_object_is_preferred_to_a_larger_part(box):
    crops = camera.BestViews()
    crops.add(view(((100, 100, 200, 200), 7, 900), stamp_ns=1))
    crops.add(view((box, 7, 2000), stamp_ns=2))
    assert crops[7] is not None and crops[7].stamp_ns == 1


def test_photos_are_bounded_and_follow_merges():
    crops = camera.BestViews(most=2)
    for node_id in (1, 2, 3):
        crops.add(view(((100, 100, 200, 200), node_id, 100 * node_id)))
    assert len(crops) == 2 and crops[1] is None
    crops.merge([wire.RemovedNode(3, merged_into=2), wire.RemovedNode(9)])
    assert len(crops) == 1 and crops[2] is not None and crops[2].score == 300


def test_the_way_is_kept_and_only_the_newest_images(monkeypatch):
    monkeypatch.setattr(camera, "MOST_IMAGES", 3)
    shots = camera.Shots()
    for stamp_ns in range(6):
        shots.add(camera.Shot(stamp_ns, np.eye(4), 1.0, 1.0, b"image"))
    found = [shots.last(stamp_ns) for stamp_ns in range(6)]
    assert [shot.stamp_ns for shot in found] == list(range(6))
    assert [bool(shot.image) for shot in found] == [False] * 3 + [True] * 3
    assert shots.last(None) is found[-1] and shots.last(-1) is None


def test_points_of_the_frames_stand_in_for_those_of_the_graph():
    state, page = LiveState(), PageView()
    state.look(view(((100, 100, 200, 200), 7, 500)))
    assert "clouds" not in json.loads(state.news(page, 0.0)[0])  # of no node of the graph
    state.reset(make_graph([make_node(7, "cup")]))
    message = json.loads(state.news(page, 2.0)[0])
    assert [cloud["id"] for cloud in message["clouds"]] == [7] and message["photos"] == [[7, 1]]


def send(joiner, stamp_ns, parts=camera.PARTS, now_s=0.0, decoded=None):
    """The view that the last of these parts completes."""
    decoded = [] if decoded is None else decoded

    def decode(part):
        decoded.append(part)
        return part

    views = [joiner.add(part, stamp_ns, lambda part=part: decode(part), now_s) for part in parts]
    assert all(view is None for view in views[:-1])
    return views[-1]


@pytest.fixture(autouse=True)
def plain_views(monkeypatch):
    """The joined view is just its parts."""
    monkeypatch.setattr(camera, "view_of", lambda *parts: parts)


def test_the_order_of_the_parts_does_not_matter_and_frames_are_not_mixed():
    for parts in permutations(camera.PARTS):
        joined = send(camera.FrameJoiner(0.0), 5, parts)
        assert joined == ("local", "node_ids", "rgb", "instances")
    joiner = camera.FrameJoiner(0.0)
    assert send(joiner, 1, camera.PARTS[:3]) is None
    assert send(joiner, 2, camera.PARTS[3:]) is None


def test_early_frames_are_left_out_undecoded():
    joiner, decoded = camera.FrameJoiner(0.15), []
    assert send(joiner, 1, now_s=10.0)
    assert send(joiner, 2, now_s=10.1, decoded=decoded) is None and decoded == []
    assert send(joiner, 3, now_s=10.2)


def test_frames_that_stay_incomplete_are_forgotten():
    joiner = camera.FrameJoiner(0.0)
    for stamp_ns in range(camera.MOST_WAITING + 5):
        joiner.add("rgb", stamp_ns, lambda: "rgb", 0.0)
    assert send(joiner, 0, camera.PARTS[1:]) is None
    assert send(joiner, camera.MOST_WAITING + 4, camera.PARTS[1:])
