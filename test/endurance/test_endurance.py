"""A part of `scripts/crash` and `scripts/soak`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from types import FrameType

import numpy as np
import pytest

from endurance.crash import crash
from endurance.soak import ROOM_FRAMES, Series, merge, replay, rooms, still

# Of the calls for a frame. Other processes cannot change them, as they change a time.
MAX_MORE_CALLS = 1.1


def test_the_slope_of_memory_is_that_of_most_samples():
    random = np.random.default_rng(0)
    series = Series()
    for second in range(3600):
        series.add(second, 200 + second / 3600 * 5 + random.normal(0, 1))
    assert series.slope_per_h() == pytest.approx(5, abs=0.3)
    assert series.settled(3599).slope_per_h() == 0.0


class Calls:
    """A clock that counts the calls of functions."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self) -> float:
        return self.count

    def note(self, _frame: FrameType, event: str, _argument: object) -> None:
        """Take an event of `sys.setprofile`."""
        self.count += event in ("call", "c_call")


@pytest.fixture
def calls() -> Iterator[Calls]:
    clock = Calls()
    before = sys.getprofile()
    sys.setprofile(clock.note)
    yield clock
    sys.setprofile(before)


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_still_camera_costs_no_more_calls_and_no_memory(calls):
    costs = merge("still", still(3000), settle=500, clock=calls)
    assert costs.slower < MAX_MORE_CALLS
    assert costs.grown_mb < 10


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_many_rooms_cost_memory_and_no_more_calls(calls):
    costs = merge("rooms", rooms(60), settle=10 * ROOM_FRAMES, clock=calls)
    assert costs.slower < MAX_MORE_CALLS
    assert costs.grown_mb < 60


@pytest.mark.slow
@pytest.mark.timeout(1500)
@pytest.mark.parametrize("kills", [1, pytest.param(20, marks=pytest.mark.nightly)])
def test_killed_nodes_come_back_with_their_graph(kills, tmp_path):
    recoveries = crash(kills, tmp_path)
    assert not [item for item in recoveries if item.problem]


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.timeout(1500)
def test_ten_minutes_of_replay_take_no_more_memory(tmp_path):
    memory, _ = replay(10.0, tmp_path)
    for name, series in memory.items():
        settled = np.array(series.settled(180.0).values)
        third = len(settled) // 3
        assert np.median(settled[-third:]) < np.median(settled[:third]) + 4, name
