"""Make the embedded detector's weights: NanoDet with integers of 8 bits, from its float weights.

    pip install onnx
    python tools/calibration/quantize_detector.py FLOAT.onnx OUT.onnx IMAGE...

The images say only how large the activations are. The shipped weights were made from
deworldsg_ros/perception/weights/nanodet_g_416_coco.onnx of commit f64e255, with every fifth of the
250 images of a kitchen (7-Scenes, redkitchen).

Weights have 7 bits. With 8, processors with AVX2 and without VNNI would saturate sums of two
products, and find other objects than the rest.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import onnx
from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from deworldsg_ros.perception.backends.nanodet import letterbox

# Layers between convolutions stay in integers too; the last layers' outputs are floats.
QUANTIZED = ["Conv", "MaxPool", "Concat", "Add", "LeakyRelu", "Resize"]


class Images(CalibrationDataReader):
    """Inputs of the network, one for each image."""

    def __init__(self, name: str, paths: list[Path]) -> None:
        self._inputs = self._read(name, paths)

    def get_next(self) -> dict[str, np.ndarray] | None:
        """The next input; None = no more."""
        return next(self._inputs, None)

    @staticmethod
    def _read(name: str, paths: list[Path]) -> Iterator[dict[str, np.ndarray]]:
        for path in paths:
            image = cv2.imread(str(path))
            if image is None:
                sys.exit(f"error: {path} is no image")
            yield {name: letterbox(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))[0]}


def main() -> int:
    if len(sys.argv) < 4:
        print(__doc__, file=sys.stderr)
        return 2
    source, target, *images = map(Path, sys.argv[1:])
    name = onnx.load(source).graph.input[0].name
    with tempfile.TemporaryDirectory() as folder:
        prepared = Path(folder) / "prepared.onnx"
        quant_pre_process(source, prepared, skip_symbolic_shape=True)
        quantize_static(
            prepared,
            target,
            Images(name, images),
            op_types_to_quantize=QUANTIZED,
            per_channel=True,
            reduce_range=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
