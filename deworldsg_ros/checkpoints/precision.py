"""Half precision is used only if it gives the results of single precision; NaN is an error."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable
from typing import Any

import torch

from deworldsg_ros.checkpoints.loading import is_out_of_memory
from deworldsg_ros.scene.errors import RefusedInput

logger = logging.getLogger(__name__)

# Relative error of the results in half precision (of norms). Measured on the small networks of the
# tests, with random weights: float16 0.05 % (V-JEPA 2, DINOv2), 0.2 % (SAM 2, SAM 3), 0.3 %
# (RT-DETR), 2 % (SAM), 10 % (RT-DETRv2); bfloat16 1 % (SAM 3), 4 % (SAM 2), 47 % (SAM). Trained
# networks were not measured. A network that overflows gives NaN.
MAX_RELATIVE_ERROR = 0.1
# A network, its data type → some of its results on an input that `run` makes, any shape.
Run = Callable[[Any, torch.dtype], torch.Tensor]


def in_best_precision(
    model: Any, device: torch.device, half: torch.dtype, run: Run, what: str
) -> tuple[Any, torch.dtype]:
    """The network on its device: in half precision if that is exact enough, else in single.

    Both precisions run once. The network is twice in memory until this function returns.

    Args:
        model: in float32.
        device: where it runs.
        half: float16 or bfloat16; float32 = no comparison.
        run: results of a network on an image or a clip.
        what: name of the network, for the log.
    """
    single = model.to(device, torch.float32)
    if half == torch.float32:
        return single, half
    expected = run(single, torch.float32).detach().float()
    error = _error(single, half, run, expected)
    if error <= MAX_RELATIVE_ERROR:
        return single.to(half), half
    reason = "NaN or infinity" if error == float("inf") else f"a relative error of {error:.1%}"
    logger.warning(
        "%s: %s gives %s against float32 on the test input; it runs in float32, which is slower "
        "and takes twice the memory",
        *(what, str(half).removeprefix("torch."), reason),
    )
    return single, torch.float32


def _error(single: Any, half: torch.dtype, run: Run, expected: torch.Tensor) -> float:
    """Relative error of the results in half precision; infinity if they are not finite."""
    try:
        found = run(copy.deepcopy(single).to(half), half).detach().float()
    except RuntimeError as error:
        if is_out_of_memory(error):
            raise
        logger.warning("%s is not supported here (%s)", half, str(error).splitlines()[0])
        return float("inf")
    if not bool(torch.isfinite(found).all()):
        return float("inf")
    return float((found - expected).norm() / expected.norm().clamp_min(1e-12))


def require_finite(values: torch.Tensor, reason: str, what: str) -> None:
    """Refuse results with NaN or infinity, which would pass for "nothing found".

    Raises:
        RefusedInput: under `reason`.
    """
    bad = int((~torch.isfinite(values)).sum())
    if bad:
        raise RefusedInput(
            reason,
            f"{bad} of {values.numel()} values of {what} are NaN or infinite in "
            f"{str(values.dtype).removeprefix('torch.')}: run on the CPU (perception.device: cpu), "
            "or report it with `deworldsg models inspect`",
        )


def noise_pattern(*shape: int) -> torch.Tensor:
    """uint8 values of a fixed random image or clip, on the CPU."""
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)
