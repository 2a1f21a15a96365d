"""A part of `scripts/crash` and `scripts/soak`."""

import sys

import pytest

from endurance.crash import crash
from endurance.soak import ROOM_FRAMES, merge, replay, rooms

pytestmark = pytest.mark.timeout(1500)


@pytest.fixture
def calls():
    """A clock that counts the calls of functions: other processes cannot change them."""
    count = 0

    def note(_frame, event, _argument):
        nonlocal count
        count += event in ("call", "c_call")

    before = sys.getprofile()
    merge(rooms(1, 20), 5)  # loading compiled kernels ends the profile
    sys.setprofile(note)
    yield lambda: count
    sys.setprofile(before)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("frames", "settle", "most_mb"),
    [
        pytest.param(rooms(1, 3000), 500, 10, id="a still camera"),
        pytest.param(rooms(60), 10 * ROOM_FRAMES, 60, id="many rooms"),
    ],
)
def test_a_longer_run_costs_no_more_calls_and_little_memory(calls, frames, settle, most_mb):
    costs = merge(frames, settle, clock=calls)
    assert costs.slower < 1.1
    assert costs.grown_mb < most_mb


@pytest.mark.slow
@pytest.mark.parametrize("kills", [1, pytest.param(20, marks=pytest.mark.nightly)])
def test_killed_nodes_come_back_with_their_graph(kills, tmp_path):
    assert not [item for item in crash(kills, tmp_path) if item.problem]


@pytest.mark.slow
@pytest.mark.nightly
def test_ten_minutes_of_replay_take_no_more_memory(tmp_path):
    memory, _ = replay(10.0, tmp_path)
    for name, series in memory.items():
        first_mb, last_mb = series.settled(180.0).ends()
        assert last_mb < first_mb + 4, name
