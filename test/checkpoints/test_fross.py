"""`deworldsg models import-fross`: every parameter of the published layout finds its place."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.torch_models import (
    PREDICATES,
    WIDTH,
    image,
    segmented,
    settings,
    torch,
    transformers,
)
from typer.testing import CliRunner

from deworldsg_ros.checkpoints.cards import read_detector_card
from deworldsg_ros.checkpoints.fross import Names, import_checkpoint, infer_config, split
from deworldsg_ros.cli.models import app
from deworldsg_ros.perception.backends.rtdetr import EgtrRelationHead, RtDetrDetector
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.vocabulary import SCANNET_CLASSES, SCANNET_PREDICATES

pytestmark = pytest.mark.models

DETECTOR = "model.obj_det_model."
HEAD = "model.egtr_head."
LAYERS = 4
HIDDEN = (16, 24, 32, 40)
DEPTHS = (1, 1, 2, 1)


def published_layout(second=True, classes=20, predicates=7, bottleneck=True):
    """Name and shape of every parameter of a published checkpoint, written out from its source."""
    shapes = {}

    def norm(name, width, counter=False):
        for part in ("weight", "bias", "running_mean", "running_var"):
            shapes[f"{name}.{part}"] = (width,)
        if counter:
            shapes[f"{name}.num_batches_tracked"] = ()

    def conv(name, out, into, size, counter=False, parts=("conv", "norm")):
        shapes[f"{name}.{parts[0]}.weight"] = (out, into, size, size)
        norm(f"{name}.{parts[1]}", out, counter)

    def linear(name, out, into):
        shapes[f"{name}.weight"], shapes[f"{name}.bias"] = (out, into), (out,)

    def layer_norm(name, width=WIDTH):
        shapes[f"{name}.weight"] = shapes[f"{name}.bias"] = (width,)

    def attention(name):
        shapes[f"{name}.in_proj_weight"] = (3 * WIDTH, WIDTH)
        shapes[f"{name}.in_proj_bias"] = (3 * WIDTH,)
        linear(f"{name}.out_proj", WIDTH, WIDTH)

    def perceptron(name, *widths):
        for index, (into, out) in enumerate(zip(widths, widths[1:])):
            linear(f"{name}.layers.{index}", out, into)

    d = DETECTOR
    for index, (into, out) in enumerate([(3, 4), (4, 4), (4, 8)], start=1):
        conv(f"{d}backbone.conv1.conv1_{index}", out, into, 3)
    before = 8
    # ResNet-18 and 34 begin with as many channels as the stem ends with.
    hidden = HIDDEN if bottleneck else (8, *HIDDEN[1:])
    for stage, (width, depth) in enumerate(zip(hidden, DEPTHS)):
        for block in range(depth):
            name = f"{d}backbone.res_layers.{stage}.blocks.{block}"
            into = before if block == 0 else width
            if bottleneck:
                conv(f"{name}.branch2a", width // 4, into, 1)
                conv(f"{name}.branch2b", width // 4, width // 4, 3)
                conv(f"{name}.branch2c", width, width // 4, 1)
            else:
                conv(f"{name}.branch2a", width, into, 3)
                conv(f"{name}.branch2b", width, width, 3)
            if block == 0:
                # The first stage keeps the resolution; the others pool, and then project.
                conv(f"{name}.short" if stage == 0 else f"{name}.short.conv", width, into, 1)
        before = width
    for level, into in enumerate(HIDDEN[1:]):
        parts = ("conv", "norm") if second else ("0", "1")
        conv(f"{d}encoder.input_proj.{level}", WIDTH, into, 1, True, parts)
    layer = f"{d}encoder.encoder.0.layers.0"
    attention(f"{layer}.self_attn")
    linear(f"{layer}.linear1", 48, WIDTH)
    linear(f"{layer}.linear2", WIDTH, 48)
    layer_norm(f"{layer}.norm1")
    layer_norm(f"{layer}.norm2")
    half = WIDTH // 2
    for index in range(2):
        conv(f"{d}encoder.lateral_convs.{index}", WIDTH, WIDTH, 1, True)
        conv(f"{d}encoder.downsample_convs.{index}", WIDTH, WIDTH, 3, True)
        for blocks in ("fpn_blocks", "pan_blocks"):
            name = f"{d}encoder.{blocks}.{index}"
            conv(f"{name}.conv1", half, 2 * WIDTH, 1, True)
            conv(f"{name}.conv2", half, 2 * WIDTH, 1, True)
            conv(f"{name}.conv3", WIDTH, half, 1, True)
            for block in range(3):
                conv(f"{name}.bottlenecks.{block}.conv1", half, half, 3, True)
                conv(f"{name}.bottlenecks.{block}.conv2", half, half, 1, True)
    for level in range(3):
        conv(f"{d}decoder.input_proj.{level}", WIDTH, WIDTH, 1, True)
    for index in range(LAYERS):
        name = f"{d}decoder.decoder.layers.{index}"
        attention(f"{name}.self_attn")
        for norm_index in (1, 2, 3):
            layer_norm(f"{name}.norm{norm_index}")
        linear(f"{name}.linear1", 40, WIDTH)
        linear(f"{name}.linear2", WIDTH, 40)
        if second:
            shapes[f"{name}.cross_attn.num_points_scale"] = (12,)
        linear(f"{name}.cross_attn.sampling_offsets", 8 * 12 * 2, WIDTH)
        linear(f"{name}.cross_attn.attention_weights", 8 * 12, WIDTH)
        linear(f"{name}.cross_attn.value_proj", WIDTH, WIDTH)
        linear(f"{name}.cross_attn.output_proj", WIDTH, WIDTH)
        linear(f"{d}decoder.dec_score_head.{index}", classes, WIDTH)
        perceptron(f"{d}decoder.dec_bbox_head.{index}", WIDTH, WIDTH, WIDTH, 4)
    shapes[f"{d}decoder.denoising_class_embed.weight"] = (classes + 1, WIDTH)
    perceptron(f"{d}decoder.query_pos_head", 4, 2 * WIDTH, WIDTH)
    linear(f"{d}decoder.enc_output.proj", WIDTH, WIDTH)
    layer_norm(f"{d}decoder.enc_output.norm")
    linear(f"{d}decoder.enc_score_head", classes, WIDTH)
    perceptron(f"{d}decoder.enc_bbox_head", WIDTH, WIDTH, WIDTH, 4)
    if second:
        shapes[f"{d}decoder.anchors"] = (1, 8400, 4)
        shapes[f"{d}decoder.valid_mask"] = (1, 8400, 1)
    shapes[f"{HEAD}triplet_dist"] = (classes + 1, classes + 1, predicates)
    shapes[f"{HEAD}rel_dist"] = (predicates,)
    for index in range(LAYERS):
        linear(f"{HEAD}proj_q.{index}", WIDTH, WIDTH)
        linear(f"{HEAD}proj_k.{index}", WIDTH, WIDTH)
    linear(f"{HEAD}final_sub_proj", WIDTH, WIDTH)
    linear(f"{HEAD}final_obj_proj", WIDTH, WIDTH)
    linear(f"{HEAD}rel_predictor_gate", 1, 2 * WIDTH)
    perceptron(f"{HEAD}rel_predictor", 2 * WIDTH, WIDTH, WIDTH, predicates)
    perceptron(f"{HEAD}connectivity_layer", 2 * WIDTH, WIDTH, WIDTH, 1)
    return shapes


def published_state(seed=0, **layout):
    generator = torch.Generator().manual_seed(seed)
    state = {}
    for name, shape in published_layout(**layout).items():
        if name.endswith("num_batches_tracked"):
            state[name] = torch.tensor(7)
        elif name.endswith("num_points_scale"):
            state[name] = torch.full(shape, 0.25)
        elif name.endswith("running_var"):
            state[name] = torch.rand(shape, generator=generator) + 0.5
        else:
            scale = 1.2 / max(1, int(np.prod(shape[1:]))) ** 0.5
            state[name] = torch.randn(shape, generator=generator) * scale
    return state


def save_published(folder, state, config=None):
    path = folder / "version_0" / "checkpoints" / "epoch=07-validation_loss=1.00.ckpt"
    path.parent.mkdir(parents=True)
    torch.save({"state_dict": state, "epoch": 7, "global_step": 100}, path)
    if config is not None:
        (folder / "version_0" / "config.json").write_text(json.dumps(config))
    return path


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    root = tmp_path_factory.mktemp("published")
    state = published_state()
    config = {"use_freq_bias": True, "num_queries": 25, "rt_detr_transformer_eval_idx": 2}
    path = save_published(root, state, config)
    result = CliRunner().invoke(app, ["import-fross", str(path), str(root / "out")])
    assert result.exit_code == 0, result.output
    return state, root / "out", result.output


def test_the_folder_loads_by_name(imported):
    state, out, message = imported
    model, report = transformers.RTDetrV2ForObjectDetection.from_pretrained(
        out, output_loading_info=True
    )
    assert not report["missing_keys"] and not report["unexpected_keys"]
    assert not report["mismatched_keys"]
    assert "rt_detr_v2" in message and "3 of 4 decoder layers" in message
    assert "20 classes, 7 predicates" in message and "statistics on" in message
    assert model.config.num_queries == 25
    assert model.config.id2label[4] == SCANNET_CLASSES[4]


def test_parameters_are_where_they_belong(imported):
    state, out, _ = imported
    model = transformers.RTDetrV2ForObjectDetection.from_pretrained(out)
    decoder, attention = model.model.decoder, f"{DETECTOR}decoder.decoder.layers.2.self_attn."
    rows = state[f"{attention}in_proj_weight"].split(WIDTH)
    biases = state[f"{attention}in_proj_bias"].split(WIDTH)
    layer = decoder.layers[2]
    for part, weight, bias in zip("qkv", rows, biases):
        found = getattr(layer.self_attn, f"{part}_proj")
        assert torch.equal(found.weight, weight) and torch.equal(found.bias, bias)
    encoder = f"{DETECTOR}encoder.encoder.0.layers.0."
    aifi = next(m for n, m in model.named_modules() if n.endswith("aifi.0.layers.0"))
    spots = {
        f"{attention}out_proj.weight": layer.self_attn.o_proj.weight,
        f"{DETECTOR}decoder.decoder.layers.2.norm1.bias": layer.self_attn_layer_norm.bias,
        f"{DETECTOR}decoder.decoder.layers.2.norm2.bias": layer.encoder_attn_layer_norm.bias,
        f"{DETECTOR}decoder.decoder.layers.2.norm3.bias": layer.final_layer_norm.bias,
        f"{DETECTOR}decoder.decoder.layers.2.linear2.bias": layer.mlp.fc2.bias,
        f"{DETECTOR}decoder.dec_score_head.1.weight": decoder.class_embed[1].weight,
        f"{DETECTOR}decoder.dec_bbox_head.3.layers.2.bias": decoder.bbox_embed[3].layers[2].bias,
        f"{DETECTOR}decoder.enc_output.norm.weight": model.model.enc_output[1].weight,
        f"{DETECTOR}decoder.input_proj.1.norm.running_mean": (
            model.model.decoder_input_proj[1][1].running_mean
        ),
        f"{DETECTOR}encoder.input_proj.2.conv.weight": model.model.encoder_input_proj[2][0].weight,
        f"{encoder}norm2.weight": aifi.final_layer_norm.weight,
        f"{encoder}linear1.weight": aifi.mlp.fc1.weight,
        f"{DETECTOR}encoder.pan_blocks.1.bottlenecks.2.conv2.conv.weight": (
            model.model.encoder.pan_blocks[1].bottlenecks[2].conv2.conv.weight
        ),
    }
    for name, value in spots.items():
        assert torch.equal(value, state[name]), name
    # Every value that was published is somewhere, and nothing else is.
    skipped = ("anchors", "valid_mask", "num_batches_tracked")
    named = [*model.named_parameters(), *model.named_buffers()]
    there = [v.flatten() for n, v in named if not n.endswith(skipped)]
    wanted = [
        v.flatten() for n, v in state.items() if n[:20] == DETECTOR and not n.endswith(skipped)
    ]
    assert torch.equal(torch.cat(there).sort().values, torch.cat(wanted).sort().values)


def test_an_imported_checkpoint_finds_objects_and_relations(imported):
    _, out, _ = imported
    config = settings(detector_path=str(out), predicate_set="3dssg")
    detector = RtDetrDetector(config)
    head = EgtrRelationHead(config, detector)
    assert detector.classes == SCANNET_CLASSES and head.predicates == SCANNET_PREDICATES
    assert detector.default_score_threshold == 0.7
    assert len(detector.model.model.decoder.layers) == 3
    found = detector.detect(image(), 0.0)
    names = [SCANNET_CLASSES[row.argmax()] for row in found.class_probabilities]
    related = head.relate(segmented(names, found.scores, found.features), 10)
    assert related.logits.shape == (10, 7)


@pytest.mark.parametrize("bottleneck", [True, False])
def test_the_first_architecture_in_its_own_spelling(tmp_path, bottleneck):
    state = published_state(second=False, bottleneck=bottleneck)
    made = import_checkpoint(save_published(tmp_path, state), tmp_path / "out")
    assert made.architecture == "rt_detr"
    model = transformers.RTDetrForObjectDetection.from_pretrained(tmp_path / "out")
    wanted = state[f"{DETECTOR}encoder.input_proj.1.0.weight"]
    assert torch.equal(model.model.encoder_input_proj[1][0].weight, wanted)
    # Without a config.json: FROSS's three layers, no statistics.
    card = read_detector_card(tmp_path / "out" / "deworldsg.json")
    assert (card.decoder_layers, card.frequency_bias, card.class_scores) == (3, False, "softmax")


def test_published_sizes_are_recognised():
    """The r50vd_m of FROSS, by the shapes alone."""
    sizes = {
        "backbone.conv1.conv1_3.conv.weight": (64, 32, 3, 3),
        "decoder.denoising_class_embed.weight": (151, 256),
        "encoder.encoder.0.layers.0.linear1.weight": (1024, 256),
        "encoder.fpn_blocks.0.conv1.conv.weight": (128, 512, 1, 1),
        "decoder.decoder.layers.5.linear1.weight": (1024, 256),
        "decoder.decoder.layers.0.linear1.weight": (1024, 256),
        "decoder.decoder.layers.0.cross_attn.attention_weights.weight": (96, 256),
        "decoder.decoder.layers.0.cross_attn.num_points_scale": (12,),
        "decoder.dec_score_head.0.weight": (150, 256),
    }
    for stage, (width, depth) in enumerate([(256, 3), (512, 4), (1024, 6), (2048, 3)]):
        for block in range(depth):
            name = f"backbone.res_layers.{stage}.blocks.{block}.branch2c.conv.weight"
            sizes[name] = (width, width // 4, 1, 1)
    for level, width in enumerate((512, 1024, 2048)):
        sizes[f"encoder.input_proj.{level}.conv.weight"] = (256, width, 1, 1)
        sizes[f"decoder.input_proj.{level}.conv.weight"] = (256, 256, 1, 1)
    empty = {name: torch.empty(shape, device="meta") for name, shape in sizes.items()}
    found = infer_config(empty, {}, "here")
    published = transformers.RTDetrV2Config(hidden_expansion=0.5, num_labels=150)
    for field in ("d_model", "decoder_layers", "encoder_ffn_dim", "hidden_expansion", "num_labels"):
        assert getattr(found, field) == getattr(published, field), field
    for field in ("encoder_in_channels", "decoder_in_channels", "decoder_n_points", "num_queries"):
        assert tuple(np.atleast_1d(getattr(found, field))) == tuple(
            np.atleast_1d(getattr(published, field))
        ), field
    for field in ("hidden_sizes", "depths", "layer_type", "embedding_size", "out_features"):
        there = getattr(published.backbone_config, field)
        assert np.array_equal(getattr(found.backbone_config, field), there), field


@pytest.mark.parametrize(
    "name",
    [
        f"{DETECTOR}decoder.decoder.layers.3.norm2.weight",
        f"{DETECTOR}encoder.encoder.0.layers.0.self_attn.in_proj_bias",
        f"{DETECTOR}backbone.res_layers.2.blocks.1.branch2b.norm.running_var",
        f"{DETECTOR}backbone.conv1.conv1_3.conv.weight",
        f"{HEAD}proj_k.1.weight",
        f"{HEAD}connectivity_layer.layers.2.bias",
        f"{HEAD}final_sub_proj.weight",
    ],
)
def test_a_missing_parameter_is_named(tmp_path, name):
    state = published_state()
    del state[name]
    with pytest.raises(ConfigurationError, match=name.split(".", 2)[2].replace(".", r"\.")):
        import_checkpoint(save_published(tmp_path, state), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "name",
    [
        f"{DETECTOR}decoder.decoder.layers.3.norm4.weight",
        f"{DETECTOR}neck.weight",
        f"{DETECTOR}encoder.attention.weight",
        f"{HEAD}proj_v.1.weight",
        "model.model.backbone.conv_encoder.weight",
    ],
)
def test_an_unknown_parameter_is_named(tmp_path, name):
    state = {**published_state(), name: torch.zeros(3)}
    with pytest.raises(ConfigurationError, match=name.split(".", 2)[2].replace(".", r"\.")):
        import_checkpoint(save_published(tmp_path, state), tmp_path / "out")


def test_a_parameter_of_another_size_is_named(tmp_path):
    state = published_state()
    state[f"{DETECTOR}decoder.enc_output.proj.weight"] = torch.zeros(WIDTH, WIDTH + 1)
    with pytest.raises(ConfigurationError, match=r"enc_output\.0\.weight"):
        import_checkpoint(save_published(tmp_path, state), tmp_path / "out")


def test_names_have_to_fit_the_outputs(tmp_path):
    path = save_published(tmp_path, published_state(classes=6, predicates=3))
    with pytest.raises(ConfigurationError, match="6 classes and 3 predicates, neither .*--names"):
        import_checkpoint(path, tmp_path / "out")
    with pytest.raises(ConfigurationError, match="and 1 and 3 are named"):
        import_checkpoint(path, tmp_path / "out", names=Names(("bed",), PREDICATES))
    file = tmp_path / "names.json"
    classes = ["a", "b", "c", "d", "e", "f"]
    file.write_text(json.dumps({"classes": classes, "predicates": PREDICATES}))
    arguments = ["import-fross", str(path), str(tmp_path / "out"), "--names", str(file)]
    result = CliRunner().invoke(app, [*arguments, "--frequency-bias"])
    assert result.exit_code == 0, result.output
    card = read_detector_card(tmp_path / "out" / "deworldsg.json")
    assert card.classes == tuple(classes) and card.frequency_bias
    # A second import does not overwrite the first.
    again = CliRunner().invoke(app, arguments)
    assert again.exit_code == 2


@pytest.mark.parametrize(
    "config, flags, told",
    [
        (None, [], True),
        ({"num_queries": 300}, [], True),
        ({"use_freq_bias": False}, [], False),
        (None, ["--no-frequency-bias"], False),
    ],
)
def test_statistics_without_a_config_json_are_asked_about(tmp_path, config, flags, told):
    path = save_published(tmp_path, published_state(), config)
    arguments = ["import-fross", str(path), str(tmp_path / "out"), *flags]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert ("Put FROSS's config.json" in result.output) == told
    assert not read_detector_card(tmp_path / "out" / "deworldsg.json").frequency_bias


class Surprise:
    """What a pickle may do when it is loaded."""

    def __reduce__(self):
        return print, ("this must not run",)


def test_nothing_in_a_checkpoint_is_executed(tmp_path, capsys):
    path = tmp_path / "bad.ckpt"
    torch.save({"state_dict": {}, "hyper_parameters": Surprise()}, path)
    with pytest.raises(ConfigurationError, match="cannot be read .* save its tensors alone"):
        import_checkpoint(path, tmp_path / "out")
    assert "must not run" not in capsys.readouterr().out


@pytest.mark.parametrize("content", [b"", b"no checkpoint", None])
def test_files_that_are_no_checkpoint(tmp_path, content):
    path = tmp_path / "epoch.ckpt"
    if content is None:
        torch.save({"weights": torch.zeros(2)}, path)
    else:
        path.write_bytes(content)
    with pytest.raises(ConfigurationError, match="cannot be read|expected an entry `state_dict`"):
        import_checkpoint(path, tmp_path / "out")
    with pytest.raises(ConfigurationError, match="expected a .ckpt file, or a folder"):
        import_checkpoint(tmp_path / "nothing", tmp_path / "out")


def test_the_last_epoch_of_a_folder_is_taken(tmp_path):
    path = save_published(tmp_path, published_state())
    path.with_name("epoch=10-validation_loss=2.00.ckpt").write_bytes(b"damaged, and the last")
    with pytest.raises(ConfigurationError, match="epoch=10-validation_loss=2.00.ckpt cannot be"):
        import_checkpoint(tmp_path / "version_0", tmp_path / "out")


def test_spellings_are_one():
    first, _ = split(published_state(second=False), "here")
    assert "encoder.input_proj.0.conv.weight" in first
