"""Time of the paper's models at their published sizes, with random weights.

    python bench/models.py [--device auto|cpu|cuda] [--only NAME] [--turns 5]

It prints the median and the minimum of each model. The time does not depend on the weights. To add
a model, write a builder and add it to BUILDERS.
"""

from __future__ import annotations

import argparse
import gc
import platform
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import transformers

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from deworldsg_ros.checkpoints.cards import BackboneIdentity
from deworldsg_ros.checkpoints.loading import choose_device, choose_dtype
from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations import clip_models
from deworldsg_ros.relations.clip_models import FrozenBackbone
from deworldsg_ros.scene.errors import ConfigurationError

CLIP_LENGTH = RelationsConfig().clip_length
CROP = (300, 400)  # height and width of a crop before resizing, pixels


@dataclass(frozen=True)
class Run:
    """A call to time. One call processes `count` units."""

    call: Callable[[], object]
    unit: str
    count: int = 1


@dataclass(frozen=True)
class Choice:
    """Options of the command line."""

    device: torch.device
    dtype: torch.dtype
    batch_size: int


def vjepa2_of(layers: int, width: int, heads: int, mlp_ratio: float, size: int):
    """A builder of V-JEPA 2."""

    def build(choice: Choice) -> Run:
        config = transformers.VJEPA2Config(
            crop_size=size,
            hidden_size=width,
            num_hidden_layers=layers,
            num_attention_heads=heads,
            mlp_ratio=mlp_ratio,
            pred_num_hidden_layers=1,
        )
        model = transformers.VJEPA2Model(config)
        model.predictor = torch.nn.Identity()
        network = _on_device(model, choice)

        def features(videos):
            return network(videos, skip_predictor=True).last_hidden_state.mean(1)

        return _clips(choice, "vjepa2", width, size, clip_models.vjepa2_geometry(size), features)

    return build


def dinov2_of(layers: int, width: int, heads: int):
    """A builder of DINOv2 at 224 pixels."""

    def build(choice: Choice) -> Run:
        config = transformers.Dinov2Config(
            hidden_size=width, num_hidden_layers=layers, num_attention_heads=heads, image_size=518
        )
        network = _on_device(transformers.Dinov2Model(config), choice)

        def features(videos):
            tokens = network(videos.flatten(0, 1)).last_hidden_state[:, 0]
            return tokens.reshape(*videos.shape[:2], -1).mean(1)

        return _clips(choice, "dinov2", width, 224, clip_models.dinov2_geometry(224), features)

    return build


def rtdetr_of(depths: list[int], layer_type: str, widths: list[int], decoder_layers: int):
    """A builder of RT-DETR at 640 pixels: the network without the preprocessing."""

    def build(choice: Choice) -> Run:
        backbone = transformers.RTDetrResNetConfig(
            depths=depths,
            layer_type=layer_type,
            hidden_sizes=widths,
            out_features=["stage2", "stage3", "stage4"],
        )
        config = transformers.RTDetrConfig(
            backbone_config=backbone,
            encoder_in_channels=widths[1:],
            hidden_expansion=0.5 if layer_type == "basic" else 1.0,
            decoder_layers=decoder_layers,
        )
        model = _on_device(transformers.RTDetrForObjectDetection(config), choice)
        image = torch.rand(1, 3, 640, 640, device=choice.device, dtype=choice.dtype)
        return Run(lambda: model(image).logits.to("cpu"), "image")

    return build


