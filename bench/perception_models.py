"""Time per frame of the paper's detector, relation head and segmenters.

    python bench/perception_models.py [--device auto|cpu|cuda] [--only NAME …] [--repeat N]

The networks have published sizes and random weights. They run in the backends of the package.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import transformers
from safetensors.torch import save_file

from deworldsg_ros.checkpoints.cards import (
    DETECTOR_CARD,
    CheckpointCard,
    write_detector_card,
)
from deworldsg_ros.checkpoints.egtr_network import EgtrNetwork
from deworldsg_ros.checkpoints.loading import HEAD_FILE
from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception.backends.closed_set import ClosedSetDetector, EgtrRelationHead
from deworldsg_ros.perception.backends.sam import Sam2Segmenter, SamSegmenter
from deworldsg_ros.perception.protocols import SegmentedObjects
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.vocabulary import REPLICA_SSG_PREDICATES, VISUAL_GENOME_CLASSES

WIDTH, HEIGHT, OBJECTS = 640, 480, 12
INTRINSICS = Intrinsics(525.0, 525.0, 319.5, 239.5, WIDTH, HEIGHT)
RNG = np.random.default_rng(0)
RGB = RNG.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
DEPTH_M = np.ones((HEIGHT, WIDTH), np.float32)
CORNERS = np.sort(RNG.uniform(0, [[WIDTH], [HEIGHT]], (OBJECTS, 2, 2)), axis=2)
BOXES = CORNERS.transpose(0, 2, 1).reshape(OBJECTS, 4)
R18 = {"hidden_sizes": [64, 128, 256, 512], "depths": [2, 2, 2, 2], "layer_type": "basic"}

Frame = Callable[[], Any]


def rtdetr(folder: Path, device: str, **changes: Any) -> ClosedSetDetector:
    """A detector with the classes of Visual Genome and a relation head in one folder."""
    backbone = changes.pop("backbone", {})
    config = transformers.RTDetrConfig(
        backbone_config=transformers.RTDetrResNetConfig(
            **backbone, out_features=["stage2", "stage3", "stage4"]
        ),
        id2label=dict(enumerate(VISUAL_GENOME_CLASSES)),
        **changes,
    )
    transformers.RTDetrForObjectDetection(config).save_pretrained(folder)
    card = CheckpointCard(class_scores="softmax", predicates=REPLICA_SSG_PREDICATES)
    write_detector_card(folder / DETECTOR_CARD, card)
    head = EgtrNetwork(config.d_model, config.decoder_layers, len(REPLICA_SSG_PREDICATES))
    save_file(head.state_dict(), folder / HEAD_FILE)
    return ClosedSetDetector(PerceptionConfig(detector_path=str(folder), device=device, threads=0))


def detecting(**changes: Any) -> Callable[[Path, str], Frame]:
    """Detection in one image with an RT-DETR."""

    def build(folder: Path, device: str) -> Frame:
        detector = rtdetr(folder, device, **changes)
        return lambda: detector.detect(RGB, 0.0)

    return build


def relating(folder: Path, device: str) -> Frame:
    """The relation head on the queries of 12 objects."""
    detector = rtdetr(folder, device)
    head = EgtrRelationHead(PerceptionConfig(), detector)
    kept = detector.detect(RGB, 0.0).take(slice(OBJECTS))
    objects = SegmentedObjects(
        class_names=[VISUAL_GENOME_CLASSES[0]] * OBJECTS,
        scores=kept.scores,
        features=kept.features,
        instances=np.zeros((HEIGHT, WIDTH), np.uint16),
        depth_m=DEPTH_M,
        intrinsics=INTRINSICS,
        up_camera=np.array([0.0, -1.0, 0.0]),
    )
    return lambda: head.relate(objects, max_relations=10)


def segmenting(make: Callable[[], Any], backend: Any) -> Callable[[Path, str], Frame]:
    """The masks of 12 boxes in one image."""

    def build(folder: Path, device: str) -> Frame:
        make().save_pretrained(folder)
        config = PerceptionConfig(segmenter_path=str(folder), device=device, threads=0)
        segmenter = backend(config)
        return lambda: segmenter.segment(RGB, DEPTH_M, INTRINSICS, BOXES)

    return build


def sam2_tiny() -> Any:
    """SAM 2.1 tiny: the defaults of transformers."""
    return transformers.Sam2Model(transformers.Sam2Config())


def sam_base() -> Any:
    """SAM with ViT-B: the defaults of transformers."""
    return transformers.SamModel(transformers.SamConfig())


R18_DETECTOR = {
    "backbone": R18,
    "encoder_in_channels": [128, 256, 512],
    "hidden_expansion": 0.5,
    "decoder_layers": 3,
}
# Each builder saves a checkpoint in an empty folder and returns the call to time.
BUILDERS: dict[str, Callable[[Path, str], Frame]] = {
    "RT-DETR r18, 640": detecting(**R18_DETECTOR),
    "RT-DETR r50, 640": detecting(),
    "RT-DETR r50m, 3 of 6 layers, 640": detecting(hidden_expansion=0.5, decoder_layers=3),
    "EGTR head, 12 objects": relating,
    "SAM 2.1 tiny, 1024, 12 boxes": segmenting(sam2_tiny, Sam2Segmenter),
    "SAM ViT-B, 1024, 12 boxes": segmenting(sam_base, SamSegmenter),
}


def time_ms(frame: Frame, repeat: int) -> tuple[float, float]:
    """Median wall-clock and processor time. Backends return arrays on the CPU, after all work."""
    wall, processor = [], []
    for _ in range(repeat):
        started, used = time.perf_counter(), time.process_time()
        frame()
        wall.append(time.perf_counter() - started)
        processor.append(time.process_time() - used)
    return 1e3 * float(np.median(wall)), 1e3 * float(np.median(processor))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=["auto", "cpu", "cuda"], default="auto")
    parser.add_argument(
        "--only", nargs="*", default=[], help="only models whose name contains one of these"
    )
    parser.add_argument("--repeat", type=int, default=5, help="number of measurements")
    arguments = parser.parse_args()
    transformers.utils.logging.disable_progress_bar()
    torch.manual_seed(0)
    # Random weights produce subnormal numbers, which slow a CPU down. Trained weights do not.
    torch.set_flush_denormal(True)
    on_cuda = torch.cuda.is_available() and arguments.device != "cpu"
    device = torch.cuda.get_device_name() if on_cuda else f"CPU, {torch.get_num_threads()} threads"
    print(f"torch {torch.__version__}, {device}")
    print(f"{'':36} {'wall ms':>9} {'cpu ms':>9}")
    for name, build in BUILDERS.items():
        if arguments.only and not any(part in name for part in arguments.only):
            continue
        with tempfile.TemporaryDirectory() as folder:
            frame = build(Path(folder), arguments.device)
            frame()
            wall_ms, processor_ms = time_ms(frame, arguments.repeat)
        print(f"{name:36} {wall_ms:9.1f} {processor_ms:9.1f}", flush=True)


if __name__ == "__main__":
    main()
