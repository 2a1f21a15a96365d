"""The thread that writes the map goes on after any error."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from deworldsg_ros.ros import graph_keeper
from deworldsg_ros.ros.graph_keeper import MapKeeper
from deworldsg_ros.scene.errors import ConfigurationError

LIMIT_S = 30.0


class Counter:
    """A node that notes what is counted."""

    def __init__(self) -> None:
        self.counted: list[str] = []

    def drop(self, reason: str, message: str) -> None:
        self.counted.append(f"{reason}: {message}")

    @contextlib.contextmanager
    def refusing(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            self.counted.append(repr(error))


def test_a_checkpoint_that_fails_does_not_end_the_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcomes = [ConfigurationError("the disk is full"), MemoryError("odd"), None]
    written = []

    def write(state: object, path: Path) -> None:
        outcome = outcomes.pop(0)
        if outcome is not None:
            raise outcome
        written.append(path)

    monkeypatch.setattr(graph_keeper, "copy_state", lambda builder: {})
    monkeypatch.setattr(graph_keeper, "write_state", write)
    node = Counter()
    keeper = MapKeeper(node, tmp_path / "map.npz", 10.0)
    for left in (2, 1, 0):
        keeper.checkpoint(None)
        assert keeper._worker.wait_idle(LIMIT_S)
        assert len(outcomes) == left
    keeper.close()
    assert written == [tmp_path / "map.npz"]
    assert node.counted == ["map_not_written: the disk is full", "MemoryError('odd')"]
