"""Which topic is which."""

from __future__ import annotations

import pytest

from deworldsg_ros.recordings.bags.storage import Topic
from deworldsg_ros.recordings.bags.topics import TopicChoice, find_topics
from deworldsg_ros.recordings.source import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    ODOMETRY,
    POSE_STAMPED,
    TF_MESSAGE,
    Role,
)
from deworldsg_ros.scene.errors import RecordingError

REALSENSE = [
    Topic("/camera/camera/color/image_raw", IMAGE, 100),
    Topic("/camera/camera/color/camera_info", CAMERA_INFO, 100),
    Topic("/camera/camera/depth/image_rect_raw", IMAGE, 100),
    Topic("/camera/camera/depth/camera_info", CAMERA_INFO, 100),
    Topic("/camera/camera/aligned_depth_to_color/image_raw", IMAGE, 100),
    Topic("/camera/camera/aligned_depth_to_color/camera_info", CAMERA_INFO, 100),
    Topic("/camera/camera/infra1/image_rect_raw", IMAGE, 100),
    Topic("/vio/odometry", ODOMETRY, 900),
    Topic("/tf", TF_MESSAGE, 2000),
    Topic("/tf_static", TF_MESSAGE, 1),
]
KINECT = [
    Topic("/kinect/rgb/image_raw/compressed", COMPRESSED_IMAGE, 10),
    Topic("/kinect/rgb/camera_info", CAMERA_INFO, 10),
    Topic("/kinect/depth_registered/image_raw/compressedDepth", COMPRESSED_IMAGE, 10),
    Topic("/kinect/depth/image_raw/compressedDepth", COMPRESSED_IMAGE, 10),
    Topic("/tf", TF_MESSAGE, 20),
]
OURS = [
    Topic("/rgb/image_raw/compressed", COMPRESSED_IMAGE, 7),
    Topic("/rgb/camera_info", CAMERA_INFO, 7),
    Topic("/depth/image_raw/compressedDepth", COMPRESSED_IMAGE, 7),
    Topic("/camera/pose", POSE_STAMPED, 7),
    Topic("/robot/pose", POSE_STAMPED, 70),
    Topic("/deworldsg/instances", IMAGE, 7),
]


@pytest.mark.parametrize(
    ("topics", "expected"),
    [
        (
            REALSENSE,
            [
                "/camera/camera/color/image_raw",
                "/camera/camera/aligned_depth_to_color/image_raw",
                "/camera/camera/color/camera_info",
                "/vio/odometry",
            ],
        ),
        (
            KINECT,
            [
                "/kinect/rgb/image_raw/compressed",
                "/kinect/depth_registered/image_raw/compressedDepth",
                "/kinect/rgb/camera_info",
                "/tf",
            ],
        ),
        (
            OURS,
            [
                "/rgb/image_raw/compressed",
                "/depth/image_raw/compressedDepth",
                "/rgb/camera_info",
                "/camera/pose",
            ],
        ),
    ],
)
def test_usual_names_are_found_in_any_order(topics, expected):
    roles = [Role.RGB, Role.DEPTH, Role.CAMERA_INFO, Role.POSE]
    for order in (topics, topics[::-1]):
        found = find_topics(order, TopicChoice(), "bag")
        assert [found[role].name for role in roles] == expected


def test_a_named_topic_wins():
    choice = TopicChoice(depth="/camera/camera/depth/image_rect_raw", pose="/tf")
    found = find_topics(REALSENSE, choice, "bag")
    assert found[Role.DEPTH].name == "/camera/camera/depth/image_rect_raw"
    assert found[Role.POSE].name == "/tf"


def test_a_topic_may_be_named_without_the_suffix_of_its_transport():
    raw = "/kinect/depth_registered/image_raw"
    found = find_topics(KINECT, TopicChoice(rgb="/kinect/rgb/image_raw", depth=raw), "bag")
    assert found[Role.RGB].name == "/kinect/rgb/image_raw/compressed"
    assert found[Role.DEPTH].name == f"{raw}/compressedDepth"
    both = [*KINECT, Topic(raw, IMAGE, 10)]
    assert find_topics(both, TopicChoice(depth=raw), "bag")[Role.DEPTH].name == raw


@pytest.mark.parametrize(
    ("missing", "words"),
    [
        (COMPRESSED_IMAGE, "no rgb topic"),
        (CAMERA_INFO, "no camera_info topic"),
        (TF_MESSAGE, "no pose topic"),
    ],
)
def test_a_missing_role_is_reported_with_the_existing_topics(missing, words):
    left = [topic for topic in KINECT if topic.msgtype != missing]
    with pytest.raises(RecordingError, match=words) as caught:
        find_topics(left, TopicChoice(), "walk.mcap")
    for topic in left:
        assert topic.name in str(caught.value)
    assert "walk.mcap" in str(caught.value)
    assert "--" in str(caught.value)


def test_a_named_topic_of_the_wrong_type_or_without_messages_is_refused():
    for name in ("/tf", "/nothing"):
        with pytest.raises(RecordingError, match=f"--rgb {name}"):
            find_topics(KINECT, TopicChoice(rgb=name), "bag")
    with pytest.raises(RecordingError, match="no rgb topic"):
        find_topics([Topic("/rgb/image_raw", IMAGE, 0)], TopicChoice(), "bag")
    with pytest.raises(RecordingError, match="no messages at all"):
        find_topics([], TopicChoice(), "bag")
