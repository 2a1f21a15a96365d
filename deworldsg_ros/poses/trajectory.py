"""Trajectory files (TUM, KITTI, one pose file a frame), and seeded perturbation of poses."""

from __future__ import annotations

import math
import re
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from deworldsg_ros.base.files import read_regular, write_atomically
from deworldsg_ros.base.words import stamp_ns_from_text
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import (
    RgbdFrame,
    check_pose,
    interpolate_pose,
    invert_pose,
    pose_from_quaternion,
    quaternion_from_rotation,
    rigid_motion,
)
from deworldsg_ros.scene.errors import ConfigurationError, DeWorldSGError, RefusedInput

# --- Perturbation of poses, seeded: drift, jitter and jumps.


@dataclass(frozen=True)
class PoseNoise:
    """Errors that are added to poses.

    Attributes:
        jitter_m: standard deviation of each position axis, independent in each frame.
        jitter_deg: standard deviation of the rotation about each axis, independent in each frame.
        drift_m_per_m: translation error for each metre of the path, in a constant direction of the
            camera frame, as from a wrong scale or calibration.
        drift_deg_per_m: rotation error for each metre of the path, about a constant axis.
        jump_probability: fraction of frames with a wrong position in that frame only.
        jump_m: position error of such a frame.
        seed: of the random numbers.

    Raises:
        ConfigurationError: for a value that is negative or not finite, or a probability above 1.
    """

    jitter_m: float = 0.0
    jitter_deg: float = 0.0
    drift_m_per_m: float = 0.0
    drift_deg_per_m: float = 0.0
    jump_probability: float = 0.0
    jump_m: float = 3.0
    seed: int = 0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not math.isfinite(value) or value < 0:
                raise ConfigurationError(f"pose noise {field.name} is {value}: expected >= 0")
        if self.jump_probability > 1:
            raise ConfigurationError(
                f"pose noise jump_probability is {self.jump_probability}: expected <= 1"
            )


def parse_noise(text: str) -> PoseNoise:
    """PoseNoise from ``name=number,name=number,…``; raises ConfigurationError."""
    values = parse_numbers(text, [field.name for field in fields(PoseNoise)], "pose noise")
    seed = int(values.pop("seed", 0))
    return PoseNoise(**values, seed=seed)


def parse_numbers(text: str, names: Sequence[str], what: str) -> dict[str, float]:
    """Numbers by name from ``name=number,name=number,…``.

    Raises:
        ConfigurationError: names `what`, the word, and the allowed names.
    """
    values: dict[str, float] = {}
    for word in filter(None, text.split(",")):
        name, equals, number = word.partition("=")
        try:
            if not equals or name.strip() not in names:
                raise ValueError
            values[name.strip()] = float(number)
        except ValueError as error:
            raise ConfigurationError(
                f"{what} '{word}': expected NAME=NUMBER, NAME one of {', '.join(names)}"
            ) from error
    return values


def perturb_poses(frames: Iterable[RgbdFrame], noise: PoseNoise) -> Iterator[RgbdFrame]:
    """The frames with perturbed poses; the same noise and frames give the same poses.

    They bring no trajectory: what odometry has corrected was not what was perturbed.
    """
    perturbation = Perturbation(noise)
    for frame in frames:
        T = perturbation.apply(frame.T_world_camera)
        yield replace(frame, T_world_camera=T, trajectory=None)


class Perturbation:
    """Perturbs one pose after another.

    Args:
        noise: the errors.
    """

    def __init__(self, noise: PoseNoise) -> None:
        self._noise = noise
        rng = self._rng = np.random.default_rng(noise.seed)
        self._drift_direction = _unit(rng.normal(size=3))
        self._drift_axis = _unit(rng.normal(size=3))
        self._before: Float64 | None = None
        self._drifted = np.eye(4)

    def apply(self, T_world_camera: Float64) -> Float64:
        """The next pose (4, 4), perturbed; the first one has no drift."""
        noise, rng = self._noise, self._rng
        if self._before is None:
            self._drifted = T_world_camera
        else:
            step = invert_pose(self._before) @ T_world_camera
            length_m = float(np.linalg.norm(step[:3, 3]))
            error = rigid_motion(
                noise.drift_m_per_m * length_m * self._drift_direction,
                np.radians(noise.drift_deg_per_m * length_m) * self._drift_axis,
            )
            self._drifted = self._drifted @ step @ error
        self._before = T_world_camera
        # All numbers are drawn in each frame: one kind of noise does not change another.
        jitter = rigid_motion(
            noise.jitter_m * rng.normal(size=3), np.radians(noise.jitter_deg) * rng.normal(size=3)
        )
        jumps, direction = rng.random() < noise.jump_probability, _unit(rng.normal(size=3))
        T = self._drifted @ jitter
        if jumps:
            T[:3, 3] += noise.jump_m * direction
        return T


