"""Import of a published FROSS checkpoint: RT-DETR with EGTR, saved by Lightning."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import torch
from safetensors import SafetensorError
from safetensors.torch import save
from transformers import (
    AutoModelForObjectDetection,
    RTDetrConfig,
    RTDetrResNetConfig,
    RTDetrV2Config,
)

from deworldsg_ros.base.files import together, write_atomically
from deworldsg_ros.checkpoints.cards import (
    DETECTOR_CARD,
    IMAGENET_MEAN,
    IMAGENET_STD,
    CheckpointCard,
    write_detector_card,
)
from deworldsg_ros.checkpoints.egtr_network import EgtrNetwork
from deworldsg_ros.checkpoints.loading import HEAD_FILE, check_names, read_tensors
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.vocabulary import (
    REPLICA_SSG_PREDICATES,
    SCANNET_CLASSES,
    SCANNET_PREDICATES,
    VISUAL_GENOME_CLASSES,
)

# --- Names of RT-DETR's parameters in published checkpoints and in `transformers`.
#
# A rule is a pair of patterns. `{i}`, `{j}`, … stand for numbers and `{p}` for the rest of the
# name. A rule translates in both directions.

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


# --- Import of a published FROSS checkpoint: RT-DETR with EGTR, saved by Lightning.

DETECTOR_PREFIX = "model.obj_det_model."
HEAD_PREFIX = "model.egtr_head."
# Edge of the square input image of FROSS, pixels.
INPUT_SIZE_PX = 640
# FROSS's defaults for settings that its config.json does not contain: attention heads, queries.
HEADS = 8
QUERIES = 300
# Index of the last decoder layer that FROSS runs, of six.
EVALUATED_LAYER = 2
VOCABULARIES = (
    (VISUAL_GENOME_CLASSES, REPLICA_SSG_PREDICATES),
    (SCANNET_CLASSES, SCANNET_PREDICATES),
)

Tensors = Mapping[str, torch.Tensor]


class Names(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Names of the outputs, in order."""

    classes: tuple[str, ...]
    predicates: tuple[str, ...]


@dataclass(frozen=True)
class Imported:
    """Result of an import.

    Attributes:
        architecture: ``rt_detr`` or ``rt_detr_v2``.
        parameters: number of values in detector and head.
        card: the card in the new folder.
        layers: number of decoder layers.
        unknown_bias: the checkpoint has class-pair statistics, and neither the caller nor a
            config.json says whether they were used. They are then off.
    """

    architecture: str
    parameters: int
    card: CheckpointCard
    layers: int
    unknown_bias: bool = False


def import_checkpoint(
    checkpoint: Path,
    out: Path,
    *,
    names: Names | None = None,
    frequency_bias: bool | None = None,
) -> Imported:
    """Convert a checkpoint to a folder with detector, relation head, names and preprocessing.

    Args:
        checkpoint: the .ckpt file, or the folder that contains ``checkpoints/epoch=….ckpt``.
            Settings that the weights do not determine come from a config.json beside the file or
            one folder above.
        out: folder to write; it must not contain a checkpoint.
        names: of classes and predicates; None = those of Visual Genome or 3DSSG, by their numbers.
        frequency_bias: whether the class-pair statistics are added; None = the value in
            config.json, false without one.

    Raises:
        ConfigurationError: not such a checkpoint, with the missing or unknown parameters.
    """
    path = _checkpoint_file(checkpoint)
    detector, head = split(read_tensors(path, "state_dict"), str(path))
    settings = _settings_beside(path)
    config = infer_config(detector, settings, str(path))
    model = AutoModelForObjectDetection.from_config(config)
    _fill(model, detector, str(path))
    network = EgtrNetwork.for_parameters(head, f"{path} ({HEAD_PREFIX}…)")
    if network.final_sub_proj.in_features != config.d_model:
        raise ConfigurationError(
            f"{path}: the relation head has {network.final_sub_proj.in_features} input features "
            f"and the detector {config.d_model}: expected equal numbers"
        )
    names = names or _known_names(config.num_labels, network.predicates, str(path))
    _check_counts(names, config.num_labels, network.predicates, str(path))
    evaluated = int(settings.get("rt_detr_transformer_eval_idx", EVALUATED_LAYER))
    layers = evaluated % config.decoder_layers + 1 if evaluated < config.decoder_layers else 0
    unknown_bias = (
        frequency_bias is None and "use_freq_bias" not in settings and "triplet_dist" in head
    )
    if frequency_bias is None:
        frequency_bias = bool(settings.get("use_freq_bias", False))
    card = CheckpointCard(
        class_scores="softmax",
        score_threshold=0.7,
        decoder_layers=layers,
        classes=names.classes,
        predicates=names.predicates,
        frequency_bias=frequency_bias,
    )
    model.config.id2label = dict(enumerate(names.classes))
    model.config.label2id = {name: index for index, name in enumerate(names.classes)}
    _write(out, model, network, card)
    values = [*model.state_dict().values(), *network.state_dict().values()]
    count = sum(value.numel() for value in values)
    return Imported(config.model_type, count, card, config.decoder_layers, unknown_bias)


