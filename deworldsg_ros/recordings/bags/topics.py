"""Find the topic of each role in a bag: by type and name, or as the user named it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from deworldsg_ros.config import InputsConfig
from deworldsg_ros.recordings.bags.storage import Topic
from deworldsg_ros.recordings.source import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    DETECTIONS,
    IMAGE,
    ODOMETRY,
    POSE_STAMPED,
    STRING,
    TF_MESSAGE,
    Role,
)
from deworldsg_ros.scene.errors import RecordingError

Types = tuple[str, ...]
# The topic with the highest score has the role; None = the topic cannot have it.
Score = Callable[[Topic], "tuple[float, ...] | None"]

IMAGES = (IMAGE, COMPRESSED_IMAGE)
# Suffixes of image_transport: the user may name a topic without them, as for ROS nodes.
TRANSPORT_SUFFIXES = {
    Role.RGB: ("", "/compressed"),
    Role.DEPTH: ("", "/compressedDepth", "/compressed"),
}
# Encodings that only depth has.
DEPTHS = ("16UC1", "32FC1")
# In order of preference.
POSES = (POSE_STAMPED, ODOMETRY, TF_MESSAGE)
# Names of images that are neither colour nor depth.
OTHER_IMAGES = ("infra", "/ir/", "instance", "label", "mask", "segment", "semantic", "mono")

TYPES = {
    Role.RGB: IMAGES,
    Role.DEPTH: IMAGES,
    Role.CAMERA_INFO: (CAMERA_INFO,),
    Role.POSE: POSES,
    Role.DETECTIONS: (STRING, DETECTIONS),
    Role.DETECTION_INSTANCES: (IMAGE,),
}
TRANSPORTS: dict[str, Types] = {
    "auto": IMAGES,
    "raw": (IMAGE,),
    "compressed": (COMPRESSED_IMAGE,),
}
POSE_SOURCES: dict[str, Types] = {
    "auto": POSES,
    "pose": (POSE_STAMPED,),
    "odometry": (ODOMETRY,),
    "tf": (TF_MESSAGE,),
}
EXPECTED = {
    Role.RGB: "an Image or CompressedImage with rgb, color or image in its name",
    Role.DEPTH: "an Image or CompressedImage with depth in its name, or of 16UC1 or 32FC1",
    Role.CAMERA_INFO: "a CameraInfo beside the RGB image (or use --intrinsics FX,FY,CX,CY)",
    Role.POSE: "a PoseStamped, an Odometry or /tf (or use --odometry, or run with --poses FILE)",
    Role.DETECTIONS: "a Detection2DArray, or a String of ours with detections in its name",
}
# The instance image of detections has their topic, and this.
INSTANCES_SUFFIX = "/instances"


@dataclass(frozen=True)
class TopicChoice:
    """Topics that the user named; empty = found by type and name."""

    rgb: str = ""
    depth: str = ""
    camera_info: str = ""
    pose: str = ""
    detections: str = ""


def parse_topics(text: str) -> TopicChoice:
    """Topics of ``rgb=/a,depth=/b,pose=/c``; each role of `TopicChoice` at most once.

    Raises:
        RecordingError: for an unknown role, a role given twice, or a part without a topic.
    """
    chosen: dict[str, str] = {}
    for part in filter(None, text.split(",")):
        role, _, topic = (word.strip() for word in part.partition("="))
        if role not in TopicChoice.__dataclass_fields__ or role in chosen or not topic:
            raise RecordingError(
                f"topics '{text}': cannot read '{part}', expected each of rgb, depth, camera_info, "
                "pose and detections at most once, as rgb=/a,depth=/b,camera_info=/c,pose=/d"
            )
        chosen[role] = topic
    return TopicChoice(**chosen)


def find_topics(
    topics: Sequence[Topic],
    choice: TopicChoice,
    recording: str,
    inputs: InputsConfig | None = None,
    *,
    need_pose: bool = True,
    need_camera_info: bool = True,
    encoding: Callable[[Topic], str] = lambda _: "",
) -> dict[Role, Topic]:
    """The topic of each role.

    Args:
        topics: of the bag.
        choice: topics that the user named; their types need not match `inputs`.
        recording: name of the bag, for errors.
        inputs: ``transport`` and ``pose_source`` select the types.
        need_pose: whether a bag without poses is refused; if not, the role may be missing.
        need_camera_info: whether the role is looked for.
        encoding: of the first image of a topic. It is asked if no name has the word depth.

    Raises:
        RecordingError: names the role, the topics seen and the expected type and name.
    """
    inputs = inputs or InputsConfig()
    images = TRANSPORTS[inputs.transport]
    filled = [topic for topic in topics if topic.count]

    def find(role: Role, chosen: str, types: Types, score: Score) -> Topic:
        return _find(role, filled, chosen, types, score, recording)

    unnamed: list[Topic] = []
    if not choice.depth and all(_depth_score(topic) is None for topic in filled):
        unnamed = [t for t in filled if t.msgtype in images and encoding(t).startswith(DEPTHS)]
    rgb = find(
        Role.RGB,
        choice.rgb,
        images,
        lambda topic: None if topic in unnamed else _rgb_score(topic),
    )
    depth = choice.depth or (max(unnamed, key=_plain).name if unnamed else "")
    found = {Role.RGB: rgb, Role.DEPTH: find(Role.DEPTH, depth, images, _depth_score)}
    if need_camera_info:
        found[Role.CAMERA_INFO] = find(
            Role.CAMERA_INFO,
            choice.camera_info,
            (CAMERA_INFO,),
            lambda topic: _camera_info_score(topic, rgb.name),
        )
    types = POSE_SOURCES[inputs.pose_source]
    posed = any(topic.msgtype in types and _pose_score(topic) is not None for topic in filled)
    if need_pose or posed or choice.pose:
        found[Role.POSE] = find(Role.POSE, choice.pose, types, _pose_score)
    sent = TYPES[Role.DETECTIONS]
    if choice.detections or any(
        topic.msgtype in sent and _detections_score(topic) is not None for topic in filled
    ):
        topic = find(Role.DETECTIONS, choice.detections, sent, _detections_score)
        found[Role.DETECTIONS] = topic
        for masks in filled:
            if (masks.name, masks.msgtype) == (topic.name + INSTANCES_SUFFIX, IMAGE):
                found[Role.DETECTION_INSTANCES] = masks
    return found


def _find(
    role: Role,
    topics: Sequence[Topic],
    chosen: str,
    types: Types,
    score: Score,
    recording: str,
) -> Topic:
    option = "--" + role.value.replace("_", "-")
    if chosen:
        usable = {topic.name: topic for topic in topics if topic.msgtype in TYPES[role]}
        for suffix in TRANSPORT_SUFFIXES.get(role, ("",)):
            if chosen + suffix in usable:
                return usable[chosen + suffix]
        problem = f"{option} {chosen} is no topic with messages of a type for {role.value}"
    else:
        scored = [
            (value, topic)
            for topic in topics
            if topic.msgtype in types and (value := score(topic)) is not None
        ]
        if scored:
            # Of equal scores, the first name.
            return min(scored, key=lambda item: ([-value for value in item[0]], item[1].name))[1]
        problem = f"no {role.value} topic"
    seen = ", ".join(f"{topic.name} ({topic.msgtype}, {topic.count})" for topic in topics)
    raise RecordingError(
        f"recording {recording}: {problem}. It has: {seen or 'no messages at all'}. "
        f"Expected {EXPECTED[role]}; name one with {option} TOPIC"
    )


def _rgb_score(topic: Topic) -> tuple[float, ...] | None:
    name = topic.name.lower()
    if "depth" in name or any(word in name for word in OTHER_IMAGES):
        return None
    return ("rgb" in name or "color" in name, "image" in name, "rect" in name, *_plain(topic))


def _depth_score(topic: Topic) -> tuple[float, ...] | None:
    name = topic.name.lower()
    if "depth" not in name or any(word in name for word in ("theora", "points")):
        return None
    return ("aligned" in name or "registered" in name, "compresseddepth" in name, *_plain(topic))


def _plain(topic: Topic) -> tuple[float, ...]:
    """Prefer more messages, then the uncompressed topic."""
    return (topic.count, topic.msgtype == IMAGE)


def _camera_info_score(topic: Topic, rgb_name: str) -> tuple[float, ...] | None:
    name = topic.name.lower()
    shared = 0
    for ours, theirs in zip(topic.name.split("/"), rgb_name.split("/")):
        if ours != theirs:
            break
        shared += 1
    return (shared, "rgb" in name or "color" in name, "depth" not in name, topic.count)


def _pose_score(topic: Topic) -> tuple[float, ...] | None:
    name = topic.name.lower()
    if name.endswith("tf_static"):
        return None
    rank = -POSES.index(topic.msgtype)
    return (rank, "camera" in name, "pose" in name, topic.count)


def _detections_score(topic: Topic) -> tuple[float, ...] | None:
    if topic.msgtype == STRING and not topic.name.lower().endswith("detections"):
        return None
    return (topic.msgtype == STRING, topic.count)