def _unit(vector: Float64) -> Float64:
    return np.asarray(vector / np.linalg.norm(vector))


# --- Trajectory files: TUM, KITTI, and folders with one pose file for each frame (3RScan).
#
# All formats contain poses of the colour camera, camera to world, metres. TUM poses have stamps and
# are interpolated. KITTI has one line for each image, in order. Pose files have the frame number.

# 10^7 poses, which is a day at 100 Hz.
MAX_FILE_BYTES = 1 << 30
FORMATS = ("tum", "kitti", "3rscan", "slam")
SUFFIXES = {"3rscan": ".pose.txt", "slam": ".slam.pose.txt"}
FRAME_NAME = re.compile(r"frame-(\d+)(\.slam)?\.pose\.txt\Z")
COLUMNS = {8: "tum", 12: "kitti"}


class TrajectoryError(DeWorldSGError):
    """A trajectory file cannot be used."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses by stamp, by frame number or by position in the sequence.

    Attributes:
        kind: the format it was read from.
        keys: ascending; nanoseconds (TUM), frame numbers (pose files) or positions from 0 (KITTI).
        T_world_cameras: (n, 4, 4) float64.
        missing: number of frames without a valid pose, as written by a tracker that was lost.
    """

    kind: str
    keys: tuple[int, ...]
    T_world_cameras: Float64
    missing: int = 0

    def __len__(self) -> int:
        return len(self.keys)

    def at(self, stamp_ns: int, number: int, position: int, slop_ns: int) -> Float64 | None:
        """The pose (4, 4) of an image; None if there is none.

        Args:
            stamp_ns: of the image.
            number: of its frame, from the file names.
            position: in the sequence, from 0.
            slop_ns: maximum time to a pose; interpolation needs poses within it on both sides.
        """
        if self.kind == "tum":
            return self._at_stamp(stamp_ns, slop_ns)
        key = position if self.kind == "kitti" else number
        row = bisect_left(self.keys, key)
        return self.T_world_cameras[row] if self.keys[row : row + 1] == (key,) else None

    def _at_stamp(self, stamp_ns: int, slop_ns: int) -> Float64 | None:
        keys, poses = self.keys, self.T_world_cameras
        row = bisect_left(keys, stamp_ns)
        after_ns = keys[row] - stamp_ns if row < len(keys) else slop_ns + 1
        if after_ns == 0:
            return poses[row]
        before_ns = stamp_ns - keys[row - 1] if row else slop_ns + 1
        if before_ns <= slop_ns and after_ns <= slop_ns:
            fraction = before_ns / (before_ns + after_ns)
            return interpolate_pose(poses[row - 1], poses[row], fraction)
        if min(before_ns, after_ns) > slop_ns:
            return None
        return poses[row - 1] if before_ns <= slop_ns else poses[row]


def read_trajectory(path: Path, kind: str = "auto") -> Trajectory:
    """Read a trajectory.

    Args:
        path: file, or folder of frame-NNNNNN.pose.txt or .slam.pose.txt.
        kind: tum, kitti, 3rscan, slam; auto = by the columns or the file names.

    Raises:
        TrajectoryError: names the file, the line, the value and the expected one.
    """
    if kind not in ("auto", *FORMATS):
        raise TrajectoryError(f"trajectory format '{kind}': expected auto, {', '.join(FORMATS)}")
    if path.is_dir():
        if kind not in ("auto", *SUFFIXES):
            raise TrajectoryError(f"trajectory {path} is a folder: expected a file for {kind}")
        return _read_folder(path, kind)
    if kind in SUFFIXES:
        raise TrajectoryError(
            f"trajectory {path}: expected the folder that contains frame-NNNNNN{SUFFIXES[kind]}"
        )
    lines = _lines(path)
    if kind == "auto":
        number, words = lines[0]
        if len(words) not in COLUMNS:
            raise TrajectoryError(
                f"{path}, line {number} has {len(words)} values: expected 8 (TUM: stamp tx ty tz "
                "qx qy qz qw) or 12 (KITTI: 3x4 matrix, row by row)"
            )
        kind = COLUMNS[len(words)]
    return _read_tum(path, lines) if kind == "tum" else _read_kitti(path, lines)


