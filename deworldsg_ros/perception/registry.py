"""Backends by the name the configuration uses; a new one is a file and a line here.

A backend's module is imported only when it is chosen, so that nobody pays for what is not used.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception.protocols import Detector, RelationHead, Segmenter
from deworldsg_ros.perception.stage import Perception
from deworldsg_ros.perception.vocabularies import PREDICATE_SETS
from deworldsg_ros.scene.errors import ConfigurationError

Made = TypeVar("Made")


def _nanodet(config: PerceptionConfig) -> Detector:
    from deworldsg_ros.perception.nanodet import NanoDetDetector

    return NanoDetDetector(threads=config.threads)


def _rgbd(config: PerceptionConfig) -> Segmenter:
    from deworldsg_ros.perception.rgbd_segmenter import RgbdSegmenter

    return RgbdSegmenter()


def _geometric(config: PerceptionConfig) -> RelationHead:
    from deworldsg_ros.perception.geometric_head import GeometricRelationHead

    return GeometricRelationHead(PREDICATE_SETS[config.predicate_set])


DETECTORS: dict[str, Callable[[PerceptionConfig], Detector]] = {"nanodet": _nanodet}
SEGMENTERS: dict[str, Callable[[PerceptionConfig], Segmenter]] = {"rgbd": _rgbd}
RELATION_HEADS: dict[str, Callable[[PerceptionConfig], RelationHead]] = {"geometric": _geometric}


def build_perception(config: PerceptionConfig, *, world_up: str = "auto") -> Perception:
    """The stage with the backends that `config` names.

    Args:
        config: the section `perception`.
        world_up: axis of the world frame that points up: auto, z, y or -y.

    Raises:
        ConfigurationError: a backend or an axis that does not exist, with those that do.
    """
    return Perception(
        _choose("perception.detector", config.detector, DETECTORS)(config),
        _choose("perception.segmenter", config.segmenter, SEGMENTERS)(config),
        _choose("perception.relation_head", config.relation_head, RELATION_HEADS)(config),
        config,
        world_up=world_up,
    )


def _choose(parameter: str, name: str, known: Mapping[str, Made]) -> Made:
    if name not in known:
        raise ConfigurationError(f"{parameter} is {name!r}: wanted one of {', '.join(known)}")
    return known[name]
