"""Pace and window of a replay, without a clock."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deworldsg_ros.recordings.replaying import Pace, Window
from deworldsg_ros.recordings.source import Role

NEEDS = (Role.DEPTH, Role.POSE)


@pytest.mark.parametrize(("rate", "due_s"), [(1.0, 12.0), (2.0, 11.0), (0.5, 14.0), (0.0, 10.1)])
def test_pace_scales_recorded_time_and_rate_zero_is_always_due(rate, due_s):
    pace = Pace(rate)
    assert pace.due_s(7 * 10**18, 10.0) == 10.0
    assert pace.due_s(7 * 10**18 + 2 * 10**9, 10.1) == pytest.approx(due_s)
    pace.late(30.0)  # after a pause it keeps its rate
    assert pace.due_s(7 * 10**18 + 2 * 10**9, 40.1) == pytest.approx(due_s + 30.0)


def window(size: int, published: int, needs: tuple[Role, ...] = ()) -> Window:
    """A window in which the frames 1, 2, … are published."""
    made = Window(size, needs)
    for stamp_ns in range(1, published + 1):
        made.publish(stamp_ns)
    return made


@pytest.mark.parametrize(
    ("published", "answers", "in_flight"),
    [
        (2, [("excuse", 2)], 0),
        # A refusal before the result of an earlier frame counts: 2, 3 and 4 are excused.
        (6, [("excuse", 3), ("add_result", 1)], 2),
        (6, [("excuse", 3), ("add_result", 1), ("add_result", 5)], 1),
        # A refusal after the result of a later frame is not counted twice.
        (4, [("add_result", 3), ("excuse", 2)], 1),
    ],
)
def test_refused_frames_leave_the_window(published, answers, in_flight):
    made = window(10, published)
    for method, value in answers:
        getattr(made, method)(value)
    assert made.in_flight == in_flight


def test_a_frame_is_in_flight_once_every_stream_passed_its_stamp():
    """30 images and 5 poses per second: six images between two poses must not fill a window."""
    made = Window(4, NEEDS)
    for stamp_ns in range(1, 7):
        made.passed(Role.DEPTH, stamp_ns)
        made.publish(stamp_ns)
        assert made.in_flight == 0
    made.passed(Role.POSE, 4)
    assert made.in_flight == 4 and made.is_full
    made.add_result(4)
    made.passed(Role.CAMERA_INFO, 9)
    assert made.in_flight == 0
    made.close()
    assert made.in_flight == 2


@given(
    size=st.integers(1, 5),
    steps=st.lists(st.sampled_from(["publish", "result", "excuse", "give up"]), max_size=60),
)
def test_never_more_in_flight_than_the_window_allows(size, steps):
    made = Window(size)
    stamp_ns, result_ns = 0, 0
    for step in steps:
        if step == "publish" and not made.is_full:
            stamp_ns += 1
            made.publish(stamp_ns)
        elif step == "result" and result_ns < stamp_ns:
            result_ns += 1
            made.add_result(result_ns)
        elif step == "excuse":
            made.excuse(1)
        elif step == "give up":
            made.give_up()
        assert 0 <= made.in_flight <= min(size, stamp_ns - result_ns)
    # However it went: answering the newest empties the window.
    made.add_result(stamp_ns)
    assert made.in_flight == 0
