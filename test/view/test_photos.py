"""Photos of objects, cut from the frames that show them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.view import make_graph, make_node

from deworldsg_ros.cli import outputs
from deworldsg_ros.cli.outputs import Album
from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame
from deworldsg_ros.view import picture
from deworldsg_ros.view.picture import photos_of

CAMERA = Intrinsics(100.0, 100.0, 59.5, 39.5, 120, 80)
RED, GREEN = (200, 30, 30), (20, 160, 40)


def frame(stamp_ns: int = 1, depth_m: float = 2.0) -> RgbdFrame:
    """A red patch of 20 x 20 pixels, 2 m in front of the camera, on a green wall."""
    rgb = np.full((80, 120, 3), GREEN, np.uint8)
    rgb[30:50, 50:70] = RED
    depth = np.full((80, 120), 4.0, np.float32)
    depth[30:50, 50:70] = depth_m
    return RgbdFrame(stamp_ns, rgb, depth, CAMERA, np.eye(4))


def patch(node_id: int = 1, z_m: float = 2.0):
    side = np.linspace(-0.19, 0.19, 15)
    x, y = (values.ravel() for values in np.meshgrid(side, side))
    return make_node(node_id, "cup", (0, 0, z_m), points=np.column_stack([x, y, np.full(225, z_m)]))


def test_a_photo_shows_its_object_in_the_middle():
    (photo,) = photos_of(make_graph([patch()]), [frame()], 64).values()
    assert photo.shape == (64, 64, 3)
    assert np.abs(photo[20:44, 20:44].astype(int) - RED).max() < 20
    assert np.abs(photo[:4, :4].astype(int) - GREEN).max() < 20


@pytest.mark.parametrize(
    ("node", "depth_m", "x_m"),
    [
        (patch(), 1.0, 0),
        (patch(z_m=-2.0), 2.0, 0),
        (patch(), 2.0, 5),
        (make_node(1, "cup"), 2.0, 0),
    ],
    ids=["covered", "behind", "outside", "no points"],
)
def test_there_is_no_photo_of_what_no_frame_shows(node, depth_m, x_m):
    shown = frame(depth_m=depth_m)
    shown.T_world_camera[0, 3] = x_m
    assert photos_of(make_graph([node]), [shown], 64) == {}


def test_an_album_keeps_evenly_spaced_frames_of_any_length(monkeypatch):
    monkeypatch.setattr(outputs, "LEAST_FRAMES", 8)
    monkeypatch.setattr(outputs, "MOST_BYTES", 0)
    for count in (3, 8, 9, 100, 1000):
        album, one = Album(), frame()
        for index in range(count):
            album.add(replace(one, stamp_ns=index))
        kept = [item.stamp_ns for item in album.frames]
        assert min(count, 4) <= len(kept) <= 8
        assert len(set(np.diff(kept))) <= 1
        assert kept[0] == 0 and kept[-1] >= count / 2


def test_the_picture_has_a_strip_of_photos(tmp_path):
    graph = make_graph([patch(), make_node(2, "a very long name of a class", (1, 0, 0))])
    picture.draw(graph, tmp_path / "plain.png")
    shots = {1: np.full((64, 64, 3), RED, np.uint8), 2: np.full((64, 64, 3), GREEN, np.uint8)}
    picture.draw(graph, tmp_path / "strip.png", photos=shots)
    plain, strip = (cv2.imread(str(tmp_path / f"{name}.png")) for name in ("plain", "strip"))
    assert strip.shape[1] == plain.shape[1]
    below = strip[plain.shape[0] :].astype(int)
    for colour in (RED, GREEN):
        assert (np.abs(below - colour[::-1]).sum(axis=2) < 10).sum() > 10_000
