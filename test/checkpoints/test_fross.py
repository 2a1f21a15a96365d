"""`deworldsg models import-fross`: every parameter of the published layout finds its place."""

import json
import re

import numpy as np
import pytest
from support.torch_models import PREDICATES, WIDTH, image, segmented, settings, torch, transformers
from typer.testing import CliRunner

from deworldsg_ros.checkpoints.cards import read_detector_card
from deworldsg_ros.checkpoints.fross import Names, import_checkpoint, infer_config
from deworldsg_ros.cli.models import app
from deworldsg_ros.perception.backends.closed_set import ClosedSetDetector, EgtrRelationHead
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

    def conv(name, out, into, size, counter=True, parts=("conv", "norm")):
        shapes[f"{name}.{parts[0]}.weight"] = (out, into, size, size)
        for part in ("weight", "bias", "running_mean", "running_var"):
            shapes[f"{name}.{parts[1]}.{part}"] = (out,)
        if counter:
            shapes[f"{name}.{parts[1]}.num_batches_tracked"] = ()

    def linear(name, out, into, weight="weight", bias="bias"):
        shapes[f"{name}.{weight}"], shapes[f"{name}.{bias}"] = (out, into), (out,)

    def perceptron(name, *widths):
        for index, (into, out) in enumerate(zip(widths, widths[1:])):
            linear(f"{name}.layers.{index}", out, into)

    def layer(name, hidden, norms):
        """A layer of a transformer."""
        linear(f"{name}.self_attn", 3 * W, W, "in_proj_weight", "in_proj_bias")
        linear(f"{name}.self_attn.out_proj", W, W)
        linear(f"{name}.linear1", hidden, W)
        linear(f"{name}.linear2", W, hidden)
        for index in range(1, norms + 1):
            shapes[f"{name}.norm{index}.weight"] = shapes[f"{name}.norm{index}.bias"] = (W,)

    W = WIDTH
    backbone, encoder, decoder = (f"{DETECTOR}{n}" for n in ("backbone", "encoder", "decoder"))
    for index, (into, out) in enumerate([(3, 4), (4, 4), (4, 8)], start=1):
        conv(f"{backbone}.conv1.conv1_{index}", out, into, 3, False)
    before = 8
    # ResNet-18 and 34 begin with as many channels as the stem ends with.
    for stage, (width, depth) in enumerate(zip(HIDDEN if bottleneck else (8, *HIDDEN[1:]), DEPTHS)):
        inner = width // 4
        for block in range(depth):
            name = f"{backbone}.res_layers.{stage}.blocks.{block}"
            into = before if block == 0 else width
            for branch, out, into_branch, size in (
                [("a", inner, into, 1), ("b", inner, inner, 3), ("c", width, inner, 1)]
                if bottleneck
                else [("a", width, into, 3), ("b", width, width, 3)]
            ):
                conv(f"{name}.branch2{branch}", out, into_branch, size, False)
            if block == 0:
                # The first stage keeps the resolution; the others pool, and then project.
                short = f"{name}.short" if stage == 0 else f"{name}.short.conv"
                conv(short, width, into, 1, False)
        before = width
    for level, into in enumerate(HIDDEN[1:]):
        parts = ("conv", "norm") if second else ("0", "1")
        conv(f"{encoder}.input_proj.{level}", W, into, 1, parts=parts)
        conv(f"{decoder}.input_proj.{level}", W, W, 1)
    layer(f"{encoder}.encoder.0.layers.0", 48, 2)
    for index in range(2):
        conv(f"{encoder}.lateral_convs.{index}", W, W, 1)
        conv(f"{encoder}.downsample_convs.{index}", W, W, 3)
        for blocks in ("fpn_blocks", "pan_blocks"):
            name = f"{encoder}.{blocks}.{index}"
            conv(f"{name}.conv1", W // 2, 2 * W, 1)
            conv(f"{name}.conv2", W // 2, 2 * W, 1)
            conv(f"{name}.conv3", W, W // 2, 1)
            for block in range(3):
                conv(f"{name}.bottlenecks.{block}.conv1", W // 2, W // 2, 3)
                conv(f"{name}.bottlenecks.{block}.conv2", W // 2, W // 2, 1)
    for index in range(LAYERS):
        name = f"{decoder}.decoder.layers.{index}"
        layer(name, 40, 3)
        if second:
            shapes[f"{name}.cross_attn.num_points_scale"] = (12,)
        for part, out in (("sampling_offsets", 8 * 12 * 2), ("attention_weights", 8 * 12)):
            linear(f"{name}.cross_attn.{part}", out, W)
        for part in ("value_proj", "output_proj"):
            linear(f"{name}.cross_attn.{part}", W, W)
        linear(f"{decoder}.dec_score_head.{index}", classes, W)
        perceptron(f"{decoder}.dec_bbox_head.{index}", W, W, W, 4)
        linear(f"{HEAD}proj_q.{index}", W, W)
        linear(f"{HEAD}proj_k.{index}", W, W)
    shapes[f"{decoder}.denoising_class_embed.weight"] = (classes + 1, W)
    perceptron(f"{decoder}.query_pos_head", 4, 2 * W, W)
    linear(f"{decoder}.enc_output.proj", W, W)
    shapes[f"{decoder}.enc_output.norm.weight"] = shapes[f"{decoder}.enc_output.norm.bias"] = (W,)
    linear(f"{decoder}.enc_score_head", classes, W)
    perceptron(f"{decoder}.enc_bbox_head", W, W, W, 4)
    if second:
        shapes[f"{decoder}.anchors"] = (1, 8400, 4)
        shapes[f"{decoder}.valid_mask"] = (1, 8400, 1)
    shapes[f"{HEAD}triplet_dist"] = (classes + 1, classes + 1, predicates)
    shapes[f"{HEAD}rel_dist"] = (predicates,)
    linear(f"{HEAD}final_sub_proj", W, W)
    linear(f"{HEAD}final_obj_proj", W, W)
    linear(f"{HEAD}rel_predictor_gate", 1, 2 * W)
    perceptron(f"{HEAD}rel_predictor", 2 * W, W, W, predicates)
    perceptron(f"{HEAD}connectivity_layer", 2 * W, W, W, 1)
    return shapes


def published_state(**layout):
    generator = torch.Generator().manual_seed(0)
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


def run_import(*arguments):
    return CliRunner().invoke(app, ["import-fross", *map(str, arguments)])


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    root = tmp_path_factory.mktemp("published")
    state = published_state()
    config = {"use_freq_bias": True, "num_queries": 25, "rt_detr_transformer_eval_idx": 2}
    result = run_import(save_published(root, state, config), root / "out")
    assert result.exit_code == 0, result.output
    return state, root / "out", result.output


def test_parameters_are_where_they_belong(imported):
    state, out, message = imported
    assert "rt_detr_v2" in message and "3 of 4 decoder layers" in message
    assert "20 classes, 7 predicates" in message and "statistics on" in message
    model, report = transformers.RTDetrV2ForObjectDetection.from_pretrained(
        out, output_loading_info=True
    )
    assert not any(report[f"{kind}_keys"] for kind in ("missing", "unexpected", "mismatched"))
    assert model.config.num_queries == 25
    assert model.config.id2label[4] == SCANNET_CLASSES[4]
    inner, decoder, layer = model.model, model.model.decoder, model.model.decoder.layers[2]
    aifi = next(m for n, m in model.named_modules() if n.endswith("aifi.0.layers.0"))
    in_decoder = "decoder.decoder.layers.2."
    attention = f"{in_decoder}self_attn."
    spots = {
        f"{attention}out_proj.weight": layer.self_attn.o_proj.weight,
        f"{in_decoder}norm3.bias": layer.final_layer_norm.bias,
        "decoder.dec_bbox_head.3.layers.2.bias": decoder.bbox_embed[3].layers[2].bias,
        "decoder.input_proj.1.norm.running_mean": inner.decoder_input_proj[1][1].running_mean,
        "encoder.input_proj.2.conv.weight": inner.encoder_input_proj[2][0].weight,
        "encoder.encoder.0.layers.0.linear1.weight": aifi.mlp.fc1.weight,
        "encoder.pan_blocks.1.bottlenecks.2.conv2.conv.weight": (
            inner.encoder.pan_blocks[1].bottlenecks[2].conv2.conv.weight
        ),
    }
    for name, value in spots.items():
        assert torch.equal(value, state[DETECTOR + name]), name
    for kind in ("weight", "bias"):
        parts = state[f"{DETECTOR}{attention}in_proj_{kind}"].split(WIDTH)
        for letter, part in zip("qkv", parts):
            assert torch.equal(getattr(getattr(layer.self_attn, f"{letter}_proj"), kind), part)
    # Every value that was published is somewhere, and nothing else is.
    skipped = ("anchors", "valid_mask", "num_batches_tracked")
    published = [(n, v) for n, v in state.items() if n.startswith(DETECTOR)]
    there, wanted = (
        torch.cat([v.flatten() for n, v in named if not n.endswith(skipped)]).sort().values
        for named in ([*model.named_parameters(), *model.named_buffers()], published)
    )
    assert torch.equal(there, wanted)


def test_an_imported_checkpoint_finds_objects_and_relations(imported):
    _, out, _ = imported
    config = settings(detector_path=str(out), predicate_set="3dssg")
    detector = ClosedSetDetector(config)
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
    fields = ("d_model", "decoder_layers", "encoder_ffn_dim", "hidden_expansion", "num_labels")
    lists = ("encoder_in_channels", "decoder_in_channels", "decoder_n_points", "num_queries")
    for field in (*fields, *lists):
        both = (np.atleast_1d(getattr(config, field)) for config in (found, published))
        assert np.array_equal(*both), field
    for field in ("hidden_sizes", "depths", "layer_type", "embedding_size", "out_features"):
        there = getattr(published.backbone_config, field)
        assert np.array_equal(getattr(found.backbone_config, field), there), field


WRONG_SIZE = f"{DETECTOR}decoder.enc_output.proj.weight"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        # Missing.
        (f"{DETECTOR}encoder.encoder.0.layers.0.self_attn.in_proj_bias", None),
        (f"{DETECTOR}backbone.res_layers.2.blocks.1.branch2b.norm.running_var", None),
        (f"{HEAD}proj_k.1.weight", None),
        # Unknown.
        (f"{DETECTOR}decoder.decoder.layers.3.norm4.weight", torch.zeros(3)),
        (f"{DETECTOR}encoder.attention.weight", torch.zeros(3)),
        (f"{HEAD}proj_v.1.weight", torch.zeros(3)),
        ("model.model.backbone.conv_encoder.weight", torch.zeros(3)),
        (WRONG_SIZE, torch.zeros(WIDTH, WIDTH + 1)),
    ],
)
def test_a_parameter_that_does_not_fit_is_named(tmp_path, name, value):
    state = {**published_state(), name: value}
    state = {key: part for key, part in state.items() if part is not None}
    shown = "enc_output.0.weight" if name == WRONG_SIZE else name.split(".", 2)[2]
    with pytest.raises(ConfigurationError, match=re.escape(shown)):
        import_checkpoint(save_published(tmp_path, state), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_names_have_to_fit_the_outputs(tmp_path):
    path = save_published(tmp_path, published_state(classes=6, predicates=3))
    out, file = tmp_path / "out", tmp_path / "names.json"
    with pytest.raises(ConfigurationError, match="6 classes and 3 predicates, .*--names"):
        import_checkpoint(path, out)
    with pytest.raises(ConfigurationError, match="1 and 3 are named"):
        import_checkpoint(path, out, names=Names(("bed",), PREDICATES))
    classes = tuple("abcdef")
    file.write_text(json.dumps({"classes": classes, "predicates": PREDICATES}))
    arguments = (path, out, "--names", file, "--frequency-bias")
    result = run_import(*arguments)
    assert result.exit_code == 0, result.output
    card = read_detector_card(out / "deworldsg.json")
    assert card.classes == classes and card.frequency_bias
    # A second import does not overwrite the first.
    assert run_import(*arguments).exit_code == 2


@pytest.mark.parametrize(
    ("config", "flags", "told"),
    [
        ({"num_queries": 300}, [], True),
        ({"use_freq_bias": False}, [], False),
        (None, ["--no-frequency-bias"], False),
    ],
)
def test_statistics_without_a_config_json_are_asked_about(tmp_path, config, flags, told):
    path = save_published(tmp_path, published_state(), config)
    result = run_import(path, tmp_path / "out", *flags)
    assert result.exit_code == 0, result.output
    assert ("Put FROSS's config.json" in result.output) == told
    assert not read_detector_card(tmp_path / "out" / "deworldsg.json").frequency_bias


class Surprise:
    """What a pickle may do when it is loaded."""

    def __reduce__(self):
        return print, ("this must not run",)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "cannot be read"),
        (b"no checkpoint", "cannot be read"),
        ({"weights": torch.zeros(2)}, "expected an entry `state_dict`"),
        ({"state_dict": {}, "hyper_parameters": Surprise()}, "cannot be read"),
        (None, "expected a .ckpt file, or a folder"),
    ],
)
def test_files_that_are_no_checkpoint_are_refused_and_nothing_runs(
    tmp_path, capsys, content, message
):
    # The last epoch of a folder is taken.
    path = save_published(tmp_path, {}).with_name("epoch=10-validation_loss=2.00.ckpt")
    if isinstance(content, dict):
        torch.save(content, path)
    elif content is not None:
        path.write_bytes(content)
    folder = tmp_path / ("nothing" if content is None else "version_0")
    name = "nothing" if content is None else path.name
    with pytest.raises(ConfigurationError, match=f"{name}.*{message}|{message}.*{name}"):
        import_checkpoint(folder, tmp_path / "out")
    assert "must not run" not in capsys.readouterr().out
