"""Backends by their name in the configuration. A new backend is a file and a line here, or an
entry point of another package (`base/plugins.py`).

The module of a backend is imported only if the configuration names it, because torch is optional
and slow to import.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TypeVar, cast

import msgspec

from deworldsg_ros.base.plugins import PluginError, load_plugin
from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception.protocols import Detector, Embedder, RelationHead, Segmenter
from deworldsg_ros.perception.stage import Perception
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.vocabulary import PREDICATE_SETS

Made = TypeVar("Made")


def _pair(config: PerceptionConfig) -> Detector:
    from deworldsg_ros.perception.backends.embedded import PairDetector

    return PairDetector(threads=config.threads)


def _nanodet(config: PerceptionConfig) -> Detector:
    from deworldsg_ros.perception.backends.embedded import NanoDetDetector

    return NanoDetDetector(threads=config.threads)


def _transformers(config: PerceptionConfig) -> Detector:
    with _torch("perception.detector", config.detector, config):
        from deworldsg_ros.perception.backends.closed_set import ClosedSetDetector

    return ClosedSetDetector(config)


def _open_vocabulary(config: PerceptionConfig) -> Detector:
    with _torch("perception.detector", config.detector, config):
        from deworldsg_ros.perception.backends.open_vocabulary import OpenVocabularyDetector

    return OpenVocabularyDetector(config)


def _onnx(config: PerceptionConfig) -> Detector:
    from deworldsg_ros.perception.backends.onnx_detector import OnnxDetector

    return OnnxDetector(config)


def _topic(config: PerceptionConfig) -> Detector:
    from deworldsg_ros.perception.source import DetectionSource

    return DetectionSource(config.words)


def _rgbd(config: PerceptionConfig) -> Segmenter:
    from deworldsg_ros.perception.backends.rgbd import RgbdSegmenter

    return RgbdSegmenter()


def _sam2(config: PerceptionConfig) -> Segmenter:
    with _torch("perception.segmenter", config.segmenter, config):
        from deworldsg_ros.perception.backends.sam import Sam2Segmenter

    return Sam2Segmenter(config)


def _sam(config: PerceptionConfig) -> Segmenter:
    with _torch("perception.segmenter", config.segmenter, config):
        from deworldsg_ros.perception.backends.sam import SamSegmenter

    return SamSegmenter(config)


def _sam3(config: PerceptionConfig) -> Segmenter:
    with _torch("perception.segmenter", config.segmenter, config):
        from deworldsg_ros.perception.backends.sam import Sam3Segmenter

    return Sam3Segmenter(config)


def _geometric(config: PerceptionConfig, detector: Detector) -> RelationHead:
    from deworldsg_ros.perception.backends.geometric import GeometricRelationHead

    if config.predicate_set == "checkpoint":
        raise ConfigurationError(
            "perception.predicate_set is 'checkpoint', but the relation head 'geometric' has none: "
            f"set it to one of {', '.join(PREDICATE_SETS)}"
        )
    return GeometricRelationHead(PREDICATE_SETS[config.predicate_set])


def _egtr(config: PerceptionConfig, detector: Detector) -> RelationHead:
    with _torch("perception.relation_head", config.relation_head, config):
        from deworldsg_ros.perception.backends.closed_set import EgtrRelationHead

    return EgtrRelationHead(config, detector)


def _embedder(config: PerceptionConfig) -> Embedder:
    with _torch("perception.embedder", config.embedder, config):
        from deworldsg_ros.perception.backends.embedder import ImageEmbedder

    return ImageEmbedder(config)


DETECTORS: dict[str, Callable[[PerceptionConfig], Detector]] = {
    "nanodet": _nanodet,
    "pair": _pair,
    "transformers": _transformers,
    # The same, by the name of the paper's detector.
    "rtdetr": _transformers,
    "open_vocabulary": _open_vocabulary,
    "onnx": _onnx,
    "topic": _topic,
}
# Torch has one setting of its threads for the thread that sets it, and a GPU takes one frame after
# the other anyway.
THREAD_SAFE_DETECTORS = {"pair", "nanodet", "onnx"}
SEGMENTERS: dict[str, Callable[[PerceptionConfig], Segmenter]] = {
    "rgbd": _rgbd,
    "sam2": _sam2,
    "sam3": _sam3,
    "sam": _sam,
}
# A relation head may read features of its detector.
RELATION_HEADS: dict[str, Callable[[PerceptionConfig, Detector], RelationHead]] = {
    "geometric": _geometric,
    "egtr": _egtr,
}


def build_perception(
    config: PerceptionConfig,
    *,
    world_up: str = "auto",
    detector: Detector | None = None,
    overlapped: bool = False,
) -> Perception:
    """Perception with the backends that `config` names.

    Args:
        config: the section `perception`.
        world_up: axis of the world frame that points up, or auto.
        detector: replaces the configured detector.
        overlapped: whether the detector shall take several frames at the same time, with one
            thread for each; if it can. It needs less processor time for each frame, but a single
            frame takes longer.

    Raises:
        ConfigurationError: an unknown backend or axis, or a checkpoint that cannot be used.
    """
    # Check all names before loading the first checkpoint.
    make_detector = _choose("perception.detector", config.detector, DETECTORS)
    make_segmenter = _choose("perception.segmenter", config.segmenter, SEGMENTERS)
    make_head = _choose("perception.relation_head", config.relation_head, RELATION_HEADS)
    detectors = 0
    if overlapped and detector is None and config.detector in THREAD_SAFE_DETECTORS:
        detectors = config.threads or len(os.sched_getaffinity(0))
        detector = make_detector(msgspec.structs.replace(config, threads=1))
    elif detector is None:
        detector = make_detector(config)
    head = make_head(config, detector)
    return Perception(
        detector,
        make_segmenter(config),
        head,
        config,
        world_up=world_up,
        detectors=detectors,
        embedder=_embedder(config) if config.embedder else None,
    )


@contextmanager
def _torch(parameter: str, name: str, config: PerceptionConfig) -> Iterator[None]:
    """Import a backend that needs torch, an optional dependency, and set torch's threads."""
    try:
        yield
    except ImportError as error:
        raise ConfigurationError(
            f"{parameter} is '{name}', which needs torch, transformers and safetensors ({error}): "
            "pip install torch transformers safetensors"
        ) from error
    if config.threads:
        import torch

        torch.set_num_threads(config.threads)


def _choose(parameter: str, name: str, known: Mapping[str, Made]) -> Made:
    if name in known:
        return known[name]
    try:
        return cast(Made, load_plugin(parameter, name, known))
    except PluginError as error:
        raise ConfigurationError(str(error)) from error