def sam2_of(edge: int, boxes: int = 10):
    """A builder of SAM 2.1 tiny: one image and `boxes` prompts."""

    def build(choice: Choice) -> Run:
        config = transformers.Sam2Config()
        config.prompt_encoder_config.image_size = edge
        config.vision_config.backbone_config.image_size = [edge, edge]
        config.vision_config.backbone_feature_sizes = [[edge // n] * 2 for n in (4, 8, 16)]
        model = _on_device(transformers.Sam2Model(config), choice)
        image = torch.rand(1, 3, edge, edge, device=choice.device, dtype=choice.dtype)
        corners = torch.tensor([[0.1, 0.2, 0.6, 0.7]] * boxes, device=choice.device) * edge

        def call():
            masks = model(pixel_values=image, input_boxes=corners[None], multimask_output=False)
            return masks.pred_masks.to("cpu")

        return Run(call, f"image with {boxes} boxes")

    return build


# Published sizes: layers, width, heads, MLP ratio, pixels.
BUILDERS: dict[str, Callable[[Choice], Run]] = {
    "rtdetr-r18-640": rtdetr_of([2, 2, 2, 2], "basic", [64, 128, 256, 512], 3),
    "rtdetr-r50-640": rtdetr_of([3, 4, 6, 3], "bottleneck", [256, 512, 1024, 2048], 6),
    "sam2.1-tiny-512": sam2_of(512),
    "sam2.1-tiny-1024": sam2_of(1024),
    "dinov2-small": dinov2_of(12, 384, 6),
    "dinov2-base": dinov2_of(12, 768, 12),
    "dinov2-large": dinov2_of(24, 1024, 16),
    "vjepa2-vitl-256": vjepa2_of(24, 1024, 16, 4, 256),
    "vjepa2-vith-256": vjepa2_of(32, 1280, 16, 4, 256),
    "vjepa2-vitg-256": vjepa2_of(40, 1408, 22, 48 / 11, 256),
    "vjepa2-vitg-384": vjepa2_of(40, 1408, 22, 48 / 11, 384),
}


def _on_device(model, choice: Choice):
    return model.eval().requires_grad_(False).to(choice.device, choice.dtype)


def _clips(choice: Choice, family, width, size, geometry, features) -> Run:
    identity = BackboneIdentity(family, width, size, CLIP_LENGTH)
    backbone = FrozenBackbone(identity, geometry, choice.device, choice.dtype, features)
    generator = np.random.default_rng(0)
    shape = (CLIP_LENGTH, *CROP, 3)
    clips = [generator.integers(0, 256, shape).astype(np.uint8) for _ in range(choice.batch_size)]
    # The call copies the features to the CPU, so it ends when the device has finished.
    return Run(lambda: backbone.encode(clips), f"clip of {CLIP_LENGTH} frames", len(clips))


def device_name(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{platform.machine()} CPU, {torch.get_num_threads()} threads"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument("--only", default="", help="only models whose name contains this")
    parser.add_argument("--turns", type=int, default=5, help="number of measurements")
    parser.add_argument("--warm-up", type=int, default=1, help="calls before the measurements")
    parser.add_argument("--batch-size", type=int, default=1, help="clips per call")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    try:
        device = choose_device("--device", options.device)
    except ConfigurationError as error:
        sys.exit(f"error: {error}")
    choice = Choice(device, choose_dtype(device), options.batch_size)
    dtype = str(choice.dtype).removeprefix("torch.")
    print(f"{device_name(device)}, torch {torch.__version__}, {dtype}")
    print(f"{'model':18} {'median ms':>10} {'min ms':>10}   per")
    for name, build in BUILDERS.items():
        if options.only not in name:
            continue
        run = build(choice)
        for _ in range(options.warm_up):
            run.call()
        times_ms = np.array([timed(run) for _ in range(options.turns)])
        median_ms, min_ms = np.median(times_ms), times_ms.min()
        print(f"{name:18} {median_ms:10.1f} {min_ms:10.1f}   {run.unit}", flush=True)
        del run
        gc.collect()
        if device.type == "cuda":
            torch.cuda.empty_cache()


def timed(run: Run) -> float:
    """Milliseconds per unit."""
    start = time.perf_counter()
    with torch.inference_mode():
        run.call()
    return 1e3 * (time.perf_counter() - start) / run.count


if __name__ == "__main__":
    main()
