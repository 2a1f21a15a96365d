"""Kinds of classes by name."""

import numpy as np
import pytest

from deworldsg_ros.scene.vocabulary import (
    COCO_CLASSES,
    FIXED_TO,
    KINDS,
    SCANNET_CLASSES,
    VISUAL_GENOME_CLASSES,
    fixed_table,
    kind_table,
)

VOCABULARIES = (COCO_CLASSES, SCANNET_CLASSES, VISUAL_GENOME_CLASSES)


@pytest.mark.parametrize("classes", [(), ("unicorn", ""), *VOCABULARIES])
def test_the_tables_name_each_kind_of_each_class(classes: tuple[str, ...]) -> None:
    kinds, fixed = kind_table(classes), fixed_table(classes)
    assert kinds.shape == (len(classes), len(KINDS)) and kinds.dtype == np.float64
    assert fixed.shape == (len(classes),) * 2 and fixed.dtype == np.bool_
    for row, name in enumerate(classes):
        assert kinds[row].tolist() == [name in kind for kind in KINDS]
        held_by = {other for column, other in enumerate(classes) if fixed[row, column]}
        assert held_by == FIXED_TO.get(name, frozenset()) & set(classes)


def test_kinds_and_what_is_fixed_have_names_that_a_detector_knows() -> None:
    known = set().union(*VOCABULARIES)
    assert all(kind & known for kind in KINDS)
    assert set(FIXED_TO).union(*FIXED_TO.values()) <= known
