"""Observations → findings: what is off, why, and what to do."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from deworldsg_ros.base.words import counted
from deworldsg_ros.doctor.frame_checks import (
    BODY,
    FACTOR,
    FOCAL,
    GIVEN,
    INVERSE,
    LATE,
    OPENGL,
    STILL,
    FrameChecks,
    Header,
    Observations,
    best_factor,
)

# Longest side of usual indoor objects, metres, of the classes that several detectors know.
USUAL_SIZES_M = {
    "chair": 0.9, "couch": 1.9, "sofa": 1.9, "bed": 2.0, "dining table": 1.4, "table": 1.3,
    "desk": 1.4, "toilet": 0.7, "tv": 0.8, "laptop": 0.35, "keyboard": 0.42, "mouse": 0.11,
    "remote": 0.18, "cell phone": 0.15, "microwave": 0.5, "oven": 0.7, "toaster": 0.3, "sink": 0.5,
    "refrigerator": 1.7, "book": 0.24, "clock": 0.3, "vase": 0.25, "bottle": 0.25, "cup": 0.1,
    "wine glass": 0.2, "bowl": 0.17, "potted plant": 0.5, "teddy bear": 0.4, "person": 1.7,
    "backpack": 0.5, "suitcase": 0.65, "cabinet": 1.2, "bookshelf": 1.6, "bathtub": 1.6,
}  # fmt: skip
# Detectors confuse classes: only a median far off, of some objects, is a wrong unit.
MIN_SIZED, MOST_SIZE_RATIO = 3, 2.5
# Less than this is a camera that stands still, in metres and degrees.
STILL_M, STILL_DEG = 0.1, 10.0
FEW_FRAMES = 5
MIN_VALID_DEPTH = 0.2
# A shift of depth that its edges want by at least so much.
MIN_SHIFT_PX, MIN_SHIFT_GAIN = 8.0, 0.15
# Another assumption about the poses has to fit by so much better.
MIN_FIT_GAIN = 0.1
# It has to fit well; of frames from different places, less is enough if nothing else fits half as
# well.
MIN_OTHER_FIT, MIN_CLEAR_FIT = 0.6, 0.35
# Right poses give 0.95 and more, also with the noise of a Kinect; trembling ones above 0.8.
MIN_FIT = 0.65
# The same of frames from different places: right ones give 0.85 and more.
MIN_WIDE_FIT = 0.3
# Frames from different places agree that much better with another factor.
MIN_WIDE_GAIN = 0.03
MIN_ZOOM_GAIN = 0.1
# Half of the depths of a room are nearer than this. The least is a hand before the camera.
LEAST_MIDDLE_M, MOST_MIDDLE_M = 0.05, 8.0
# Intrinsics of one camera differ by less than this part of the focal length.
MOST_OTHER = 0.03
# Topics of depth that is registered to colour, whatever its frame.
REGISTERED = ("aligned", "registered", "depth_to_rgb", "depth_to_color")
REGISTER_REMEDY = (
    "Use the registered depth of the driver (aligned_depth_to_color of a RealSense with "
    "align_depth.enable:=true, depth_registered of OpenNI)."
)
INTRINSICS_REMEDY = (
    "Name the camera_info beside the colour images (--camera-info, or camera_info:=), or give "
    "--intrinsics FX,FY,CX,CY of the images."
)
SCALE_REMEDY = (
    "Set `inputs.depth_scale` to the metres per unit of the depth image (0.001 = mm, 0.0001 = "
    "0.1 mm, 0.0002 = TUM, 1 = m)."
)
# Causes of which one explains the others.
GEOMETRY = {
    "depth_unit", "not_registered", "other_intrinsics", "little_depth", "late_poses",
    "poses_of_the_body", "poses_of_opengl", "poses_inverted", "poses_do_not_fit",
}  # fmt: skip
# The z axis counts as up to about 15 degrees.
NEARLY_UP = 0.97
# Images of a camera that stands still agree.
MIN_STILL_FIT = 0.9
FEW_DETECTIONS_PER_FRAME = 0.5
# A reason that concerns fewer frames is not worth a sentence.
MIN_PART = 0.05
MOST_CLASSES = 12
# Stamps of a live camera are at most a second old; a minute is another clock.
MOST_BEHIND_S = 5.0


@dataclass(frozen=True)
class Finding:
    """Something that is off.

    Attributes:
        code: a stable name, for programs.
        problem: what is off, one sentence.
        cause: the probable cause, one sentence.
        remedy: what to do, one sentence.
        harmless: whether nothing has to be done.
    """

    code: str
    problem: str
    cause: str
    remedy: str
    harmless: bool = False

    def __str__(self) -> str:
        return f"{self.problem} {self.cause} {self.remedy}".strip()


Check = Callable[[Observations], Iterator[Finding]]


def find(seen: Observations) -> list[Finding]:
    """All findings, the most basic ones first.

    Of what makes depth, colour and poses disagree, only the first is named: it explains the rest.
    """
    found: list[Finding] = []
    explained = False
    for finding in (finding for check in CHECKS for finding in check(seen)):
        if finding.code not in GEOMETRY or not explained:
            found.append(finding)
        explained = explained or finding.code in GEOMETRY
    return found


def _nodes(seen: Observations) -> Iterator[Finding]:
    if seen.found_nodes is False:
        yield Finding(
            "no_nodes",
            "No node of deworldsg_ros publishes /diagnostics.",
            "None runs, or it runs in another ROS domain or behind another discovery range.",
            "Start one, and compare ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE of both "
            "terminals.",
        )


def _topics(seen: Observations) -> Iterator[Finding]:
    if seen.silent:
        others = list(dict.fromkeys(name for names in seen.silent.values() for name in names))
        yield Finding(
            "no_publisher",
            f"Nobody publishes {', '.join(seen.silent)}.",
            f"Of these types there are: {', '.join(others)}."
            if others
            else "No topics of these types are published at all.",
            "Start with their names: the launch arguments rgb, depth, camera_info and pose, or "
            f"`--ros-args -r {next(iter(seen.silent))}:=NAME`."
            if others
            else "Start the driver, in the same ROS domain (`ros2 topic list`).",
        )
    for text in seen.incompatible:
        yield Finding(
            "qos",
            f"{text}.",
            "DDS never connects a reliable subscriber to a best-effort publisher.",
            "Set `inputs.reliability` to auto.",
        )


def _clock(seen: Observations) -> Iterator[Finding]:
    known = {topic: age for topic, age in seen.behind_s.items() if abs(age) > MOST_BEHIND_S}
    for topic, age_s in known.items():
        where = "behind" if age_s > 0 else "ahead of"
        yield Finding(
            "clock",
            f"The stamps on {topic} are {abs(age_s):.0f} s {where} the clock of this machine.",
            "It is a recording, a simulation, or a machine with another clock.",
            "All inputs need one clock: synchronise the machines (chrony), or set use_sim_time "
            "everywhere and publish /clock.",
        )


def _losses(seen: Observations) -> Iterator[Finding]:
    lost = {reason[5:]: n for reason, n in seen.drops.items() if reason.startswith("lost_")}
    total = sum(lost.values())
    if total and total > MIN_PART * (seen.images or total):
        names = ", ".join(f"{count} of {name}" for name, count in lost.items())
        yield Finding(
            "lost_images",
            f"DDS lost messages: {names}.",
            "Its buffers hold less than an image, or the node is slower than the camera.",
            "Use config/fastdds.xml in every process (FASTRTPS_DEFAULT_PROFILES_FILE), allow "
            "shared memory in a container (--shm-size=512m), or lower the rate of the camera.",
        )


# Reason of a drop → code, problem, cause and remedy.
DROPS = {
    "not_depth": (
        "colour_as_depth",
        "{n} images on the depth topic are pictures and no distances.",
        "A colour topic, or depth drawn for people, was given as depth.",
        "Name the topic of the depth images (--depth TOPIC, or depth:=TOPIC).",
    ),
    "no_depth": (
        "no_depth",
        "{n} colour images have no depth image within `inputs.slop_s`.",
        "The two streams are not synchronised, or have different rates.",
        "Synchronise them in the driver (enable_sync of a RealSense), or raise `inputs.slop_s`.",
    ),
    "grid_mismatch": (
        "not_registered",
        "{n} depth images have another size than the colour image or its camera_info.",
        "Depth is not registered to colour, or the camera_info is that of another stream.",
        "Publish registered depth (align_depth.enable:=true of a RealSense) and name its topic.",
    ),
    "wrong_frame": (
        "other_frame",
        "{n} poses are in another world frame than the first.",
        "Two sources publish poses on one topic.",
        "Publish poses in one frame, and set `inputs.world_frame` to it.",
    ),
    "no_transform": (
        "no_transform",
        "{n} poses are of a robot frame that TF does not connect to the camera.",
        "The transform from the robot to the optical frame is not published.",
        "Publish it (robot_state_publisher), or set `inputs.pose_source` to odometry if the poses "
        "are those of the camera.",
    ),
    "no_pose": (
        "late_poses",
        "{n} images have no pose within `inputs.pose_slop_s`.",
        "The poses come late, too rarely, or with stamps of another clock.",
        "Compare the stamps of images and poses; raise `inputs.pose_slop_s` for slow poses; or use "
        "--odometry.",
    ),
    "pose_jump": (
        "pose_jumps",
        "The pose jumped at {n} images.",
        "The localisation jumps, two sources publish on one topic, or the positions are not in "
        "metres. {example}",
        "Look for a second publisher of poses, and use smooth poses (odom instead of map), or "
        "--odometry.",
    ),
    "no_camera_info": (
        "no_camera_info",
        "{n} images have no camera_info.",
        "It is not published, or not valid.",
        "Publish it, or give --intrinsics FX,FY,CX,CY.",
    ),
    "time_jump": (
        "clock",
        "The stamps jumped {n} times.",
        "A clock was set, a recording was restarted, or two publishers use different clocks.",
        "Use one clock for all inputs (chrony, or use_sim_time everywhere).",
    ),
    "overrun": (
        "too_slow",
        "{n} frames came faster than they could be processed, and were left out.",
        "The machine is slower than the camera.",
        "This costs looks, not correctness; lower the rate of the camera to 15 Hz or less.",
    ),
    "detector_error": (
        "detector_error",
        "The detector failed on {n} images.",
        "{example}",
        "Read the traceback in the log; if memory is short, choose a smaller model.",
    ),
}


def _drops(seen: Observations) -> Iterator[Finding]:
    for reason, (code, problem, cause, remedy) in DROPS.items():
        count = seen.drops.get(reason, 0)
        if count and count >= MIN_PART * (seen.images or count):
            example = seen.examples.get(reason, "")
            yield Finding(code, problem.format(n=count), cause.format(example=example), remedy)
    for reason, count in seen.drops.items():
        known = reason in DROPS or reason.startswith(("lost_", "unmatched_"))
        if count and count >= MIN_PART * (seen.images or count) and not known:
            example = seen.examples.get(reason, "")
            yield Finding(
                reason,
                f"{counted(count, 'message')} or frames are refused: {reason}.",
                f"For example: {example}." if example else "",
                seen.remedies.get(reason, ""),
            )


def _missing(seen: Observations) -> Iterator[Finding]:
    for text in seen.missing:
        if any(f" on {topic} " in text for topic in seen.silent):
            continue  # nobody publishes it
        lagging = " waits for " in text
        yield Finding(
            "late_input" if lagging else "no_input",
            f"{text[0].upper()}{text[1:]}.",
            "That input is slower, delayed, or has another clock." if lagging else "",
            "Compare the stamps of the inputs (`ros2 topic echo TOPIC --field header.stamp`)."
            if lagging
            else "Check the name of the topic and its publisher.",
        )


def _headers(seen: Observations) -> Iterator[Finding]:
    """What the messages say about themselves, before any picture is looked at."""
    rgb, depth, info = (seen.headers.get(name) for name in ("rgb", "depth", "camera_info"))
    if depth is not None and depth.middle_m is not None:
        yield from _unit(depth, depth.middle_m)
    if rgb is None:
        return
    if depth is not None and info is not None:
        yield from _other_camera(rgb, depth, info)
    camera = None if info is None else info.intrinsics
    if info is None or camera is None or rgb.size is None:
        return
    if (camera.width, camera.height) != rgb.size and camera.width > 0:
        yield Finding(
            "other_intrinsics",
            f"The camera_info on {info.topic} is for images of {camera.width} x {camera.height} "
            f"pixels, and those on {rgb.topic} have {rgb.size[0]} x {rgb.size[1]}.",
            "It is that of another stream, or the images were resized without it.",
            INTRINSICS_REMEDY,
        )


def _unit(depth: Header, middle_m: float) -> Iterator[Finding]:
    if LEAST_MIDDLE_M <= middle_m <= MOST_MIDDLE_M:
        return
    floats = depth.encoding.startswith("32FC1")
    yield Finding(
        "depth_unit",
        f"The depths on {depth.topic} ({depth.encoding}) are {middle_m:.2g} m in the middle.",
        "These are millimetres, and 32FC1 means metres (REP 118)."
        if floats and middle_m > MOST_MIDDLE_M
        else "Depth is in another unit than expected.",
        SCALE_REMEDY,
    )


def _other_camera(rgb: Header, depth: Header, info: Header) -> Iterator[Finding]:
    """Whether depth is of another camera than colour, by its camera_info and its frame."""
    ours, theirs = info.intrinsics, depth.intrinsics
    if ours is not None and theirs is not None:
        # Of another size, the intrinsics of one camera have another scale.
        scale = theirs.width / ours.width if ours.width and theirs.width else 1.0
        both = [np.array([k.fx, k.fy, k.cx, k.cy]) for k in (ours, theirs)]
        if (np.abs(both[1] - scale * both[0]) <= MOST_OTHER * theirs.fx).all():
            return
        seen = (
            f"The camera_info beside depth has the focal length {theirs.fx:.0f} and the middle "
            f"{theirs.cx:.0f}, {theirs.cy:.0f}; that of colour has {ours.fx:.0f} and "
            f"{ours.cx:.0f}, {ours.cy:.0f}."
        )
    elif depth.frame_id != rgb.frame_id and "" not in (depth.frame_id, rgb.frame_id):
        if any(word in depth.topic.lower() for word in REGISTERED):
            return
        seen = f"It is in the frame {depth.frame_id}, and colour is in {rgb.frame_id}."
    else:
        return
    yield Finding(
        "not_registered",
        f"The depth on {depth.topic} is that of another camera than the colour on {rgb.topic}.",
        seen,
        REGISTER_REMEDY,
    )


def _depth(seen: Observations) -> Iterator[Finding]:
    if seen.checks is not None and seen.checks.valid_depth < MIN_VALID_DEPTH:
        yield Finding(
            "little_depth",
            f"Only {seen.checks.valid_depth:.0%} of the pixels have a depth.",
            "Most values are zero, or beyond `inputs.max_depth_m`: the surfaces are too near, too "
            "far, black or of glass, or the unit is another.",
            "Look at the depth image; set `inputs.max_depth_m` to the range of the camera. "
            + SCALE_REMEDY,
        )


def _motion(seen: Observations) -> Iterator[Finding]:
    """The one assumption that explains best why depth does not fit the motion of the camera."""
    if seen.checks is None or GIVEN not in seen.checks.fits:
        return
    fits, wide = seen.checks.fits, seen.checks.wide
    if _stands(seen.checks):
        if fits[GIVEN] < MIN_STILL_FIT:
            yield Finding(
                "poses_do_not_fit",
                "The images move, and the poses stand still.",
                "The localisation does not run, or these are the poses of something else.",
                "Look at the poses (`ros2 topic echo`), or use --odometry.",
            )
        return
    # How much of the disagreement an assumption explains.
    explained: dict[str, float] = {}
    for name, fit in fits.items():
        gain = fit - fits[GIVEN]
        least = min(MIN_FIT_GAIN, (1.0 - fits[GIVEN]) / 2)
        if name != GIVEN and fit >= MIN_OTHER_FIT and gain >= least > MIN_WIDE_GAIN:
            explained[name] = gain / (1.0 - fits[GIVEN])
    others = max((wide[name] for name in (STILL, BODY, INVERSE) if name in wide), default=0.0)
    for kind in (FACTOR, FOCAL):
        factor = best_factor(wide, kind)
        if factor is not None:
            fit = max(fit for name, fit in wide.items() if name.startswith(kind))
            rest = max(wide[GIVEN], others)
            clear = fit >= min(MIN_OTHER_FIT, max(MIN_CLEAR_FIT, 2.0 * rest))
            if clear and fit >= max(wide[GIVEN] + MIN_WIDE_GAIN, others + MIN_FIT_GAIN):
                explained[f"{kind}{factor}"] = (fit - wide[GIVEN]) / (1.0 - wide[GIVEN])
    if explained:
        yield _explained(max(explained, key=lambda name: explained[name]), seen.checks)
    elif fits[GIVEN] < MIN_FIT or wide.get(GIVEN, 1.0) < MIN_WIDE_FIT:
        yield Finding(*POSES[STILL])


def _stands(checks: FrameChecks) -> bool:
    return checks.travel_m < STILL_M and checks.turn_deg < STILL_DEG


def _explained(best: str, checks: FrameChecks) -> Finding:
    if best in POSES:
        return Finding(*POSES[best])
    if best.startswith(LATE):
        delay_s = float(best[len(LATE) :])
        return Finding(
            "late_poses",
            f"The images fit the poses much better {abs(delay_s):g} s "
            f"{'later' if delay_s > 0 else 'earlier'}.",
            "The stamps of the poses are those of their arrival, or the clocks differ.",
            "Stamp poses with the time at which the camera was there, and synchronise the clocks.",
        )
    if best.startswith(FACTOR):
        factor = float(best[len(FACTOR) :])
        return Finding(
            "depth_unit",
            f"Depth fits the motion of the camera only if it is multiplied by {factor:.3g}.",
            "Depth is in another unit than expected, or the poses are not in metres.",
            SCALE_REMEDY + f" For poses, divide the positions by {factor:.3g}.",
        )
    factor = float(best[len(FOCAL) :])
    if checks.zoom_gain >= MIN_ZOOM_GAIN:
        return Finding(
            "not_registered",
            f"Depth has {factor:.2g} times the focal length of colour.",
            "It is the image of another camera, and not registered to colour.",
            REGISTER_REMEDY,
        )
    return Finding(
        "other_intrinsics",
        "The images fit the motion of the camera only if the focal length is multiplied by "
        f"{factor:.2g}.",
        "The camera_info or the intrinsics are those of another camera or of another image size.",
        INTRINSICS_REMEDY,
    )


def _sizes(seen: Observations) -> Iterator[Finding]:
    """Objects far from their usual size, where no motion tells the unit of depth."""
    if seen.checks is not None and seen.checks.wide.get(GIVEN, 0.0) >= MIN_FIT:
        return
    sized = sorted(
        (size / USUAL_SIZES_M[name], name, size)
        for name, size in seen.sizes
        if name in USUAL_SIZES_M
    )
    if len(sized) < MIN_SIZED:
        return
    ratio, name, size = sized[len(sized) // 2]
    if not 1 / MOST_SIZE_RATIO <= ratio <= MOST_SIZE_RATIO:
        yield Finding(
            "depth_unit",
            f"Objects are {ratio:.2g} times as large as usual: a {name} of {size:.2g} m.",
            "Depth is in another unit than expected.",
            SCALE_REMEDY,
        )


def _registration(seen: Observations) -> Iterator[Finding]:
    if seen.checks is None or seen.checks.shift_gain < MIN_SHIFT_GAIN:
        return
    u, v = seen.checks.depth_shift_px
    if np.hypot(u, v) >= MIN_SHIFT_PX:
        yield Finding(
            "not_registered",
            f"The edges of depth are about {np.hypot(u, v):.0f} pixels away from those of colour "
            f"({u:+.0f} columns, {v:+.0f} rows).",
            "Depth is not registered to colour, or the intrinsics are those of another stream.",
            REGISTER_REMEDY,
        )


# Assumption that fits much better → code, problem, cause and remedy.
POSES = {
    STILL: (
        "poses_do_not_fit",
        "The depth images of two moments do not agree under the poses.",
        "The poses are not those of this camera, or they tremble or jump.",
        "Check the frame of the poses and their stamps, or use --odometry.",
    ),
    BODY: (
        "poses_of_the_body",
        "The images fit the poses much better if x is taken as forward.",
        "The poses are those of the robot or of camera_link, and not of the optical frame.",
        "Publish the transform to the optical frame in TF, or poses of the optical frame (z "
        "forward, x right).",
    ),
    OPENGL: (
        "poses_of_opengl",
        "The images fit the poses much better if y is taken as up, and z as backward.",
        "The poses are those of a camera of OpenGL, ARKit or Blender, and not of ROS.",
        "Turn them: T_world_optical = T_world_camera · diag(1, -1, -1, 1).",
    ),
    INVERSE: (
        "poses_inverted",
        "The images fit the inverse of the poses much better.",
        "The poses take points of the world to the camera.",
        "Publish their inverse: the pose of the camera in the world.",
    ),
}


def _turned(seen: Observations) -> Iterator[Finding]:
    side = {turns: count for turns, count in seen.turns.items() if turns}
    if side:
        turns = max(side, key=lambda key: side[key])
        yield Finding(
            "turned",
            f"The camera is turned by {90 * min(turns, 4 - turns)} degrees in "
            f"{counted(sum(side.values()), 'frame')}.",
            "Up, which the poses give, is not at the top of the image.",
            "The images were turned upright for the detector; nothing has to be done.",
            harmless=True,
        )


def _up(seen: Observations) -> Iterator[Finding]:
    if not seen.up_world or seen.up_world[2] > NEARLY_UP:
        return
    axis = int(np.argmax(np.abs(seen.up_world)))
    nearest = "xyz"[axis] if seen.up_world[axis] > 0 else f"-{'xyz'[axis]}"
    values = ", ".join(f"{value:.2f}" for value in seen.up_world)
    yield Finding(
        "other_up",
        f"Up was taken from the poses: ({values}), and not +z.",
        "The world frame is not that of ROS, or the camera was held on its side.",
        f"Nothing has to be done if that is up; else set `inputs.world_up` ({nearest} is the "
        "nearest axis).",
        harmless=True,
    )


def _detector(seen: Observations) -> Iterator[Finding]:
    if seen.detections is None or not seen.frames:
        return
    if seen.detections < FEW_DETECTIONS_PER_FRAME * seen.frames:
        names = ", ".join(seen.classes[:MOST_CLASSES])
        more = len(seen.classes) - MOST_CLASSES
        known = f"{len(seen.classes)} classes: {names}" + (f", and {more} more" if more > 0 else "")
        yield Finding(
            "few_detections",
            f"The detector found {counted(seen.detections, 'object')} in "
            f"{counted(seen.frames, 'frame')}.",
            f"It knows {known}. Other things, dark or blurred images and far objects are missed.",
            "Check the picture (exposure, a lens cap, colours swapped), go nearer, lower "
            "`perception.score_threshold`, or use another detector.",
        )


def _unused(seen: Observations) -> Iterator[Finding]:
    if seen.unused_detector:
        yield Finding(
            "unused_detector",
            f"A stronger detector is in {seen.unused_detector}, and the embedded one was used.",
            "The embedded one is the default: it is small, and knows 80 classes.",
            f"To use it: {seen.its_settings}.",
            harmless=True,
        )


def _looks(seen: Observations) -> Iterator[Finding]:
    if not seen.frames:
        return
    hidden, checks = sum(seen.hidden.values()), seen.checks
    here = f"{counted(seen.nodes or 0, 'object')} in the graph, {hidden} hidden"
    if seen.frames < FEW_FRAMES:
        yield Finding(
            "few_frames",
            f"Only {counted(seen.frames, 'frame')} reached the graph: {here}.",
            "Existence, class and size of an object need several looks at it.",
            "Record for some seconds.",
        )
    elif checks is not None and _stands(checks):
        yield Finding(
            "still_camera",
            f"The camera stands still ({100 * checks.travel_m:.0f} cm, {checks.turn_deg:.0f} "
            f"degrees): {here}.",
            "Equal images count as one look, and sizes are those of the visible side.",
            "Move the camera around the objects.",
        )
    elif hidden and not seen.nodes:
        reasons = ", ".join(f"{count} {reason}" for reason, count in seen.hidden.items())
        yield Finding(
            "few_looks",
            f"No object is sure enough: {here} ({reasons}).",
            "They were seen too rarely, or the detector missed them in most frames.",
            "Look at them longer and from several sides, or set `output.min_existence` to 0 to see "
            "all of them.",
        )


CHECKS: tuple[Check, ...] = (
    _nodes,
    _topics,
    _clock,
    _missing,
    _losses,
    _headers,
    _drops,
    _motion,
    _registration,
    _depth,
    _sizes,
    _turned,
    _up,
    _detector,
    _unused,
    _looks,
)
