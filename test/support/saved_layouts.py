"""Checkpoints as older versions of transformers saved them: layout and outputs, no weights.

A file in `test/checkpoints/saved` has the content of `config.json`, the name, dtype and shape of
each parameter, and some outputs as numbers. The weights are computed from the names, so the file
is small, and any version makes the same checkpoint. tools/old_checkpoints makes the files; it
imports this module with an older version of transformers.
"""

import hashlib
import json
import math
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file

# Decimals that are stored. The last one differs between processors.
DECIMALS = 5
SIDE = 64
BOXES = [[4.0, 6.0, 30.0, 40.0], [10.0, 2.0, 60.0, 50.0]]


def noise(name: str, shape: list[int]) -> np.ndarray:
    """Uniform numbers in [-1, 1) that depend on the name only."""
    count = math.prod(shape)
    digest = hashlib.shake_256(name.encode()).digest(4 * count)
    values = np.frombuffer(digest, "<u4").astype(np.float64) / 2.0**31 - 1.0
    return values.reshape(shape)


def weights(parameters: dict[str, list]) -> dict[str, torch.Tensor]:
    """Weights for names, dtypes and shapes; activations neither grow nor fade."""
    made = {}
    for name, (dtype, shape) in parameters.items():
        values = noise(name, shape)
        if "int" in dtype:
            values = np.zeros(shape)
        elif len(shape) > 1 and "positional_embedding" not in name:
            gain = 0.2 if "bbox" in name else 1.0  # boxes inside the image
            values = gain * values * math.sqrt(3.0 / math.prod(shape[1:]))
        elif name.endswith(("running_var", "weight", "lambda1")):
            values = 1.0 + 0.5 * values
        elif len(shape) == 1:
            values = 0.1 * values
        made[name] = torch.from_numpy(values).to(getattr(torch, dtype))
    return made


def write_checkpoint(folder: Path, content: dict) -> Path:
    """The checkpoint of a file's content, as the older version saved it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text(json.dumps(content["config"]))
    save_file(weights(content["parameters"]), folder / "model.safetensors", {"format": "pt"})
    return folder


def parameters_of(path: Path) -> dict[str, list]:
    """Name, dtype and shape of the parameters in a safetensors file."""
    with safe_open(path, "pt") as opened:
        names = sorted(opened.keys())
        return {
            name: [str(opened.get_tensor(name).dtype).removeprefix("torch.")]
            + [list(opened.get_tensor(name).shape)]
            for name in names
        }


def picture(*shape: int) -> torch.Tensor:
    return torch.from_numpy(noise("picture", list(shape))).float()


def detector_outputs(model) -> dict[str, torch.Tensor]:
    output = model(picture(1, 3, SIDE, SIDE))
    return {"logits": output.logits[0, :4], "boxes": output.pred_boxes[0, :4]}


def segmenter_outputs(model) -> dict[str, torch.Tensor]:
    """Of a point and of boxes; see test_saved_layouts about the boxes of SAM 2."""
    side = 128
    embeddings = model.get_image_embeddings(picture(1, 3, side, side))
    last = embeddings[-1] if isinstance(embeddings, (list, tuple)) else embeddings
    point = torch.tensor([[[[60.0, 50.0]]]])
    pointed = model(image_embeddings=embeddings, input_points=point, multimask_output=False)
    boxed = model(
        image_embeddings=embeddings, input_boxes=torch.tensor([BOXES]), multimask_output=False
    )
    return {
        "embedding": last[0, :4, 0],
        "point": pointed.pred_masks[0, 0, 0, ::8, ::8],
        "boxes": boxed.pred_masks[0, :, 0, ::8, ::8],
    }


OUTPUTS = {
    "rtdetr": detector_outputs,
    "rtdetr_v2": detector_outputs,
    "sam": segmenter_outputs,
    "sam2": segmenter_outputs,
    "sam2_video": segmenter_outputs,
    "vjepa2": lambda model: {
        "feature": model(picture(1, 4, 3, 32, 32), skip_predictor=True).last_hidden_state.mean(
            dim=1
        )[0]
    },
    "dinov2": lambda model: {"feature": model(picture(1, 3, 56, 56)).last_hidden_state[0, 0]},
}


@torch.inference_mode()
def outputs(name: str, model) -> dict[str, list[float]]:
    """Some outputs of a model by name, flat."""
    found = OUTPUTS[name](model.eval().float())
    return {
        key: [round(value, DECIMALS) for value in tensor.flatten().tolist()]
        for key, tensor in found.items()
    }
