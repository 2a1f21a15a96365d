"""Make the embedded detector's weights: NanoDet with integers of 8 bits, from its float weights.

    pip install onnx
    python tools/calibration/quantize_detector.py FLOAT.onnx OUT.onnx IMAGE...

The images say only how large the activations are. The shipped weights were made from
deworldsg_ros/perception/weights/nanodet_g_416_coco.onnx of commit f64e255, with every fifth of the
250 images of a kitchen (7-Scenes, redkitchen).

The network is then rewritten, with the same results to the bit:

- Its input and its outputs are the 8-bit codes. Tables of their meaning are further outputs.
- It takes images as they are in memory, with a fourth channel, as the first convolution is twice as
  slow with three.
- The maximum is taken before the activation, which is monotone, of a fourth of the values.

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
import onnxruntime
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from deworldsg_ros.perception.backends.embedded import BINS, INPUT_SIZE, STRIDES, letterbox
from deworldsg_ros.scene.vocabulary import COCO_CLASSES

# Of the training images, BGR, 8-bit scale.
MEAN_BGR = np.array([103.53, 116.28, 123.675], dtype=np.float32)
STD_BGR = np.array([57.375, 57.12, 58.395], dtype=np.float32)
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
            same = np.tile(np.arange(256, dtype=np.uint8)[:, None], 3)
            values = letterbox(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), same)[0][..., 2::-1]
            yield {name: normalised(values).transpose(0, 3, 1, 2)}


def normalised(values_bgr: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Values (..., 3), 8-bit scale, as the network was trained with them."""
    return np.asarray((values_bgr.astype(np.float32) - MEAN_BGR) / STD_BGR)


