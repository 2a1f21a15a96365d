"""Perturbation of poses, seeded: drift, jitter and jumps."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import RgbdFrame, invert_pose
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.rigid import rigid_motion


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
    """The frames with perturbed poses; the same noise and frames give the same poses."""
    perturbation = Perturbation(noise)
    for frame in frames:
        yield replace(frame, T_world_camera=perturbation.apply(frame.T_world_camera))


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