def split(state: Tensors, where: str) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """Parameters of detector and relation head, without prefixes; raises ConfigurationError."""
    detector: dict[str, torch.Tensor] = {}
    head: dict[str, torch.Tensor] = {}
    unknown = []
    for name, value in state.items():
        if name.startswith(DETECTOR_PREFIX):
            detector[canonical_name(name[len(DETECTOR_PREFIX) :])] = value
        elif name.startswith(HEAD_PREFIX):
            head[name[len(HEAD_PREFIX) :]] = value
        else:
            unknown.append(name)
    if unknown or not detector or not head:
        example = f", found {sorted(unknown)[0]}" if unknown else ""
        raise ConfigurationError(
            f"{where} is not a checkpoint of RT-DETR with EGTR: expected only parameters named "
            f"{DETECTOR_PREFIX}… and {HEAD_PREFIX}…{example} (EGTR's own checkpoints are of "
            "another detector, Deformable DETR)"
        )
    return detector, head


@dataclass(frozen=True)
class _Shapes:
    """Sizes of a network, read from the shapes and names of its parameters."""

    parameters: Tensors
    where: str

    def shape(self, name: str) -> torch.Size:
        """The shape of a parameter; raises ConfigurationError if it is missing."""
        if name not in self.parameters:
            raise ConfigurationError(
                f"{self.where} lacks {DETECTOR_PREFIX}{name}: expected an RT-DETR"
            )
        return self.parameters[name].shape

    def count(self, pattern: str) -> int:
        """One more than the greatest number that a pattern finds in the names; 0 if none."""
        found = [re.match(pattern, name) for name in self.parameters]
        return 1 + max((int(match[1]) for match in found if match), default=-1)


def infer_config(detector: Tensors, settings: Mapping[str, Any], where: str) -> Any:
    """The configuration of the detector with these published parameters.

    Args:
        detector: parameters by canonical name.
        settings: FROSS's config.json; may be empty.
        where: origin of the parameters, for messages.

    Raises:
        ConfigurationError: a parameter that determines a size is missing.
    """
    shapes = _Shapes(detector, where)
    shape, count = shapes.shape, shapes.count
    backbone = _backbone_config(shapes)
    levels = count(r"decoder\.input_proj\.(\d+)\.")
    projections = range(count(r"encoder\.input_proj\.(\d+)\."))
    hidden = shape("encoder.input_proj.0.conv.weight")[0]
    attention = "decoder.decoder.layers.0.cross_attn."
    sizes: dict[str, Any] = {
        "encoder_hidden_dim": hidden,
        "encoder_in_channels": [
            shape(f"encoder.input_proj.{level}.conv.weight")[1] for level in projections
        ],
        "encoder_layers": count(r"encoder\.encoder\.0\.layers\.(\d+)\."),
        "encoder_ffn_dim": shape("encoder.encoder.0.layers.0.linear1.weight")[0],
        "encoder_attention_heads": int(settings.get("hybrid_encoder_nhead", HEADS)),
        "hidden_expansion": shape("encoder.fpn_blocks.0.conv1.conv.weight")[0] / hidden,
        "d_model": shape("decoder.input_proj.0.conv.weight")[0],
        "decoder_in_channels": [
            shape(f"decoder.input_proj.{level}.conv.weight")[1] for level in range(levels)
        ],
        "num_feature_levels": levels,
        "decoder_layers": count(r"decoder\.decoder\.layers\.(\d+)\."),
        "decoder_ffn_dim": shape("decoder.decoder.layers.0.linear1.weight")[0],
        "decoder_attention_heads": HEADS,
        "decoder_n_points": shape(f"{attention}attention_weights.weight")[0]
        // (HEADS * max(levels, 1)),
        "num_queries": int(settings.get("num_queries", QUERIES)),
        "num_denoising": 100 if "decoder.denoising_class_embed.weight" in detector else 0,
        "learn_initial_query": "decoder.tgt_embed.weight" in detector,
        "num_labels": shape("decoder.dec_score_head.0.weight")[0],
    }
    if f"{attention}num_points_scale" in detector:
        return RTDetrV2Config(backbone_config=backbone, decoder_n_levels=levels, **sizes)
    return RTDetrConfig(backbone_config=backbone, **sizes)


def _backbone_config(shapes: _Shapes) -> Any:
    bottleneck = "backbone.res_layers.0.blocks.0.branch2c.conv.weight" in shapes.parameters
    last_branch = "c" if bottleneck else "b"
    stages = range(shapes.count(r"backbone\.res_layers\.(\d+)\."))
    make_config: Any = RTDetrResNetConfig
    return make_config(
        embedding_size=shapes.shape("backbone.conv1.conv1_3.conv.weight")[0],
        hidden_sizes=[
            shapes.shape(f"backbone.res_layers.{stage}.blocks.0.branch2{last_branch}.conv.weight")[
                0
            ]
            for stage in stages
        ],
        depths=[
            shapes.count(rf"backbone\.res_layers\.{stage}\.blocks\.(\d+)\.") for stage in stages
        ],
        layer_type="bottleneck" if bottleneck else "basic",
        out_features=[f"stage{stage + 1}" for stage in stages][-3:],
    )


