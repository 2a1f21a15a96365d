"""Numbers that the paper prints about its method, against configurations and constants.

The expected values are literals here, with their place in the paper. A test with the paper's text
shows that each quotation stands in it. References of the equations check the others.
"""

import re

import pytest

from deworldsg_ros.checkpoints.cards import DEFAULT_SCORE_THRESHOLD
from deworldsg_ros.config import Config, load_config
from deworldsg_ros.evaluation.rows import REPLICA_TEST_SCANS, RUNTIME_MS
from deworldsg_ros.lifting.stage import LiftingConstants

# Where an option has the value of the paper: everywhere; not by default; for its networks only.
RULES = ("paper.yaml", "paper_replica.yaml", "paper_rules.yaml")
EVERYWHERE = (*RULES, "default.yaml", "built in")
NETWORKS = ("paper.yaml", "paper_replica.yaml")
# Words of the paper's source without spaces and braces, option, value, files.
OPTIONS = [
    # Sec. 5, Implementation Details.
    (r"$\tau=0.05$", "lifting.tau", 0.05, EVERYWHERE),
    (r"$\gamma_\textbase$=0.03", "lifting.gamma_base_m", 0.03, EVERYWHERE),
    (r"$\delta_g=0.7$", "merging.hellinger_threshold", 0.7, EVERYWHERE),
    (r"$\delta_c=0.8$", "merging.class_distance_threshold", 0.8, EVERYWHERE),
    (r"$\alpha_ij=0.5$", "relations.fusion_alpha", 0.5, EVERYWHERE),
    ("entropythresholdissetto1.0", "relations.entropy_threshold_nats", 1.0, EVERYWHERE),
    ("top10relationshipsperframe", "perception.max_relations", 10, RULES),
    ("confidencethresholdof0.7", "perception.score_threshold", 0.7, NETWORKS),
    # Sec. 4.3, and its Eq. 8.
    ("sliding16-framebuffer", "relations.clip_length", 16, EVERYWHERE),
    (r"\mathrmGeoCost(i,j)<0.45", "relations.geo_cost_threshold", 0.45, EVERYWHERE),
]
CONSTANTS = [
    # Sec. 5, Implementation Details and Datasets.
    (r"$\epsilon=1e-3$", LiftingConstants().epsilon_m, 1e-3),
    (r"$\alpha$=10", LiftingConstants().alpha, 10.0),
    (r"$\beta$=0.02", LiftingConstants().beta, 0.02),
    ("confidencethresholdof0.7", DEFAULT_SCORE_THRESHOLD["softmax"], 0.7),
    ("11scenesfortesting", len(REPLICA_TEST_SCANS), 11),
    # Sec. 4.1.
    ("($<10$pixels)", LiftingConstants().min_pixels, 10),
    # Sec. 5.4, Runtime.
    ("averageof4.42ms", RUNTIME_MS["detection"], 4.42),
    ("relationinference7.28ms", RUNTIME_MS["relation_inference"], 7.28),
    ("merging2.23ms", RUNTIME_MS["merging"], 2.23),
    ("segmentation(25.26ms)", RUNTIME_MS["masks"], 25.26),
    ("refinementprocess(69.39ms)", RUNTIME_MS["relations"], 69.39),
    ("latencyof108.53ms", RUNTIME_MS["total"], 108.53),
]
# Not printed: the value of ε in Eq. 4, which shares only its letter with that of Eq. 1, and the
# unit of the entropy. lifting.covariance_ridge_m2 and nats are ours.


@pytest.mark.parametrize(("words", "option", "printed", "files"), OPTIONS)
def test_an_option_has_the_printed_value(root_dir, words, option, printed, files):
    section, field = option.split(".")
    for name in files:
        config = Config() if name == "built in" else load_config(root_dir / "config" / name)
        assert getattr(getattr(config, section), field) == printed, (name, words)


@pytest.mark.parametrize(("words", "value", "printed"), CONSTANTS)
def test_a_constant_has_the_printed_value(words, value, printed):
    assert value == printed, words


def test_the_numbers_stand_in_the_paper(shared_dir):
    text = (shared_dir / "paper" / "deworldsg.tex").read_text(encoding="utf-8")
    text = re.sub(r"[\s{}~]|\\,", "", text)
    for words, *_ in [*OPTIONS, *CONSTANTS]:
        assert words in text, words
