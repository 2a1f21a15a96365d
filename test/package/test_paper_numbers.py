"""Every number that the paper prints about its method, against configurations and code.

The expected values are literals here, with their place in the paper. A test with the paper's text
shows that each quotation stands in it.
"""

import re
from typing import Any

import msgspec
import numpy as np
import pytest

from deworldsg_ros.checkpoints.cards import DEFAULT_SCORE_THRESHOLD, BackboneIdentity, ProbeCard
from deworldsg_ros.config import Config, LiftingConfig, load_config
from deworldsg_ros.evaluation.rows import REPLICA_TEST_SCANS, RUNTIME_MS
from deworldsg_ros.lifting import Lifting
from deworldsg_ros.lifting.stage import LiftingConstants
from deworldsg_ros.merging.paper_rule import bhattacharyya_bound
from deworldsg_ros.relations.paper import geometric_costs, neighbour_pairs
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.frame_graph import FrameGraph, LocalGraph, Relations, Vocabulary

IMPLEMENTATION = "Sec. 5, Implementation Details"
# Where an option has the value of the paper: everywhere; not by default; for its networks only.
RULES = ("paper.yaml", "paper_rules.yaml")
EVERYWHERE = (*RULES, "default.yaml", "built in")
NETWORKS = ("paper.yaml",)
# Place in the paper, words of its source without spaces and braces, option, value, files.
OPTIONS = [
    (IMPLEMENTATION, r"$\tau=0.05$", "lifting.tau", 0.05, EVERYWHERE),
    (IMPLEMENTATION, r"$\gamma_\textbase$=0.03", "lifting.gamma_base_m", 0.03, EVERYWHERE),
    (IMPLEMENTATION, r"$\delta_g=0.7$", "merging.hellinger_threshold", 0.7, EVERYWHERE),
    (IMPLEMENTATION, r"$\delta_c=0.8$", "merging.class_distance_threshold", 0.8, EVERYWHERE),
    (IMPLEMENTATION, r"$\alpha_ij=0.5$", "relations.fusion_alpha", 0.5, EVERYWHERE),
    (
        *(IMPLEMENTATION, "entropythresholdissetto1.0"),
        *("relations.entropy_threshold_nats", 1.0, EVERYWHERE),
    ),
    (
        *("Sec. 4.3, Eq. 8", r"\mathrmGeoCost(i,j)<0.45"),
        *("relations.geo_cost_threshold", 0.45, EVERYWHERE),
    ),
    ("Sec. 4.3", "sliding16-framebuffer", "relations.clip_length", 16, EVERYWHERE),
    (IMPLEMENTATION, "top10relationshipsperframe", "perception.max_relations", 10, RULES),
    (IMPLEMENTATION, "confidencethresholdof0.7", "perception.score_threshold", 0.7, NETWORKS),
]
CONSTANTS = [
    (IMPLEMENTATION, r"$\epsilon=1e-3$", LiftingConstants().epsilon_m, 1e-3),
    (IMPLEMENTATION, r"$\alpha$=10", LiftingConstants().alpha, 10.0),
    (IMPLEMENTATION, r"$\beta$=0.02", LiftingConstants().beta, 0.02),
    ("Sec. 4.1", "($<10$pixels)", LiftingConstants().min_pixels, 10),
    (IMPLEMENTATION, "confidencethresholdof0.7", DEFAULT_SCORE_THRESHOLD["softmax"], 0.7),
    ("Sec. 5, Datasets", "11scenesfortesting", len(REPLICA_TEST_SCANS), 11),
    ("Sec. 5.4, Runtime", "averageof4.42ms", RUNTIME_MS["detection"], 4.42),
    ("Sec. 5.4, Runtime", "relationinference7.28ms", RUNTIME_MS["relation_inference"], 7.28),
    ("Sec. 5.4, Runtime", "merging2.23ms", RUNTIME_MS["merging"], 2.23),
    ("Sec. 5.4, Runtime", "segmentation(25.26ms)", RUNTIME_MS["masks"], 25.26),
    ("Sec. 5.4, Runtime", "refinementprocess(69.39ms)", RUNTIME_MS["relations"], 69.39),
    ("Sec. 5.4, Runtime", "latencyof108.53ms", RUNTIME_MS["total"], 108.53),
]
# Numbers in equations and in the text, tested by what the code does, below.
BEHAVIOUR = [
    ("Sec. 4.1", r"$3\times3$neighborhood"),
    ("Sec. 4.1, Eq. 4", r"\frac1|P_i,t|-1"),
    ("Sec. 4.3, Eq. 8", r"0.5\cdot\fracd_2D(i,j)d_\mathrmdiag"),
    ("Sec. 4.3", "twofullyconnectedlayers"),
    ("Sec. 4.3", "16-frameunion-cropclip"),
]
# Not printed: the value of ε in Eq. 4, which shares only its letter with that of Eq. 1, and the
# unit of the entropy. lifting.covariance_ridge_m2 and nats are ours.


@pytest.fixture(scope="module")
def configurations(root_dir):
    loaded = {name: load_config(root_dir / "config" / name) for name in EVERYWHERE[:-1]}
    return {**loaded, "built in": Config()}


@pytest.mark.parametrize(("place", "words", "option", "printed", "files"), OPTIONS)
def test_an_option_has_the_printed_value(configurations, *, place, words, option, printed, files):
    section, field = option.split(".")
    values = {name: getattr(getattr(configurations[name], section), field) for name in files}
    assert values == dict.fromkeys(files, printed), place


@pytest.mark.parametrize(("place", "words", "value", "printed"), CONSTANTS)
def test_a_constant_has_the_printed_value(place, words, value, printed):
    assert value == printed, place


