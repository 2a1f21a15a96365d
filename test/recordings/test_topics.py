"""Which topic is which."""

import pytest

from deworldsg_ros.recordings import source as ros
from deworldsg_ros.recordings.bags.storage import Topic
from deworldsg_ros.recordings.bags.topics import TopicChoice, find_topics
from deworldsg_ros.recordings.source import Role
from deworldsg_ros.scene.errors import RecordingError

ROLES = (Role.RGB, Role.DEPTH, Role.CAMERA_INFO, Role.POSE)
REALSENSE = [
    Topic("/camera/camera/color/image_raw", ros.IMAGE, 100),
    Topic("/camera/camera/color/camera_info", ros.CAMERA_INFO, 100),
    Topic("/camera/camera/depth/image_rect_raw", ros.IMAGE, 100),
    Topic("/camera/camera/aligned_depth_to_color/image_raw", ros.IMAGE, 100),
    Topic("/camera/camera/aligned_depth_to_color/camera_info", ros.CAMERA_INFO, 100),
    Topic("/vio/odometry", ros.ODOMETRY, 900),
    Topic("/tf", ros.TF_MESSAGE, 2000),
    Topic("/tf_static", ros.TF_MESSAGE, 1),
]
KINECT = [
    Topic("/kinect/rgb/image_raw/compressed", ros.COMPRESSED_IMAGE, 10),
    Topic("/kinect/rgb/camera_info", ros.CAMERA_INFO, 10),
    Topic("/kinect/depth_registered/image_raw/compressedDepth", ros.COMPRESSED_IMAGE, 10),
    Topic("/kinect/depth/image_raw/compressedDepth", ros.COMPRESSED_IMAGE, 10),
    Topic("/tf", ros.TF_MESSAGE, 20),
]
OURS = [
    Topic("/rgb/image_raw/compressed", ros.COMPRESSED_IMAGE, 7),
    Topic("/rgb/camera_info", ros.CAMERA_INFO, 7),
    Topic("/depth/image_raw/compressedDepth", ros.COMPRESSED_IMAGE, 7),
    Topic("/camera/pose", ros.POSE_STAMPED, 7),
    Topic("/robot/pose", ros.POSE_STAMPED, 70),
    Topic("/deworldsg/instances", ros.IMAGE, 7),
]
REGISTERED = "/kinect/depth_registered/image_raw"


@pytest.mark.parametrize(
    ("topics", "expected"),
    [(REALSENSE, (0, 3, 1, 5)), (KINECT, (0, 2, 1, 4)), (OURS, (0, 2, 1, 3))],
)
def test_usual_names_are_found_in_any_order(topics, expected):
    for order in (topics, topics[::-1]):
        found = find_topics(order, TopicChoice(), "bag")
        assert [found[role] for role in ROLES] == [topics[index] for index in expected]


@pytest.mark.parametrize(
    ("topics", "choice", "found"),
    [
        (REALSENSE, {"depth": REALSENSE[2].name, "pose": "/tf"}, [REALSENSE[2], REALSENSE[6]]),
        # A topic may be named without the suffix of its transport.
        (KINECT, {"rgb": "/kinect/rgb/image_raw", "depth": REGISTERED}, [KINECT[0], KINECT[2]]),
        (
            [*KINECT, Topic(REGISTERED, ros.IMAGE, 10)],
            {"depth": REGISTERED},
            [Topic(REGISTERED, ros.IMAGE, 10)],
        ),
    ],
)
def test_a_named_topic_wins(topics, choice, found):
    chosen = find_topics(topics, TopicChoice(**choice), "bag")
    assert [chosen[Role(role)] for role in choice] == found


@pytest.mark.parametrize(
    ("topics", "choice", "words"),
    [
        ([t for t in KINECT if t.msgtype != ros.COMPRESSED_IMAGE], {}, "no rgb topic"),
        ([t for t in KINECT if t.msgtype != ros.CAMERA_INFO], {}, "no camera_info topic"),
        ([t for t in KINECT if t.msgtype != ros.TF_MESSAGE], {}, "no pose topic"),
        (KINECT, {"rgb": "/tf"}, "--rgb /tf"),
        (KINECT, {"rgb": "/nothing"}, "--rgb /nothing"),
        ([Topic("/rgb/image_raw", ros.IMAGE, 0)], {}, "no rgb topic"),
        ([], {}, "no messages at all"),
    ],
)
def test_a_missing_role_is_reported_with_the_existing_topics(topics, choice, words):
    with pytest.raises(RecordingError, match=words) as caught:
        find_topics(topics, TopicChoice(**choice), "walk.mcap")
    assert "walk.mcap" in str(caught.value)
    assert choice or all(topic.name in str(caught.value) for topic in topics if topic.count)
