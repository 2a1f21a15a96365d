"""Detectors of fixed classes as ONNX, for processors without torch; also with 8 bits."""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from deworldsg_ros.base.files import together, write_atomically
from deworldsg_ros.checkpoints.cards import ONNX_CARD, OnnxCard
from deworldsg_ros.checkpoints.catalogue import ONNX_FILE
from deworldsg_ros.checkpoints.loading import noise_pattern
from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception.backends.closed_set import ClosedSetDetector
from deworldsg_ros.perception.backends.onnx_detector import (
    INPUT,
    OUTPUTS,
    OnnxDetector,
    network_input,
)
from deworldsg_ros.scene.arrays import UInt8
from deworldsg_ros.scene.errors import ConfigurationError

# Largest difference of a score to that of torch; float32 sums in another order give 1e-4.
MAX_DIFFERENCE = 1e-3
# Layers in integers. The others of a transformer lose too much: its products of activations.
QUANTIZED = ["Conv"]


class Exported(NamedTuple):
    """What an export made.

    Attributes:
        bytes: of the network.
        difference: largest difference of a score to torch, on the images.
        classes: number of classes.
    """

    bytes: int
    difference: float
    classes: int


def export_detector(path: str, out: Path, images: Sequence[UInt8] = ()) -> Exported:
    """Write a checkpoint as `model.onnx` and `model.json` into a folder.

    Args:
        path: folder or hub id of the checkpoint.
        out: created if missing.
        images: (H, W, 3) uint8 each, of where the detector is to be used: with some, the
            convolutions get 8 bits, for values as large as theirs.

    Raises:
        ConfigurationError: a checkpoint that cannot be exported, a package that is missing, or a
            network whose scores differ from those of torch.
    """
    try:
        import onnx
        import onnx_ir  # noqa: F401
        import transformers.exporters  # noqa: F401
    except ImportError as error:
        raise ConfigurationError(
            f"the export needs onnx, onnxscript and transformers 5.23 ({error}): pip install "
            "onnx onnxscript 'transformers>=5.23'"
        ) from error
    detector = ClosedSetDetector(PerceptionConfig(detector_path=path, device="cpu"))
    if detector.preprocess.fit != "stretch":
        raise ConfigurationError(
            f"detector '{path}' ({type(detector.model).__name__}) takes images of any size, and an "
            "export has one: choose D-FINE, RT-DETR, RF-DETR, or run it on torch"
        )
    card = _card(detector)
    try:
        with together(out, (ONNX_FILE, ONNX_CARD)) as staged:
            network = staged / ONNX_FILE
            with _quiet():
                _write_network(detector, path, network)
                if images:
                    _make_8_bits(network, card, images)
                onnx.checker.check_model(str(network))
            content = msgspec.json.format(msgspec.json.encode(card), indent=2)
            write_atomically(staged / ONNX_CARD, content + b"\n")
            difference = _difference(detector, staged, [_noise(detector), *images[:8]])
            if not images and not difference <= MAX_DIFFERENCE:
                raise ConfigurationError(
                    f"detector '{path}': a score of the export differs by {difference:.4f} from "
                    f"that of torch, expected at most {MAX_DIFFERENCE}: nothing was written"
                )
            size = network.stat().st_size
    except OSError as error:
        raise ConfigurationError(f"{out}: {error.strerror or error}") from error
    return Exported(size, difference, len(card.classes))


def _noise(detector: ClosedSetDetector) -> UInt8:
    noise: UInt8 = noise_pattern(detector.preprocess.height, detector.preprocess.width, 3).numpy()
    return noise


def _card(detector: ClosedSetDetector) -> OnnxCard:
    preprocess, reading = detector.preprocess, detector.reading
    return OnnxCard(
        reading.classes,
        tuple(reading.columns.tolist()),
        preprocess.height,
        preprocess.width,
        preprocess.mean,
        preprocess.std,
        detector.card.class_scores,
        reading.no_object,
        detector.card.temperature,
        detector.default_score_threshold,
    )


def _write_network(detector: ClosedSetDetector, path: str, network: Path) -> None:
    """Write a network in float32, with the outputs `OUTPUTS` only."""
    import onnx_ir
    from onnx_ir.passes.common import RemoveUnusedNodesPass

    exporters: Any = import_module("transformers.exporters")
    pixels = detector.preprocess(_noise(detector), detector.device, detector.dtype)
    try:
        program: Any = (
            exporters.OnnxExporter()
            .export(detector.model, {INPUT: pixels}, config=exporters.OnnxConfig(dynamic=False))
            .program
        )
        kept = [value for value in program.graph.outputs if value.name in OUTPUTS]
        program.graph.outputs.clear()
        program.graph.outputs.extend(kept)
        RemoveUnusedNodesPass()(program)
        onnx_ir.save(program, str(network))
    except Exception as error:  # torch and its exporter have errors of their own
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise ConfigurationError(
            f"detector '{path}' ({type(detector.model).__name__}) cannot be exported by "
            f"transformers ({reason})"
        ) from error


def _make_8_bits(network: Path, card: OnnxCard, images: Sequence[UInt8]) -> None:
    """As `tools/calibration/quantize_detector.py` makes the embedded weights, convolutions only."""
    from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static
    from onnxruntime.quantization.shape_inference import quant_pre_process

    class Images(CalibrationDataReader):
        def __init__(self) -> None:
            self._left = iter(images)

        def get_next(self) -> dict[str, Any] | None:
            image = next(self._left, None)
            return None if image is None else {INPUT: network_input(image, card)}

    prepared, made = (network.with_name(f"{name}.onnx") for name in ("prepared", "int8"))
    quant_pre_process(network, prepared, skip_symbolic_shape=True)
    quantize_static(
        prepared,
        made,
        Images(),
        op_types_to_quantize=QUANTIZED,
        per_channel=True,
        # With 8 bits, processors with AVX2 and without VNNI would saturate sums of two products.
        reduce_range=True,
        activation_type=QuantType.QUInt8,
        weight_type=QuantType.QInt8,
    )
    prepared.unlink()
    made.replace(network)


def _difference(detector: ClosedSetDetector, out: Path, images: Sequence[UInt8]) -> float:
    """Largest difference of a score, of the best ones in order; rounding may swap queries."""
    exported = OnnxDetector(PerceptionConfig(detector_path=str(out)))
    worst = [
        np.abs(exported.detect(image, 0.0).scores - detector.detect(image, 0.0).scores).max()
        for image in images
    ]
    return float(max(worst))


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the steps and warnings of torch's exporter."""
    with redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        before = logging.root.manager.disable
        logging.disable(logging.WARNING)
        try:
            yield
        finally:
            logging.disable(before)
