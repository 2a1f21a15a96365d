"""Small checkpoints of the detectors and segmenters: real architectures and file formats."""

import json

import numpy as np
import pytest

torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers")
tokenizers = pytest.importorskip("tokenizers")

from safetensors.torch import save_file  # noqa: E402  after the guards

from deworldsg_ros.checkpoints.cards import DETECTOR_CARD, CheckpointCard, write_detector_card  # noqa: E402
from deworldsg_ros.checkpoints.egtr_network import EgtrNetwork  # noqa: E402
from deworldsg_ros.config import PerceptionConfig  # noqa: E402
from deworldsg_ros.perception import SegmentedObjects  # noqa: E402
from deworldsg_ros.scene.camera import Intrinsics  # noqa: E402

WIDTH = 32
LAYERS = 4
QUERIES = 30
CLASSES = ("bed", "chair", "desk", "lamp", "sofa", "table")
PREDICATES = ("above", "near", "on")
IMAGENET = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}


def image(height=48, width=64, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)


def rtdetr_config(version=1, labels=CLASSES, **changes):
    backbone = transformers.RTDetrResNetConfig(
        embedding_size=8,
        hidden_sizes=[16, 24, 32, 40],
        depths=[1, 1, 2, 1],
        layer_type="bottleneck",
        out_features=["stage2", "stage3", "stage4"],
    )
    settings = {
        "encoder_hidden_dim": WIDTH,
        "encoder_in_channels": [24, 32, 40],
        "encoder_ffn_dim": 48,
        "d_model": WIDTH,
        "num_queries": QUERIES,
        "decoder_in_channels": [WIDTH] * 3,
        "decoder_ffn_dim": 40,
        "decoder_layers": LAYERS,
        "hidden_expansion": 0.5,
        "id2label": dict(enumerate(labels)),
        "label2id": {name: index for index, name in enumerate(labels)},
    }
    family = transformers.RTDetrConfig if version == 1 else transformers.RTDetrV2Config
    return family(backbone_config=backbone, **{**settings, **changes})


def random_rtdetr(version=1, **changes):
    """An RT-DETR with different queries. The default initialisation makes them equal."""
    torch.manual_seed(0)
    config = rtdetr_config(version, **changes)
    family = (
        transformers.RTDetrForObjectDetection
        if version == 1
        else transformers.RTDetrV2ForObjectDetection
    )
    return randomised(family(config).eval())


def randomised(model):
    """The network with outputs that differ. The default initialisation makes them equal."""
    with torch.no_grad():
        for name, value in model.named_parameters():
            if value.ndim > 1:
                value.normal_(0, 1.4 / value[0].numel() ** 0.5)
            elif name.endswith("weight"):  # normalisation
                value.uniform_(0.5, 1.5)
            elif "class_embed" in name:
                value.normal_(-1, 0.5)
        for name, value in model.named_buffers():
            if name.endswith("running_var"):
                value.uniform_(0.5, 1.5)
    return model


def save_rtdetr(folder, version=1, card=None, normalise=False, **changes):
    """Save an RT-DETR like `deworldsg models import-fross`; without a card, like the model hub."""
    random_rtdetr(version, **changes).save_pretrained(folder)
    preprocessing = {"size": {"height": 64, "width": 64}, "do_normalize": normalise, **IMAGENET}
    (folder / "preprocessor_config.json").write_text(json.dumps(preprocessing))
    if card is not None:
        write_detector_card(folder / DETECTOR_CARD, card)
    return folder


def random_head():
    """A relation head with random weights."""
    torch.manual_seed(0)
    classes, predicates = len(CLASSES), len(PREDICATES)
    network = EgtrNetwork(WIDTH, LAYERS, predicates, (classes + 1, classes + 1, predicates))
    with torch.no_grad():
        for value in network.parameters():
            value.normal_(0, 0.3)
    return network.eval()


def save_paper_checkpoint(folder, card_changes=None, **changes):
    """Save a softmax detector and a relation head in one folder."""
    card = {"class_scores": "softmax", "score_threshold": 0.3, "predicates": PREDICATES}
    card = CheckpointCard(**{**card, "frequency_bias": True, **(card_changes or {})})
    save_rtdetr(folder, card=card, normalise=True, **changes)
    save_file(random_head().state_dict(), folder / "egtr_head.safetensors")
    return folder