class Rewriter:
    """Rewrites a quantized network in place.

    Args:
        model: as quantize_static makes it.
    """

    def __init__(self, model: onnx.ModelProto) -> None:
        self.graph = model.graph
        self._values = {item.name: item for item in self.graph.initializer}

    def rewrite(self) -> None:
        """All steps."""
        codes = self.take_codes()
        self.pool_first()
        logits = self.give_codes()
        scores = self.sigmoid(logits)
        for name, table in (("input_codes", codes), ("logits", logits), ("scores", scores)):
            self._add_value(f"{name}_table", table)
            self.graph.node.append(helper.make_node("Identity", [f"{name}_table"], [name]))
            self._add_output(name, table.dtype, table.shape)
        self._remove_unused()

    def take_codes(self) -> NDArray[np.uint8]:
        """Take codes (1, 416, 416, 4) as the input; returns those of RGB, (256, 3)."""
        quantize = self._user(self.graph.input[0].name)
        convolution = self._user(self._user(quantize.output[0]).output[0])
        weights = self._maker(convolution.input[1]).input[0]
        of_bgr = self._value(weights)
        of_rgba = np.zeros((len(of_bgr), 4, *of_bgr.shape[2:]), of_bgr.dtype)
        of_rgba[:, :3] = of_bgr[:, ::-1]
        self._values[weights].CopyFrom(numpy_helper.from_array(of_rgba, weights))
        step, zero = (self._value(name) for name in quantize.input[1:])
        del self.graph.input[:]
        shape = [1, INPUT_SIZE, INPUT_SIZE, 4]
        self.graph.input.append(helper.make_tensor_value_info("pixels", TensorProto.UINT8, shape))
        self.graph.node.remove(quantize)
        order = helper.make_node("Transpose", ["pixels"], quantize.output, perm=[0, 3, 1, 2])
        self.graph.node.insert(0, order)
        values = normalised(np.tile(np.arange(256, dtype=np.uint8)[:, None], 3))[:, ::-1]
        return np.asarray(np.clip(np.rint(values / step) + zero, 0, 255).astype(np.uint8))

    def pool_first(self) -> None:
        """Activation, padding, maximum → maximum, activation, and a change of step."""
        pool = next(node for node in self.graph.node if node.op_type == "MaxPool")
        pad = self._maker(pool.input[0])
        padded = self._maker(pad.input[0])
        after = self._maker(padded.input[0])
        activation = self._maker(after.input[0])
        before = self._maker(activation.input[0])
        result = self._user(pool.output[0])
        at = list(self.graph.node).index(activation)
        for node in (activation, after, padded, pad, pool, result):
            self.graph.node.remove(node)
        alpha = helper.get_attribute_value(activation.attribute[0])
        window = {"kernel_shape": [3, 3], "strides": [2, 2], "pads": [1, 1, 1, 1]}
        node = helper.make_node
        added = [
            node("MaxPool", before.output, ["pooled"], **window),
            node("QuantizeLinear", ["pooled", *before.input[1:]], ["pooled_codes"]),
            node("DequantizeLinear", ["pooled_codes", *before.input[1:]], ["pooled_values"]),
            node("LeakyRelu", ["pooled_values"], ["active"], alpha=alpha),
            node("QuantizeLinear", ["active", *after.input[1:]], ["active_codes"]),
            node("DequantizeLinear", ["active_codes", *after.input[1:]], ["active_values"]),
            # With this layer, which changes no value, the change of step is one look-up.
            node("LeakyRelu", ["active_values"], ["same"], alpha=1.0),
            node("QuantizeLinear", ["same", *result.input[1:]], result.output),
        ]
        for place, item in enumerate(added, at):
            self.graph.node.insert(place, item)

    def give_codes(self) -> NDArray[np.float32]:
        """Give codes (1, rows, columns, 124) of each stride; returns their logits, (3, 256)."""
        logits = []
        del self.graph.output[:]
        splits = [node for node in self.graph.node if node.op_type == "Split"]
        for stride, split in zip(STRIDES, splits, strict=True):
            values = self._maker(split.input[0])
            step, zero = (self._value(name) for name in values.input[1:])
            logits.append((np.arange(256, dtype=np.float32) - np.float32(zero)) * step)
            name, side = f"codes_{stride}", -(-INPUT_SIZE // stride)
            order = helper.make_node("Transpose", values.input[:1], [name], perm=[0, 2, 3, 1])
            self.graph.node.append(order)
            shape = (1, side, side, len(COCO_CLASSES) + 4 * BINS)
            self._add_output(name, np.dtype(np.uint8), shape)
        return np.stack(logits)

    @staticmethod
    def sigmoid(logits: NDArray[np.float32]) -> NDArray[np.float32]:
        """As ONNX Runtime computes it."""
        ends = [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, logits.shape) for name in "xy"
        ]
        node = helper.make_node("Sigmoid", ["x"], ["y"])
        graph = helper.make_graph([node], "sigmoid", ends[:1], ends[1:])
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=7)
        session = onnxruntime.InferenceSession(
            model.SerializeToString(), providers=["CPUExecutionProvider"]
        )
        return np.asarray(session.run(None, {"x": logits})[0])

    def _value(self, name: str) -> NDArray[np.generic]:
        return np.asarray(numpy_helper.to_array(self._values[name]))

    def _add_value(self, name: str, value: NDArray[np.generic]) -> None:
        self.graph.initializer.append(numpy_helper.from_array(value, name))

    def _add_output(self, name: str, dtype: np.dtype[np.generic], shape: tuple[int, ...]) -> None:
        kind = helper.np_dtype_to_tensor_dtype(dtype)
        self.graph.output.append(helper.make_tensor_value_info(name, kind, shape))

    def _maker(self, name: str) -> onnx.NodeProto:
        return next(node for node in self.graph.node if name in node.output)

    def _user(self, name: str) -> onnx.NodeProto:
        return next(node for node in self.graph.node if name in node.input)

    def _remove_unused(self) -> None:
        used = {output.name for output in self.graph.output}
        for node in reversed(list(self.graph.node)):
            if used.isdisjoint(node.output):
                self.graph.node.remove(node)
            else:
                used.update(node.input)
        for item in [item for item in self.graph.initializer if item.name not in used]:
            self.graph.initializer.remove(item)


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
    model = onnx.load(target)
    Rewriter(model).rewrite()
    onnx.checker.check_model(model)
    onnx.save(model, target)
    return 0


if __name__ == "__main__":
    sys.exit(main())
