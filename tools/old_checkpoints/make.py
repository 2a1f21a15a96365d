"""Checkpoints of small networks as an older version of transformers saves them, as JSON files.

python tools/old_checkpoints/make.py OUT

Run it in an environment with that version, with test/ in PYTHONPATH. OUT/transformers-VERSION
gets a file for each model that the version has. test/checkpoints/test_saved_layouts.py reads them.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import torch
import transformers
from support.saved_layouts import outputs, parameters_of, write_checkpoint
from support.torch_models import rtdetr_config, sam2_config, sam_config

DETECTOR = {"decoder_layers": 2, "num_queries": 8}
VJEPA2 = {
    **{"crop_size": 32, "frames_per_clip": 64, "hidden_size": 24, "num_attention_heads": 2},
    **{"num_hidden_layers": 2, "pred_hidden_size": 24, "pred_num_attention_heads": 2},
    **{"pred_num_hidden_layers": 1, "pred_num_mask_tokens": 2, "num_pooler_layers": 1},
}
DINOV2 = {"hidden_size": 24, "num_attention_heads": 2, "num_hidden_layers": 2, "image_size": 56}


def models() -> dict[str, object]:
    """Models by name, without those that the version lacks."""
    makers = {
        "rtdetr": lambda: transformers.RTDetrForObjectDetection(rtdetr_config(1, **DETECTOR)),
        "rtdetr_v2": lambda: transformers.RTDetrV2ForObjectDetection(rtdetr_config(2, **DETECTOR)),
        "sam": lambda: transformers.SamModel(sam_config()),
        "sam2": lambda: transformers.Sam2Model(sam2_config(video=False)),
        "sam2_video": lambda: transformers.Sam2VideoModel(sam2_config(video=True)),
        "vjepa2": lambda: transformers.VJEPA2Model(transformers.VJEPA2Config(**VJEPA2)),
        "dinov2": lambda: transformers.Dinov2Model(transformers.Dinov2Config(**DINOV2)),
    }
    made = {}
    for name, make in makers.items():
        try:
            made[name] = make()
        except AttributeError as error:
            print(f"{name}: not in transformers {transformers.__version__} ({error})")
    return made


def loaded(name: str, model: object, folder: Path) -> object:
    """The checkpoint of a folder; that of a video model in the image model."""
    if name != "sam2_video":
        return type(model).from_pretrained(folder, use_safetensors=True)
    found = transformers.AutoConfig.from_pretrained(folder)
    parts = {
        part: {k: v for k, v in getattr(found, part).to_dict().items() if k != "model_type"}
        for part in ("prompt_encoder_config", "mask_decoder_config")
    }
    config = transformers.Sam2Config(vision_config=found.vision_config.to_dict(), **parts)
    return transformers.Sam2Model.from_pretrained(folder, config=config, use_safetensors=True)


def main(out: Path) -> None:
    """Write a file for each model."""
    torch.manual_seed(0)
    folder = out / f"transformers-{transformers.__version__}"
    folder.mkdir(parents=True, exist_ok=True)
    for name, model in models().items():
        with tempfile.TemporaryDirectory() as kept:
            model.save_pretrained(kept)
            content = {
                "config": json.loads((Path(kept) / "config.json").read_text()),
                "parameters": parameters_of(Path(kept) / "model.safetensors"),
            }
        with tempfile.TemporaryDirectory() as kept:
            write_checkpoint(Path(kept), content)
            content["outputs"] = outputs(name, loaded(name, model, Path(kept)))
        text = json.dumps(content, separators=(",", ":"))
        # A line for each parameter.
        text = text.replace('"parameters":{', '"parameters":{\n').replace("]],", "]],\n")
        (folder / f"{name}.json").write_text(text + "\n", encoding="utf-8")
        print(folder / f"{name}.json", len(text), {k: v[:3] for k, v in content["outputs"].items()})


if __name__ == "__main__":
    main(Path(sys.argv[1]))
