"""Names of RT-DETR's parameters in published checkpoints and in `transformers`.

A rule is a pair of patterns. `{i}`, `{j}`, … stand for numbers and `{p}` for the rest of the name.
A rule translates in both directions.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

# Published pattern, pattern of the public transformers checkpoints; the first match is used.
RULES: tuple[tuple[str, str], ...] = (
    # Backbone
    (
        "backbone.conv1.conv1_1.conv.{p}",
        "model.backbone.model.embedder.embedder.0.convolution.{p}",
    ),
    (
        "backbone.conv1.conv1_1.norm.{p}",
        "model.backbone.model.embedder.embedder.0.normalization.{p}",
    ),
    (
        "backbone.conv1.conv1_2.conv.{p}",
        "model.backbone.model.embedder.embedder.1.convolution.{p}",
    ),
    (
        "backbone.conv1.conv1_2.norm.{p}",
        "model.backbone.model.embedder.embedder.1.normalization.{p}",
    ),
    (
        "backbone.conv1.conv1_3.conv.{p}",
        "model.backbone.model.embedder.embedder.2.convolution.{p}",
    ),
    (
        "backbone.conv1.conv1_3.norm.{p}",
        "model.backbone.model.embedder.embedder.2.normalization.{p}",
    ),
    (
        "backbone.res_layers.{i}.blocks.{j}.short.conv.conv.{p}",
        "model.backbone.model.encoder.stages.{i}.layers.{j}.shortcut.1.convolution.{p}",
    ),
    (
        "backbone.res_layers.{i}.blocks.{j}.short.conv.norm.{p}",
        "model.backbone.model.encoder.stages.{i}.layers.{j}.shortcut.1.normalization.{p}",
    ),
    (
        "backbone.res_layers.{i}.blocks.{j}.short.conv.{p}",
        "model.backbone.model.encoder.stages.{i}.layers.{j}.shortcut.convolution.{p}",
    ),
    (
        "backbone.res_layers.{i}.blocks.{j}.short.norm.{p}",
        "model.backbone.model.encoder.stages.{i}.layers.{j}.shortcut.normalization.{p}",
    ),
    *(
        (
            f"backbone.res_layers.{{i}}.blocks.{{j}}.branch2{branch}.{part}.{{p}}",
            f"model.backbone.model.encoder.stages.{{i}}.layers.{{j}}.layer.{index}.{full}.{{p}}",
        )
        for index, branch in enumerate("abc")
        for part, full in (("conv", "convolution"), ("norm", "normalization"))
    ),
    # Encoder
    ("encoder.input_proj.{i}.conv.{p}", "model.encoder_input_proj.{i}.0.{p}"),
    ("encoder.input_proj.{i}.norm.{p}", "model.encoder_input_proj.{i}.1.{p}"),
    (
        "encoder.encoder.{i}.layers.{j}.norm1.{p}",
        "model.encoder.encoder.{i}.layers.{j}.self_attn_layer_norm.{p}",
    ),
    (
        "encoder.encoder.{i}.layers.{j}.norm2.{p}",
        "model.encoder.encoder.{i}.layers.{j}.final_layer_norm.{p}",
    ),
    (
        "encoder.encoder.{i}.layers.{j}.linear1.{p}",
        "model.encoder.encoder.{i}.layers.{j}.fc1.{p}",
    ),
    (
        "encoder.encoder.{i}.layers.{j}.linear2.{p}",
        "model.encoder.encoder.{i}.layers.{j}.fc2.{p}",
    ),
    ("encoder.{p}", "model.encoder.{p}"),
    # Decoder
    (
        "decoder.decoder.layers.{i}.cross_attn.num_points_scale",
        "model.decoder.layers.{i}.encoder_attn.n_points_scale",
    ),
    ("decoder.decoder.layers.{i}.cross_attn.{p}", "model.decoder.layers.{i}.encoder_attn.{p}"),
    ("decoder.decoder.layers.{i}.norm1.{p}", "model.decoder.layers.{i}.self_attn_layer_norm.{p}"),
    (
        "decoder.decoder.layers.{i}.norm2.{p}",
        "model.decoder.layers.{i}.encoder_attn_layer_norm.{p}",
    ),
    ("decoder.decoder.layers.{i}.norm3.{p}", "model.decoder.layers.{i}.final_layer_norm.{p}"),
    ("decoder.decoder.layers.{i}.linear1.{p}", "model.decoder.layers.{i}.fc1.{p}"),
    ("decoder.decoder.layers.{i}.linear2.{p}", "model.decoder.layers.{i}.fc2.{p}"),
    ("decoder.decoder.{p}", "model.decoder.{p}"),
    ("decoder.input_proj.{i}.conv.{p}", "model.decoder_input_proj.{i}.0.{p}"),
    ("decoder.input_proj.{i}.norm.{p}", "model.decoder_input_proj.{i}.1.{p}"),
    ("decoder.enc_output.proj.{p}", "model.enc_output.0.{p}"),
    ("decoder.enc_output.norm.{p}", "model.enc_output.1.{p}"),
    ("decoder.enc_score_head.{p}", "model.enc_score_head.{p}"),
    ("decoder.enc_bbox_head.{p}", "model.enc_bbox_head.{p}"),
    ("decoder.dec_score_head.{p}", "model.decoder.class_embed.{p}"),
    ("decoder.dec_bbox_head.{p}", "model.decoder.bbox_embed.{p}"),
    ("decoder.query_pos_head.{p}", "model.decoder.query_pos_head.{p}"),
    ("decoder.denoising_class_embed.{p}", "model.denoising_class_embed.{p}"),
    ("decoder.tgt_embed.{p}", "model.weight_embedding.{p}"),
)
# Older sources number these layers; newer sources name them.
SPELLINGS = (
    (re.compile(r"^((?:en|de)coder\.input_proj\.\d+)\.0\."), r"\1.conv."),
    (re.compile(r"^((?:en|de)coder\.input_proj\.\d+)\.1\."), r"\1.norm."),
    (re.compile(r"^(decoder\.enc_output)\.0\."), r"\1.proj."),
    (re.compile(r"^(decoder\.enc_output)\.1\."), r"\1.norm."),
)
# Names in later versions of transformers, and the names used above.
LATER_NAMES = (
    (re.compile(r"\.self_attn\.o_proj\."), ".self_attn.out_proj."),
    (re.compile(r"\.mlp\.(fc[12])\."), r".\1."),
    (re.compile(r"^model\.encoder\.aifi\."), "model.encoder.encoder."),
    # RT-DETRv2 lists the heads of its decoder a second time.
    (re.compile(r"^(class_embed|bbox_embed)\."), r"model.decoder.\1."),
)
# Computed from the sizes, not loaded.
DERIVED = ("decoder.anchors", "decoder.valid_mask")


def canonical_name(published: str) -> str:
    """The newest published name of a parameter."""
    for pattern, replacement in SPELLINGS:
        published = pattern.sub(replacement, published)
    return published


def public_name(published: str) -> str | None:
    """The name of a published parameter in public checkpoints; None = unknown."""
    return _translate(published, _FORWARD)


def published_name(module_name: str) -> str | None:
    """The published name of a parameter of the `transformers` model; None = it has none."""
    return _translate(earlier_name(module_name), _BACKWARD)


def earlier_name(module_name: str) -> str:
    """The name in public checkpoints of a parameter of the `transformers` model."""
    for pattern, replacement in LATER_NAMES:
        module_name = pattern.sub(replacement, module_name)
    return module_name


def _translate(name: str, rules: Iterable[tuple[re.Pattern[str], str]]) -> str | None:
    for pattern, target in rules:
        found = pattern.fullmatch(name)
        if found:
            return target.format(**found.groupdict())
    return None


def _compiled(source: str, target: str) -> tuple[re.Pattern[str], str]:
    pattern = re.escape(source).replace(r"\{p\}", r"(?P<p>.+)")
    return re.compile(re.sub(r"\\{(\w)\\}", r"(?P<\1>\\d+)", pattern)), target


_FORWARD = [_compiled(published, public) for published, public in RULES]
# Backwards, the general rules also match the decoder's heads: they come last.
_BACKWARD = sorted(
    (_compiled(public, published) for published, public in RULES),
    key=lambda rule: rule[1] in ("encoder.{p}", "decoder.decoder.{p}"),
)