# Of all segmenters. The image has 128 pixels, and 112 for SAM 3.
PROMPT = {"hidden_size": 32, "image_size": 128, "mask_input_channels": 4}
DECODER = {"hidden_size": 32, "mlp_dim": 48, "iou_head_hidden_dim": 32}
# Of SAM 2 and 3 for videos.
MEMORY = {
    "memory_attention_hidden_size": 32,
    "memory_attention_feed_forward_hidden_size": 32,
    "memory_encoder_hidden_size": 32,
    "memory_encoder_output_channels": 16,
    "mask_downsampler_embed_dim": 32,
    "memory_fuser_embed_dim": 32,
    "memory_fuser_intermediate_dim": 32,
}


def save_segmenter(folder, family, config):
    """Save a segmenter with masks that have some pixels, but not all."""
    torch.manual_seed(0)
    model = family(config)
    decoder = getattr(model, "tracker_model", model).mask_decoder
    with torch.no_grad():
        for name, value in decoder.named_parameters():
            if "norm" not in name:
                value.normal_(0, 0.3)
    model.save_pretrained(folder)
    return folder


def sam2_config(video=False):
    """Configuration of a small SAM 2, in the format of images or videos."""
    backbone = {
        "hidden_size": 12,
        "image_size": [128, 128],
        "embed_dim_per_stage": [12, 24, 48, 96],
        "num_attention_heads_per_stage": [1, 2, 4, 8],
        "blocks_per_stage": [1, 1, 2, 1],
        "global_attention_blocks": [3],
        "window_positional_embedding_background_size": [4, 4],
    }
    vision = transformers.Sam2VisionConfig(
        backbone_config=transformers.Sam2HieraDetConfig(**backbone),
        backbone_channel_list=[96, 48, 24, 12],
        backbone_feature_sizes=[[32, 32], [16, 16], [8, 8]],
        fpn_hidden_size=32,
    )
    parts = {
        "vision_config": vision,
        "prompt_encoder_config": {**PROMPT, "patch_size": 16},
        "mask_decoder_config": DECODER,
    }
    if not video:
        return transformers.Sam2Config(**parts)
    return transformers.Sam2VideoConfig(**parts, image_size=128, **MEMORY)


def save_sam2(folder, video=False):
    """Save a small SAM 2, in the format of images or videos."""
    family = transformers.Sam2VideoModel if video else transformers.Sam2Model
    return save_segmenter(folder, family, sam2_config(video))


def save_sam3(folder, video=False, text=None):
    """Save a small SAM 3: its tracker alone, or detector and tracker as published."""
    vision = {
        "backbone_config": {
            **{"model_type": "sam3_vit_model", "hidden_size": 32, "intermediate_size": 64},
            **{"num_hidden_layers": 2, "num_attention_heads": 2, "image_size": 112},
            **{"window_size": 4, "global_attn_indexes": [1], "pretrain_image_size": 56},
        },
        "fpn_hidden_size": 32,
        "backbone_feature_sizes": [[32, 32], [16, 16], [8, 8]],
    }
    tracker = {
        "vision_config": transformers.Sam3VisionConfig(**vision),
        "prompt_encoder_config": {**PROMPT, "image_size": 112, "patch_size": 14},
        "mask_decoder_config": DECODER,
    }
    if not video:
        config = transformers.Sam3TrackerConfig(**tracker)
        return save_segmenter(folder, transformers.Sam3TrackerModel, config)
    small = {"hidden_size": 32, "intermediate_size": 32, "num_attention_heads": 2}
    text = {"num_hidden_layers": 1, "projection_dim": 32, "vocab_size": 99, **(text or {})}
    config = transformers.Sam3VideoConfig(
        detector_config=transformers.Sam3Config(
            vision_config=transformers.Sam3VisionConfig(**vision),
            text_config={**small, **text, "model_type": "clip_text_model"},
            geometry_encoder_config={**small, "num_layers": 1},
            detr_encoder_config={**small, "num_layers": 1},
            detr_decoder_config={**small, "num_layers": 1, "num_queries": 4},
            mask_decoder_config={"hidden_size": 32, "num_attention_heads": 2},
        ),
        tracker_config=transformers.Sam3TrackerVideoConfig(
            **tracker,
            **MEMORY,
            memory_attention_num_layers=1,
            memory_attention_rope_feat_sizes=[8, 8],
        ),
    )
    config.image_size = 112  # of all parts
    return save_segmenter(folder, transformers.Sam3VideoModel, config)


