"""The card of a detector's checkpoint, `deworldsg.json`: how its outputs are read."""

from pathlib import Path
from typing import Annotated, Literal, Union

import msgspec

from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.files import read_regular, write_atomically
from deworldsg_ros.parsing import parse_json
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.vocabularies import PREDICATE_SETS

CARD_FILE = "deworldsg.json"
# Twenty thousand class names have 400 kB; a training record is smaller.
MAX_CARD_BYTES = 16_000_000
# Mean and standard deviation of ImageNet, RGB, of values in [0, 1].
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
# Least detection score by kind of score. The paper's 0.7 is for softmax scores; the sigmoid scores
# of RT-DETR are lower.
DEFAULT_SCORE_THRESHOLD = {"softmax": 0.7, "sigmoid": 0.5}

Positive = Annotated[float, msgspec.Meta(gt=0)]


class CheckpointCard(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a checkpoint is read. Without a card it is read as a public RT-DETR.

    Attributes:
        class_scores: ``softmax`` over the classes (the paper), or independent ``sigmoid``s.
        temperature: of the softmax of the class distribution; below 1 sharpens.
        score_threshold: least score of an object; None = 0.7 for softmax, 0.5 for sigmoid.
        decoder_layers: number of decoder layers to run; 0 = all.
        classes: names of the classes; empty = the `id2label` of config.json.
        predicates: names of the relation head's predicates; empty = no relation head.
        frequency_bias: whether the relation head adds its class-pair statistics.
    """

    class_scores: Literal["softmax", "sigmoid"] = "sigmoid"
    temperature: Positive = 1.0
    score_threshold: Union[Annotated[float, msgspec.Meta(ge=0, le=1)], None] = None
    decoder_layers: Annotated[int, msgspec.Meta(ge=0)] = 0
    classes: tuple[str, ...] = ()
    predicates: tuple[str, ...] = ()
    frequency_bias: bool = False


def read_card(path: Union[Path, None]) -> CheckpointCard:
    """The card in a file; None gives the default card. Raises ConfigurationError."""
    if path is None:
        return CheckpointCard()
    try:
        return parse_json(read_regular(path, MAX_CARD_BYTES), CheckpointCard)
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"checkpoint card {path}: {error}") from error


def write_card(path: Path, card: CheckpointCard) -> None:
    """Write a card as indented JSON."""
    write_atomically(path, msgspec.json.format(msgspec.json.encode(card), indent=2) + b"\n")


def graph_predicates(config: PerceptionConfig) -> Union[tuple[str, ...], None]:
    """The predicates of the graph, for nodes that do not run perception.

    Returns:
        None if the predicates are those of a checkpoint that is not a local folder.

    Raises:
        ConfigurationError: the checkpoint's card cannot be read, or names no predicates.
    """
    if config.predicate_set != "checkpoint":
        return PREDICATE_SETS[config.predicate_set]
    folder = Path(config.detector_path).expanduser()
    path = folder / CARD_FILE
    if not path.is_file():
        return None
    predicates = read_card(path).predicates
    if not predicates:
        raise ConfigurationError(
            f"perception.predicate_set is 'checkpoint' and {path} names no predicates: it is the "
            "card of a detector without a relation head"
        )
    return predicates
