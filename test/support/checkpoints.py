"""Small checkpoints of world models and probes: real architectures and file formats."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers")

from support.relations import VOCABULARY  # noqa: E402  after the guards

from deworldsg_ros.checkpoints.cards import BackboneIdentity, ProbeCard  # noqa: E402
from deworldsg_ros.checkpoints.probe_network import Probe, build_network, save_probe  # noqa: E402
from deworldsg_ros.config import RelationsConfig  # noqa: E402
from deworldsg_ros.relations.world_model import ClipRequest, PairContext  # noqa: E402

CLIP_LENGTH = 4
SMALL = {"hidden_size": 48, "num_attention_heads": 4, "num_hidden_layers": 2}


def save_vjepa2(folder, seed=0, **changes):
    """Save a V-JEPA 2 with 48 features and 32 pixels and return its folder."""
    torch.manual_seed(seed)
    predictor = {"hidden_size": 48, "num_attention_heads": 4, "num_hidden_layers": 1}
    settings = {
        **{"crop_size": 32, "frames_per_clip": 64, "num_pooler_layers": 1, **SMALL},
        **{f"pred_{name}": value for name, value in predictor.items()},
        "pred_num_mask_tokens": 2,
    }
    config = transformers.VJEPA2Config(**{**settings, **changes})
    transformers.VJEPA2Model(config).save_pretrained(folder)
    return folder


def save_dinov2(folder, seed=0, **changes):
    torch.manual_seed(seed)
    config = transformers.Dinov2Config(**{**SMALL, "image_size": 56, **changes})
    transformers.Dinov2Model(config).save_pretrained(folder)
    return folder


def config_of(family, folder, **changes):
    settings = {"clip_length": CLIP_LENGTH, "world_model_path": str(folder)}
    return RelationsConfig(world_model=family, **{**settings, **changes})


def save_random_probe(folder, backbone: BackboneIdentity, **changes):
    torch.manual_seed(1)
    card = ProbeCard(backbone, VOCABULARY.predicates, **changes)
    probe = Probe(card, build_network(card).eval())
    save_probe(folder, probe)
    return folder


def clip(seed=0, height=40, width=50, length=CLIP_LENGTH):
    generator = np.random.default_rng(seed)
    return generator.integers(0, 256, (length, height, width, 3)).astype(np.uint8)


def request(seed=0, **shape):
    names = VOCABULARY.classes
    boxes = np.array([0.0, 0, 20, 30]), np.array([10.0, 5, 50, 40])
    pairs = tuple(
        PairContext(boxes[s], boxes[o], s, o, names[s], names[o]) for s, o in ((0, 1), (1, 0))
    )
    return ClipRequest(clip(seed, **shape), pairs, VOCABULARY)