def sam_config():
    """Configuration of a small SAM."""
    vision = {
        **{"hidden_size": 24, "output_channels": 32, "num_pos_feats": 16, "num_hidden_layers": 2},
        **{"num_attention_heads": 2, "image_size": 128, "window_size": 4, "mlp_dim": 48},
        "global_attn_indexes": [1],
    }
    return transformers.SamConfig(
        vision_config=vision,
        prompt_encoder_config={**PROMPT, "image_embedding_size": 8},
        mask_decoder_config=DECODER,
    )


def save_sam(folder):
    """Save a small SAM."""
    return save_segmenter(folder, transformers.SamModel, sam_config())


def segmented(class_names, scores, features=None):
    """Objects for a relation head that ignores images."""
    instances, depth_m = np.zeros((4, 4), np.uint16), np.zeros((4, 4), np.float32)
    camera = Intrinsics(4.0, 4.0, 1.5, 1.5, 4, 4)
    up_camera = np.array([0.0, -1.0, 0.0])
    return SegmentedObjects(class_names, scores, features, instances, depth_m, camera, up_camera)


def settings(**changes):
    return PerceptionConfig(**{"device": "cpu", "threads": 1, **changes})


def save_dfine(folder):
    """A D-FINE with random weights, saved as on the model hub."""
    torch.manual_seed(0)
    backbone = transformers.HGNetV2Config(
        stem_channels=[3, 4, 8],
        stage_in_channels=[8, 16, 32, 64],
        stage_mid_channels=[4, 8, 8, 16],
        stage_out_channels=[16, 32, 64, 64],
        stage_num_blocks=[1] * 4,
        stage_numb_of_layers=[1] * 4,
        embedding_size=8,
        hidden_sizes=[16, 32, 64, 64],
        out_features=["stage2", "stage3", "stage4"],
    )
    config = transformers.DFineConfig(
        backbone_config=backbone,
        d_model=WIDTH,
        encoder_hidden_dim=WIDTH,
        encoder_in_channels=[32, 64, 64],
        encoder_ffn_dim=WIDTH,
        decoder_in_channels=[WIDTH] * 3,
        decoder_ffn_dim=WIDTH,
        decoder_layers=2,
        num_queries=QUERIES,
        id2label=dict(enumerate(CLASSES)),
        label2id={name: index for index, name in enumerate(CLASSES)},
    )
    model = randomised(transformers.DFineForObjectDetection(config).eval())
    model.save_pretrained(folder)
    preprocessing = {"size": {"height": 64, "width": 64}, "do_normalize": False}
    (folder / "preprocessor_config.json").write_text(json.dumps(preprocessing))
    return model


# Of CLIP and SigLIP: words of their texts, and sizes of both towers.
WORDS = ["<pad>", "<unk>", "<s>", "</s>", "a", "cup", "red", "sofa", "to", "drink", "from"]
TOWER = {
    **{"hidden_size": 16, "intermediate_size": 24, "num_attention_heads": 2},
    "num_hidden_layers": 2,
}


