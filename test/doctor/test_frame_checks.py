"""The frames of the shipped recording, made wrong on purpose; no detector runs."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import pytest
from support.cli import DEMO_ROOM
from support.wrong import WRONG

from deworldsg_ros.doctor import FrameSampler, Observations, find
from deworldsg_ros.recordings.recording import open_recording


@pytest.fixture(scope="module")
def frames():
    recording = open_recording(DEMO_ROOM)
    yield list(islice(recording.frames(), 50))
    recording.close()


def checks_of(frames):
    sampler = FrameSampler()
    for frame in frames:
        sampler.add(frame)
    return sampler.checks()


@pytest.mark.parametrize(
    ("name", "code", "words"),
    [
        ("right", None, ""),
        ("on its side", None, ""),
        ("one frame", None, ""),
        ("still", None, ""),
        ("dark", None, ""),
        ("depth times 10", "depth_unit", "multiplied by 0.1"),
        ("depth by 5", "depth_unit", "multiplied by 5"),
        ("shifted depth", "not_registered", "24 pixels away"),
        ("no depth", "little_depth", "depth_scale"),
        ("late poses", "late_poses", "0.4 s later"),
        ("poses of the body", "poses_of_the_body", "x is taken as forward"),
        ("inverse poses", "poses_inverted", "inverse"),
        ("other poses", "poses_do_not_fit", "not those of this camera"),
    ],
)
def test_what_is_wrong_is_found_and_nothing_else(frames, name, code, words):
    findings = find(Observations(checks=checks_of(WRONG[name](frames))))
    assert [finding.code for finding in findings] == ([] if code is None else [code])
    assert words in " ".join(map(str, findings))


def test_a_few_frames_are_kept_of_many_and_none_of_none(frames):
    sampler = FrameSampler()
    assert sampler.checks() is None
    for index in range(40):
        for frame in frames[:10]:
            sampler.add(shifted_in_time(frame, index))
    assert len(sampler._pairs) <= 12
    assert sampler.checks() is not None


def shifted_in_time(frame, index):
    return replace(frame, stamp_ns=frame.stamp_ns + 2 * 10**9 * index)