def test_the_numbers_stand_in_the_paper(shared_dir):
    text = (shared_dir / "paper" / "deworldsg.tex").read_text(encoding="utf-8")
    text = re.sub(r"[\s{}~]|\\,", "", text)
    for _, words, *_ in [*OPTIONS, *CONSTANTS, *BEHAVIOUR]:
        assert words in text, words


def lifted(
    depth_m: np.ndarray, mask: np.ndarray | None = None, focal_px: float = 50.0, **lifting: float
) -> LocalGraph:
    """One object as the lifting stage sees it, which has its own constants, not those of a test."""
    height, width = depth_m.shape
    graph = FrameGraph(
        *(0, "camera", width, height, Vocabulary(("chair",), ())),
        *(np.array([[0.0, 0.0, width, height]]), np.ones((1, 1)), np.ones(1), Relations.none(0)),
    )
    instances = np.ones(depth_m.shape, np.uint16) if mask is None else mask.astype(np.uint16)
    intrinsics = Intrinsics(focal_px, focal_px, width / 2, height / 2, width, height)
    config = msgspec.structs.replace(LiftingConfig(), **lifting)
    depth_m = depth_m.astype(np.float32)
    return Lifting(config).lift(graph, instances, depth_m, intrinsics, np.eye(4), "world")


def kept(*arguments: Any, **options: float) -> int:
    """Pixels of the object that the stage keeps; 0 if it drops the object."""
    return int(lifted(*arguments, **options).pixel_counts.sum())


@pytest.mark.parametrize(("step_m", "count"), [(0.1005, 400), (0.1015, 399)])
def test_eq_1_keeps_a_pixel_within_5_percent_and_a_millimetre(step_m, count):
    depth_m = np.full((20, 20), 2.0)  # 0.05 x 2 m + 1e-3 m = 0.101 m
    depth_m[10, 10] += step_m
    assert kept(depth_m, gamma_base_m=10.0) == count


def test_eq_1_takes_the_median_of_3_by_3_pixels():
    """The corners of a square of 3 x 3 pixels have 4 of 9 neighbours in it, its edges 6."""
    depth_m = np.full((20, 20), 2.0)
    depth_m[8:11, 8:11] += 0.5
    assert kept(depth_m, gamma_base_m=10.0) == 400 - 4


@pytest.mark.parametrize(
    ("depth_m", "gap_m", "whole"),
    [
        # γ_base = 0.03 m is the largest term near the camera, β d_ref = 0.02 x 3 m further away.
        (1.0, 0.029, True),
        (1.0, 0.031, False),
        (3.0, 0.058, True),
        (3.0, 0.062, False),
    ],
)
def test_eq_2_splits_depths_at_the_printed_gaps(depth_m, gap_m, whole):
    image_m = np.full((20, 20), depth_m)
    image_m[15:] += gap_m
    assert kept(image_m) == (400 if whole else 300)


@pytest.mark.parametrize(("gap_m", "whole"), [(0.08, True), (0.098, True), (0.102, False)])
def test_eq_2_splits_depths_at_10_times_the_median_step(gap_m, whole):
    image_m = 2.0 + 0.01 * np.arange(100.0).reshape(10, 10)  # α median(Δz) = 10 x 0.01 m
    image_m[9:] += gap_m - 0.01
    assert kept(image_m) == (100 if whole else 90)


@pytest.mark.parametrize(("pixels", "count"), [(9, 0), (10, 10)])
def test_an_object_of_less_than_10_pixels_is_dropped(pixels, count):
    mask = np.zeros((4, 5), bool)
    mask.flat[:pixels] = True
    assert kept(np.full((4, 5), 2.0), mask) == count


def test_eq_4_divides_by_one_less_than_the_number_of_points():
    local = lifted(np.full((4, 5), 2.0), focal_px=2.0)
    x_m = np.tile(np.arange(5.0), 4)  # 2 m / 2 px
    expected = ((x_m - x_m.mean()) ** 2).sum() / 19 + LiftingConfig().covariance_ridge_m2
    assert local.covariances_world[0, 0, 0] == pytest.approx(expected, rel=1e-9)


def test_eq_6_compares_the_hellinger_distance_with_0_7(configurations):
    threshold = configurations["paper.yaml"].merging.hellinger_threshold
    # HD < δ if and only if BD < -ln(1 - δ²).
    assert bhattacharyya_bound(threshold) == pytest.approx(0.6733445532637656, abs=1e-12)


def test_eq_8_halves_the_distance_in_the_image_and_compares_with_0_45():
    boxes = np.array([[0.0, 0.0, 0.0, 0.0], [30.0, 40.0, 30.0, 40.0]])  # one diagonal apart
    depths_m = np.array([2.0, 2.0])
    assert geometric_costs(boxes, depths_m, 30, 40)[0, 1] == 0.5
    threshold = Config().relations.geo_cost_threshold
    for gap_m, pairs in ((0.449, 2), (0.451, 0)):
        found, _ = neighbour_pairs(
            np.zeros((2, 4)), np.array([2.0, 2.0 + gap_m]), 30, 40, threshold
        )
        assert len(found) == pairs


@pytest.mark.models
def test_the_probe_has_two_fully_connected_layers():
    torch = pytest.importorskip("torch")
    from deworldsg_ros.checkpoints.probe_network import PUBLISHED_BACKBONE, build_network

    assert PUBLISHED_BACKBONE.clip_length == 16
    network = build_network(ProbeCard(BackboneIdentity("vjepa2", 8, 32, 16), ("on", "near")))
    assert sum(isinstance(part, torch.nn.Linear) for part in network.modules()) == 2