def write_tum(path: Path, stamps_ns: Sequence[int], T_world_cameras: Sequence[Float64]) -> None:
    """Write poses (4, 4) as a TUM file; raises TrajectoryError where it cannot be written."""
    rows = ["# stamp tx ty tz qx qy qz qw: colour camera to world, metres"]
    for stamp_ns, T in zip(stamps_ns, T_world_cameras):
        numbers = [*T[:3, 3].tolist(), *quaternion_from_rotation(T[:3, :3]).tolist()]
        seconds, rest = divmod(stamp_ns, 10**9)
        rows.append(" ".join([f"{seconds}.{rest:09d}", *(f"{value:.9g}" for value in numbers)]))
    try:
        write_atomically(path, "\n".join(rows) + "\n")
    except OSError as error:
        raise TrajectoryError(f"trajectory {path}: cannot be written ({error.strerror})") from error


Line = tuple[int, list[str]]


def _lines(path: Path) -> list[Line]:
    """Line numbers and words of all lines except comments."""
    try:
        text = read_regular(path, MAX_FILE_BYTES).decode(errors="replace")
    except OSError as error:
        raise TrajectoryError(f"trajectory {path}: cannot be read ({error.strerror})") from error
    lines = [
        (number, words)
        for number, line in enumerate(text.splitlines(), start=1)
        if (words := line.split("#")[0].replace(",", " ").split())
    ]
    if not lines:
        raise TrajectoryError(f"trajectory {path} has no poses: expected one in each line")
    return lines


def _pose(path: Path, line: Line, expected: str, make: Callable[[Float64], Float64]) -> Float64:
    """The pose from the numbers of a line; raises TrajectoryError."""
    number, words = line
    try:
        return make(np.array(words, np.float64))
    except (ValueError, RefusedInput) as error:
        raise TrajectoryError(
            f"{path}, line {number}: '{' '.join(words)}': {error}; expected {expected}"
        ) from error


def _read_tum(path: Path, lines: list[Line]) -> Trajectory:
    expected = "stamp tx ty tz qx qy qz qw, seconds and metres, with a unit quaternion"
    keys: list[int] = []
    poses = []
    for number, words in lines:
        try:
            stamp_ns = stamp_ns_from_text(words[0])
        except ValueError as error:
            raise TrajectoryError(
                f"{path}, line {number}: '{words[0][:40]}' is no stamp: expected {expected}"
            ) from error
        _check_count(path, (number, words), 8, expected)
        if keys and stamp_ns <= keys[-1]:
            raise TrajectoryError(
                f"{path}, line {number}: stamp {words[0]} is not later than the one before: "
                "expected ascending stamps"
            )
        keys.append(stamp_ns)
        poses.append(
            _pose(path, (number, words[1:]), expected, lambda v: pose_from_quaternion(v[:3], v[3:]))
        )
    return Trajectory("tum", tuple(keys), np.array(poses))


def _read_kitti(path: Path, lines: list[Line]) -> Trajectory:
    expected = "12 numbers, the 3x4 matrix of a rigid transform row by row"
    poses = []
    for line in lines:
        _check_count(path, line, 12, expected)
        poses.append(_pose(path, line, expected, _matrix))
    return Trajectory("kitti", tuple(range(len(poses))), np.array(poses))


def _check_count(path: Path, line: Line, count: int, expected: str) -> None:
    number, words = line
    if len(words) != count:
        raise TrajectoryError(f"{path}, line {number} has {len(words)} values: expected {expected}")


def _matrix(values: Float64) -> Float64:
    """A rigid transform from 12 or 16 numbers, with an exact rotation."""
    T = np.eye(4)
    T[:3] = values.reshape(-1, 4)[:3]
    check_pose(T)
    return pose_from_quaternion(T[:3, 3], quaternion_from_rotation(T[:3, :3]))


def _read_folder(path: Path, kind: str) -> Trajectory:
    found = [(file, match) for file in path.iterdir() if (match := FRAME_NAME.match(file.name))]
    if kind == "auto":
        kind = "slam" if any(match[2] for _, match in found) else "3rscan"
    files = sorted((int(m[1]), file) for file, m in found if bool(m[2]) == (kind == "slam"))
    if not files:
        raise TrajectoryError(
            f"trajectory {path}: no frame-NNNNNN{SUFFIXES[kind]} in it, expected one for each frame"
        )
    keys, poses, missing = [], [], 0
    for number, file in files:
        words = [word for _, line in _lines(file) for word in line]
        if len(words) != 16:
            raise TrajectoryError(f"{file} has {len(words)} values: expected a 4x4 matrix")
        try:
            poses.append(_matrix(np.array(words, np.float64)))
        except ValueError as error:
            raise TrajectoryError(f"{file}: {error}; expected a 4x4 matrix") from error
        except RefusedInput:  # -inf or NaN: the tracker had lost the camera
            missing += 1
            continue
        keys.append(number)
    if not keys:
        raise TrajectoryError(f"trajectory {path}: none of its {missing} poses is valid")
    return Trajectory(kind, tuple(keys), np.array(poses), missing)
