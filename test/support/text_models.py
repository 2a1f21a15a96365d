"""Small checkpoints of detectors of free text: real architectures, file formats and tokenizers."""

import json

from support.torch_models import IMAGENET, randomised, save_sam3, torch, transformers
from tokenizers import Tokenizer, models, pre_tokenizers, processors

WORDS = ("mug", "red mug", "drill", "sofa")
SIDE = 64
TEXT = {"vocab_size": 1030, "bos_token_id": 101, "eos_token_id": 102, "pad_token_id": 0}
_LETTERS = ("a", "photo", "of", "detect", "mug", "red", "drill", "sofa", "chair", "table", ",")


def save_tokenizer(folder, length):
    """A tokenizer of words, with the ids of BERT's and CLIP's special tokens."""
    names = {0: "[PAD]", 100: "[UNK]", 101: "[CLS]", 102: "[SEP]", 1012: ".", 1029: "?"}
    names |= {200 + index: word for index, word in enumerate(_LETTERS)}
    vocabulary = {names.get(index, f"[unused{index}]"): index for index in range(1030)}
    tokenizer = Tokenizer(models.WordLevel(vocabulary, unk_token="[UNK]"))
    tokenizer.pre_tokenizer = pre_tokenizers.BertPreTokenizer()
    tokenizer.post_processor = processors.TemplateProcessing(
        single="[CLS] $A [SEP]", special_tokens=[("[CLS]", 101), ("[SEP]", 102)]
    )
    special = {"pad_token": "[PAD]", "unk_token": "[UNK]"}
    special |= {"cls_token": "[CLS]", "sep_token": "[SEP]"}
    transformers.PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, model_max_length=length, **special
    ).save_pretrained(folder)


def clip_text(**changes):
    small = {"hidden_size": 32, "intermediate_size": 32, "num_attention_heads": 2}
    sizes = {"num_hidden_layers": 1, "projection_dim": 32}
    return {**small, **sizes, **TEXT, **changes}


def swin(**changes):
    return transformers.SwinConfig(
        **{"image_size": SIDE, "patch_size": 4, "embed_dim": 8, "depths": [1, 1, 1, 1]},
        **{"num_heads": [1, 1, 2, 2], "window_size": 4},
        **{"out_features": ["stage2", "stage3", "stage4"], **changes},
    )


def owlv2_config():
    vision = {"hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 1}
    vision |= {"num_attention_heads": 2, "image_size": SIDE, "patch_size": 16}
    text = clip_text(max_position_embeddings=16)
    return transformers.Owlv2Config(text_config=text, vision_config=vision, projection_dim=32)


def grounding_dino_config():
    layers = {"encoder_layers": 1, "decoder_layers": 2, "encoder_ffn_dim": 32}
    layers |= {"decoder_ffn_dim": 32, "encoder_attention_heads": 2, "decoder_attention_heads": 2}
    bert = {"hidden_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    bert |= {"model_type": "bert", "intermediate_size": 32, "vocab_size": 1030}
    return transformers.GroundingDinoConfig(
        **{"backbone_config": swin(), "text_config": bert, "d_model": 32, "num_queries": 12},
        **{"max_text_len": 24, **layers},
    )


def omdet_config():
    width = 16
    hidden = {"encoder_hidden_dim": width, "decoder_hidden_dim": width}
    hidden |= {"class_embed_dim": 32, "task_encoder_hidden_dim": width}
    hidden |= {"vision_features_channels": [width] * 3, "text_projection_in_dim": 32}
    hidden |= {"text_projection_out_dim": 32, "encoder_dim_feedforward": width}
    hidden |= {"encoder_in_channels": [16, 32, 64], "backbone_feat_channels": [16, 32, 64]}
    return transformers.OmDetTurboConfig(
        text_config={"model_type": "clip_text_model", **clip_text()},
        **{
            "backbone_config": swin(),
            "use_timm_backbone": False,
            "image_size": SIDE,
            "apply_layernorm_after_vision_backbone": False,
        },
        **{"num_queries": 12, "decoder_num_layers": 2, "num_projection_layers": 1, **hidden},
        **{"encoder_attention_heads": 2, "decoder_num_heads": 2, "decoder_dim_feedforward": 32},
    )


def save_text_network(folder, family):
    """A small detector of free text, saved as on the model hub."""
    torch.manual_seed(0)
    if family == "sam3":
        save_sam3(folder, video=True, text=TEXT)
        size, length = {"height": 112, "width": 112}, 32
    else:
        configs = {"owlv2": owlv2_config, "grounding_dino": grounding_dino_config}
        config = {**configs, "omdet_turbo": omdet_config}[family]()
        made = transformers.AutoModelForZeroShotObjectDetection.from_config(config).eval()
        randomised(made).save_pretrained(folder)
        size, length = {"height": SIDE, "width": SIDE}, 16 if family == "owlv2" else 77
    if family == "grounding_dino":
        size = {"shortest_edge": SIDE, "longest_edge": 100}
    kind = "Owlv2ImageProcessor" if family == "owlv2" else "DetrImageProcessor"
    processor = {"size": size, "do_normalize": True, "image_processor_type": kind, **IMAGENET}
    (folder / "preprocessor_config.json").write_text(json.dumps(processor))
    save_tokenizer(folder, length)
    return folder