def _fill(model: Any, detector: Tensors, where: str) -> None:
    """Copy published parameters into the model; every name must have its counterpart."""
    published_names = {name: published_name(name) for name in model.state_dict()}
    expected: dict[str, None] = {}
    found: dict[str, torch.Tensor] = {}
    for published in published_names.values():
        if published is not None and not _is_counter(published):
            expected[_packed(published)] = None
    for name, value in detector.items():
        if not _is_counter(name) and name not in DERIVED:
            found[name] = value
    check_names(found, expected, f"{where} ({DETECTOR_PREFIX}…)")
    public = {}
    for name, value in found.items():
        for unpacked, part in _unpacked(name, value).items():
            public[public_name(unpacked)] = part
    state = model.state_dict()
    filled = {name: public.get(earlier_name(name), state[name]) for name in state}
    try:
        model.load_state_dict(filled)
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise ConfigurationError(f"{where} is not a consistent RT-DETR: {reason}") from error


def _is_counter(name: str) -> bool:
    """Whether a parameter only counts training batches; checkpoints may lack these."""
    return name.endswith("num_batches_tracked")


def _packed(name: str) -> str:
    """The name in torch's attention, which stores the rows of q, k and v in one parameter."""
    return re.sub(r"\.self_attn\.[qkv]_proj\.(weight|bias)\Z", r".self_attn.in_proj_\1", name)


def _unpacked(name: str, value: torch.Tensor) -> dict[str, torch.Tensor]:
    packed = re.fullmatch(r"(.*\.self_attn)\.in_proj_(weight|bias)", name)
    if packed is None:
        return {name: value}
    return {
        f"{packed[1]}.{part}_proj.{packed[2]}": rows for part, rows in zip("qkv", value.chunk(3))
    }


def _known_names(classes: int, predicates: int, where: str) -> Names:
    for known_classes, known_predicates in VOCABULARIES:
        if (classes, predicates) == (len(known_classes), len(known_predicates)):
            return Names(known_classes, known_predicates)
    raise ConfigurationError(
        f"{where} has {classes} classes and {predicates} predicates, neither Visual Genome's 150 "
        "and 50 nor 3DSSG's 20 and 7: name them in a JSON file and give it with --names"
    )


def _check_counts(names: Names, classes: int, predicates: int, where: str) -> None:
    found = len(names.classes), len(names.predicates)
    if found != (classes, predicates):
        raise ConfigurationError(
            f"{where} has {classes} classes and {predicates} predicates, and {found[0]} and "
            f"{found[1]} are named: give a name for each"
        )


def _checkpoint_file(path: Path) -> Path:
    if path.is_file():
        return path
    # The last epoch, the choice of FROSS itself.
    found = sorted(
        path.glob("checkpoints/epoch=*.ckpt"),
        key=lambda file: int(re.findall(r"epoch=(\d+)", file.name)[0]),
    )
    if not found:
        raise ConfigurationError(
            f"checkpoint {path}: expected a .ckpt file, or a folder with checkpoints/epoch=….ckpt"
        )
    return found[-1]


def _settings_beside(path: Path) -> Mapping[str, Any]:
    for folder in (path.parent, path.parent.parent):
        file = folder / "config.json"
        if file.is_file():
            try:
                settings: Mapping[str, Any] = json.loads(file.read_text(encoding="utf-8"))
            except (OSError, ValueError) as error:
                raise ConfigurationError(f"{file}: {error}; expected FROSS's settings") from error
            return settings
    return {}


def _write(out: Path, model: Any, network: EgtrNetwork, card: CheckpointCard) -> None:
    if (out / "config.json").exists():
        raise ConfigurationError(
            f"{out} contains a checkpoint already: give an empty or new folder"
        )
    preprocessing = {
        "image_processor_type": "RTDetrImageProcessor",
        "size": {"height": INPUT_SIZE_PX, "width": INPUT_SIZE_PX},
        "do_resize": True,
        "do_rescale": True,
        "do_normalize": True,
        "image_mean": list(IMAGENET_MEAN),
        "image_std": list(IMAGENET_STD),
    }
    try:
        with together(out, ()) as staged:
            model.save_pretrained(staged)
            state = {k: v.contiguous() for k, v in network.state_dict().items()}
            write_atomically(staged / HEAD_FILE, save(state))
            text = json.dumps(preprocessing, indent=2) + "\n"
            write_atomically(staged / "preprocessor_config.json", text)
            write_detector_card(staged / DETECTOR_CARD, card)
    except (OSError, SafetensorError) as error:
        raise ConfigurationError(f"cannot write {out}: {error}") from error
