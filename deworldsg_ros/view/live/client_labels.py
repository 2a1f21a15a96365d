"""The labels in one browser: placed for its camera, in a fixed set of handles."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np

from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.view.live.labels import Camera, Placed, place
from deworldsg_ros.view.live.tables import Label

# One label for so many pixels of the view, and never more than this.
PIXELS_PER_LABEL = 7_000
MOST_LABELS = 150
# From where one looks first, in axes of the floor, with some room around what is seen.
FIRST_VIEW = np.array([-0.35, -0.75, 0.55])
MARGIN, LEAST_HALF_M = 1.04, 0.3


class ClientLabels:
    """Shows labels to one client of a viser server.

    Args:
        client: of viser.
    """

    def __init__(self, client: Any) -> None:
        self._client = client
        self._handles: list[Any] = []
        self._slots: dict[str, int] = {}
        self._seen: tuple[Any, ...] = ()

    def show(self, labels: Sequence[Label]) -> None:
        """Place the labels for the present view; does nothing if neither has changed."""
        camera = camera_of(self._client)
        seen = (labels, *camera.position, *camera.wxyz, camera.width, camera.height)
        if len(seen) == len(self._seen) and seen[0] is self._seen[0] and seen[1:] == self._seen[1:]:
            return
        self._seen = seen
        most = min(int(camera.width * camera.height / PIXELS_PER_LABEL), MOST_LABELS)
        placed = {item.label.key: item for item in place(labels, camera, most)}
        # A label keeps its handle, so that only labels that appear or vanish are sent.
        self._slots = {key: slot for key, slot in self._slots.items() if key in placed}
        free = iter(sorted(set(range(MOST_LABELS)) - set(self._slots.values())))
        with self._client.atomic():
            for key, item in placed.items():
                self._put(self._slots.setdefault(key, -1), key, item, free)
            for slot in set(range(len(self._handles))) - set(self._slots.values()):
                self._handles[slot].visible = False

    def _put(self, slot: int, key: str, item: Placed, free: Any) -> None:
        if slot < 0:
            slot = self._slots[key] = next(free)
        while slot >= len(self._handles):
            name = f"/label{len(self._handles)}"
            self._handles.append(self._client.scene.add_label(name, "", visible=False))
        handle = self._handles[slot]
        handle.text, handle.anchor = item.label.text, item.anchor
        handle.position = item.label.position
        handle.visible = True


def has_area(client: Any) -> bool:
    """Whether the page of a client of viser has room for a picture: a panel may cover all of it."""
    return bool(client.camera.image_width > 0 and client.camera.image_height > 0)


def camera_of(client: Any) -> Camera:
    """The camera of a client of viser."""
    camera = client.camera
    return Camera(camera.position, camera.wxyz, camera.fov, camera.image_width, camera.image_height)


def overview(
    low: Float64, high: Float64, axes: Float64, fov_rad: float, aspect: float
) -> tuple[Float64, Float64]:
    """Where a camera sees everything: its position and the point it looks at, each (3,).

    Args:
        low: lower corner (3,) of what is drawn, world.
        high: upper corner (3,).
        axes: rows (3, 3) two horizontal directions and up, world.
        fov_rad: vertical field of view.
        aspect: width over height of the view.
    """
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, LEAST_HALF_M)
    backwards = FIRST_VIEW / np.linalg.norm(FIRST_VIEW) @ axes
    right = np.cross(axes[2], backwards)
    right /= np.linalg.norm(right)
    corners = half * np.array(list(product((-1, 1), repeat=3)))
    x, y = np.abs(corners @ right), np.abs(corners @ np.cross(backwards, right))
    slope = np.tan(fov_rad / 2)
    distances = np.maximum(x / (slope * aspect), y / slope) + corners @ backwards
    return middle + MARGIN * distances.max() * backwards, middle
