"""A part of `scripts/crash` and `scripts/soak`."""

from __future__ import annotations

import numpy as np
import pytest

from endurance.crash import crash
from endurance.soak import MAX_SLOWER, ROOM_FRAMES, Series, merge, replay, rooms, still


def test_the_slope_of_memory_is_that_of_most_samples():
    random = np.random.default_rng(0)
    series = Series()
    for second in range(3600):
        series.add(second, 200 + second / 3600 * 5 + random.normal(0, 1))
    assert series.slope_mb_per_h() == pytest.approx(5, abs=0.3)
    assert series.settled(3599).slope_mb_per_h() == 0.0


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_still_camera_costs_the_same_for_ever():
    times = merge("still", still(3000), settle=500)
    assert times.slower < MAX_SLOWER
    assert times.grown_mb < 10


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_many_rooms_cost_memory_and_no_time():
    times = merge("rooms", rooms(60), settle=10 * ROOM_FRAMES)
    assert times.slower < 2 * MAX_SLOWER
    assert times.grown_mb < 60


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_killed_nodes_come_back_with_their_graph(tmp_path):
    recoveries = crash(5, tmp_path)
    assert not [item for item in recoveries if item.problem]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_three_minutes_of_replay_take_no_more_memory(tmp_path):
    memory, _ = replay(3.0, tmp_path)
    for name, series in memory.items():
        settled = np.array(series.settled(90.0).rss_mb)
        third = len(settled) // 3
        assert np.median(settled[-third:]) < np.median(settled[:third]) + 10, name