def save_two_towers(folder, family="clip"):
    """A CLIP or SigLIP with random weights, with a tokenizer of a few words; the whole model."""
    torch.manual_seed(0)
    text = {**TOWER, "vocab_size": len(WORDS), "max_position_embeddings": 9}
    text |= {"pad_token_id": 0, "bos_token_id": 2, "eos_token_id": 3}
    vision = {**TOWER, "image_size": 32, "patch_size": 8}
    if family == "clip":
        config = transformers.CLIPConfig(text_config=text, vision_config=vision, projection_dim=12)
        model = transformers.CLIPModel(config)
    else:
        config = transformers.SiglipConfig(text_config=text, vision_config=vision)
        model = transformers.SiglipModel(config)
    model = randomised(model.eval())
    model.save_pretrained(folder)
    size = {"shortest_edge": 32} if family == "clip" else {"height": 32, "width": 32}
    content = {"size": size, "do_normalize": True, **IMAGENET}
    (folder / "preprocessor_config.json").write_text(json.dumps(content))
    words = {word: index for index, word in enumerate(WORDS)}
    core = tokenizers.Tokenizer(tokenizers.models.WordLevel(words, unk_token="<unk>"))
    core.pre_tokenizer = tokenizers.pre_tokenizers.Whitespace()
    core.post_processor = tokenizers.processors.TemplateProcessing(
        single="<s> $A </s>", special_tokens=[("<s>", 2), ("</s>", 3)]
    )
    special = {"unk_token": "<unk>", "pad_token": "<pad>", "eos_token": "</s>", "bos_token": "<s>"}
    transformers.PreTrainedTokenizerFast(tokenizer_object=core, **special).save_pretrained(folder)
    return model


def save_closed_set(folder, family):
    """A small detector of a family, saved as on the model hub; its network."""
    torch.manual_seed(0)
    names = ("N/A", *CLASSES)  # as the ids of COCO
    shared = {
        **{"d_model": WIDTH, "num_queries": 12, "decoder_layers": 2, "decoder_ffn_dim": 32},
        "id2label": dict(enumerate(names)),
        "label2id": {name: index for index, name in enumerate(names)},
    }
    detr = {"encoder_layers": 1, "encoder_ffn_dim": 32, "use_timm_backbone": False}
    detr |= {"encoder_attention_heads": 2, "decoder_attention_heads": 2, **shared}
    backbone = {"embedding_size": 8, "hidden_sizes": [8, 16, 24, 32], "depths": [1] * 4}
    last = transformers.ResNetConfig(**backbone, layer_type="basic", out_features=["stage4"])
    three = [f"stage{n}" for n in (2, 3, 4)]
    several = transformers.ResNetConfig(**backbone, layer_type="basic", out_features=three)
    vit = {"hidden_size": 32, "num_hidden_layers": 4, "num_attention_heads": 2}
    if family == "detr":
        config = transformers.DetrConfig(backbone_config=last, **detr)
    elif family == "deformable_detr":
        config = transformers.DeformableDetrConfig(backbone_config=several, **detr)
    elif family == "yolos":
        config = transformers.YolosConfig(
            **{**vit, "intermediate_size": 32, "image_size": [64, 96], "num_detection_tokens": 12},
            **{key: shared[key] for key in ("id2label", "label2id")},
        )
    else:
        dinov2 = {**vit, "model_type": "rf_detr_dinov2", "mlp_ratio": 1, "image_size": 64}
        dinov2 |= {"patch_size": 16, "num_windows": 2, "out_features": ["stage2", "stage4"]}
        heads = {"decoder_self_attention_heads": 2, "decoder_cross_attention_heads": 2}
        config = transformers.RfDetrConfig(
            **{**shared, **heads, "backbone_config": dinov2, "c2f_num_blocks": 1}
        )
    model = randomised(transformers.AutoModelForObjectDetection.from_config(config).eval())
    for name, part in model.named_modules():
        if "class" in name and getattr(part, "out_features", 0) in (len(names), len(names) + 1):
            with torch.no_grad():  # no training ever asked for it
                part.weight[0], part.bias[0] = 0.0, -20.0
    model.save_pretrained(folder)
    edges = {"shortest_edge": 64, "longest_edge": 100}
    size = {"height": 64, "width": 64} if family == "rf_detr" else edges
    preprocessing = {"size": size, "do_normalize": True, **IMAGENET}
    if family == "detr":  # as older versions of transformers saved it
        preprocessing |= {"size": 64, "max_size": 100}
    (folder / "preprocessor_config.json").write_text(json.dumps(preprocessing))
    return model
