"""The geometric relation head on rendered scenes with obvious relations."""

import re
from fnmatch import fnmatch

import cv2
import numpy as np
import pytest
from support.perception import CUP_ON_TABLE, INTRINSICS, SHAPE, TABLE_TOP, Slab, render, segmented

from deworldsg_ros.perception.backends import geometric
from deworldsg_ros.perception.backends.geometric import GeometricRelationHead
from deworldsg_ros.perception.backends.layout import measure_layout
from deworldsg_ros.scene.vocabulary import REPLICA_SSG_PREDICATES, SCANNET_PREDICATES

# Boxes of each thing: its ranges along x, y (forward) and z, metres. "cup:far" is another cup.
THINGS = {
    "table": [((-0.6, 0.6), (1.4, 2.2), (0.66, 0.70)), ((-0.1, 0.1), (1.7, 1.9), (0.0, 0.66))],
    "table:high": [((-0.6, 0.6), (1.5, 2.2), (0.95, 1.0)), ((0.4, 0.5), (1.7, 1.8), (0.0, 0.95))],
    "cup": [((-0.25, -0.10), (1.6, 1.75), (0.70, 0.86))],
    "cup:on plate": [((-0.05, 0.05), (1.68, 1.78), (0.72, 0.84))],
    "cup:at edge": [((0.5, 0.57), (1.6, 1.67), (0.70, 0.80))],
    "bowl": [((-0.05, 0.08), (1.6, 1.73), (0.70, 0.80))],
    "bowl:far": [((0.35, 0.48), (1.6, 1.73), (0.70, 0.80))],
    "bowl:right": [((0.2, 0.33), (1.6, 1.73), (0.70, 0.80))],
    "bowl:on stand": [((0.64, 0.74), (1.62, 1.72), (0.70, 0.80))],
    "stand": [((0.62, 0.9), (1.6, 1.9), (0.0, 0.70))],
    "plate": [((-0.12, 0.12), (1.6, 1.84), (0.70, 0.72))],
    "vase": [((-0.1, 0.05), (1.6, 1.75), (0.70, 0.9))],
    "plant": [((-0.15, 0.1), (1.58, 1.77), (0.9, 1.1))],
    "bottle": [((0.5, 0.57), (1.5, 1.57), (0.70, 0.95))],
    "screen": [((-0.3, 0.3), (1.9, 1.95), (0.70, 1.1))],
    "toothbrush": [((-0.25, -0.24), (1.6, 1.61), (0.70, 0.90))],
    "clock:lying": [((-0.1, 0.1), (1.55, 1.6), (0.70, 0.73))],
    "box": [((-0.08, 0.08), (1.62, 1.7), (0.70, 0.9))],
    "book:0": [((-0.1, -0.05), (1.6, 1.75), (0.70, 0.95))],
    "book:1": [((-0.05, 0.0), (1.6, 1.75), (0.70, 0.90))],
    "book:2": [((0.0, 0.05), (1.6, 1.75), (0.70, 0.93))],
    "phone:0": [((0.0, 0.07), (1.7, 1.77), (0.70, 0.72))],
    "phone:1": [((0.12, 0.19), (1.7, 1.77), (0.70, 0.72))],
    "phone:2": [((-0.13, -0.06), (1.7, 1.77), (0.70, 0.72))],
    "phone:3": [((0.0, 0.07), (1.54, 1.61), (0.70, 0.72))],
    "chair": [((0.75, 1.2), (1.5, 1.95), (0.0, 0.9))],
    "chair:by basket": [((0.3, 0.75), (1.9, 2.35), (0.0, 0.8))],
    # Its back rises past the table top, close to the bottle.
    "chair:by bottle": [((0.62, 0.68), (1.45, 1.8), (0.0, 1.0))],
    "basket": [((-0.1, 0.15), (1.95, 2.2), (0.0, 0.25))],
    "basket:low": [((-0.5, -0.2), (1.55, 1.85), (0.0, 0.25))],
    "shelf": [((-0.5, 0.5), (2.6, 2.95), (0.75, 1.05))],
    "cabinet": [((-0.5, 0.5), (2.5, 2.98), (0.0, 0.4))],
    "cabinet:left": [((-0.9, -0.1), (2.6, 3.1), (0.0, 0.6))],
    "shelf:right": [((-0.08, 0.7), (2.6, 3.1), (0.0, 0.95))],
    "cabinet:at wall": [((-0.5, 0.5), (3.6, 4.0), (0.0, 0.5))],
    "chair:at wall": [((-0.5, 0.5), (3.6, 4.0), (0.0, 0.5))],
    "clock": [((-0.15, 0.15), (3.95, 4.0), (0.7, 0.9))],
    "window": [((-0.5, 0.3), (3.98, 4.0), (0.7, 1.4))],
    "curtain": [((0.32, 0.6), (3.9, 3.98), (0.4, 1.5))],
}


def see(things, predicates=REPLICA_SSG_PREDICATES, top=100, flying_px=0):
    """Relations of things, best first, as {(subject, object): predicate}.

    Pixels within `flying_px` of the border of a mask get a depth between those of both sides.
    """
    names = things.split(", ")
    owners = np.concatenate([[0], *([row + 1] * len(THINGS[n]) for row, n in enumerate(names))])
    slabs = [Slab(*zip(*box), colour=(90, 90, 100)) for name in names for box in THINGS[name]]
    _, depth_m, owner = render(slabs, 0.001)
    instances = owners[owner].astype(np.uint16)
    if flying_px:
        window = np.ones((2 * flying_px + 1,) * 2, np.uint8)
        border = cv2.dilate(instances, window) != cv2.erode(instances, window)
        near, far = cv2.erode(depth_m, window), cv2.dilate(depth_m, window)
        part = np.random.default_rng(0).uniform(0, 1, SHAPE).astype(np.float32)
        depth_m = np.where(border, part * near + (1 - part) * far, depth_m)
    objects = segmented([name.split(":")[0] for name in names], instances, depth_m)
    found = GeometricRelationHead(predicates).relate(objects, top)
    assert found.logits.shape == (len(found.pairs), len(predicates))
    assert (found.logits >= geometric.FLOOR_LOGIT).all()
    assert (found.logits <= geometric.CEILING_LOGIT).all()
    # Specific relations come before general ones, each kind best first.
    best = [predicates[row.argmax()] for row in found.logits]
    general = np.array([predicate in ("near", "with") for predicate in best], bool)
    assert (np.diff(general.astype(int)) >= 0).all()
    for part in (general, ~general):
        assert (np.diff(found.scores[part]) <= 0).all()
    return {(names[s], names[o]): predicate for (s, o), predicate in zip(found.pairs, best)}


# Things; statements that are found; statements that are not.
SCENES = """
table, cup | cup on table | table on cup, table in cup, table under cup
table, cup, bowl | cup near bowl, bowl near cup, bowl on table |
table, cup, bowl:far | cup on table | cup * bowl:far
table, vase, plant | plant in vase, vase on table |
shelf, cabinet | shelf above cabinet, cabinet under shelf |
table:high, basket:low | basket:low under table:high, table:high above basket:low |
chair:by basket, basket | chair:by basket near basket, basket near chair:by basket |
cabinet:at wall, clock | clock above cabinet:at wall |
chair:at wall, clock | | clock * chair:at wall
table, chair | table with chair, chair near table |
cabinet:left, shelf:right | cabinet:left against shelf:right |
table, plate, cup:on plate | cup:on plate on plate, plate on table \
    | cup:on plate * table, plate * cup:on plate
table, screen | screen on table | table * screen
table, bottle, chair:by bottle | bottle on table, chair:by bottle * table \
    | bottle * chair:by bottle, chair:by bottle on table
table, book:0, book:1, book:2 | book:0 near book:1, book:1 near book:0, book:1 near book:2, \
    book:2 near book:1, book:0 on table, book:1 on table, book:2 on table | book:0 * book:2
table, phone:0, phone:1, phone:2, phone:3 | phone:0 near phone:1, phone:0 near phone:2 \
    | phone:0 near phone:3, phone:3 near phone:0
table, stand, cup:at edge, bowl:on stand | cup:at edge on table, bowl:on stand on stand \
    | cup:at edge * bowl:on stand
table, clock:lying, box | box on table | box on clock:lying
table, toothbrush | toothbrush on table |
"""


@pytest.mark.parametrize("scene", SCENES.strip().splitlines())
def test_relations_of_a_scene(scene):
    """Of equal objects the two nearest are near, if one support carries them."""
    things, true, false = (re.sub(" +", " ", part).strip() for part in scene.split("|"))
    found = [f"{s} {predicate} {o}" for (s, o), predicate in see(things).items()]
    for statement in filter(None, true.split(", ")):
        assert any(fnmatch(item, statement) for item in found), (statement, found)
    for statement in filter(None, false.split(", ")):
        assert not any(fnmatch(item, statement) for item in found), (statement, found)


def test_other_predicates_are_those_of_3dssg():
    assert see("table, cup", SCANNET_PREDICATES)["cup", "table"] == "supported by"
    for predicates in (REPLICA_SSG_PREDICATES, SCANNET_PREDICATES):
        assert see("window, curtain", predicates)["curtain", "window"] == "attached to"


@pytest.mark.parametrize("top", [0, 1, 2, 3, 4])
def test_the_best_relations_are_returned(top):
    best = ["on", "on", "near", "near"]
    assert list(see("table, cup, bowl", top=top).values()) == best[:top]


def test_flying_pixels_at_the_border_of_a_mask_do_not_change_the_relations():
    expected = see("table, bowl:right, cup")
    assert ("cup", "bowl:right") not in expected and expected["cup", "table"] == "on"
    assert see("table, bowl:right, cup", flying_px=2) == expected


def test_the_gap_of_turned_objects_below_a_camera_that_looks_down():
    # Two strips on the floor, at 45 degrees, seen from 2 m above: their boxes overlap.
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    across = (u - v - 40) / np.sqrt(2)
    instances = ((np.abs(across + 40) < 15) + 2 * (np.abs(across - 40) < 15)).astype(np.uint16)
    depth_m, up_camera = np.full(SHAPE, 2.0, np.float32), np.array([0.0, 0.0, -1.0])
    layout = measure_layout(depth_m, INTRINSICS, instances, 2, up_camera)
    assert layout.gap_m[0, 1] == pytest.approx((80 - 30) * 2.0 / INTRINSICS.fx, abs=0.03)
    assert layout.covered[0, 1] == layout.shared[0, 1] == 0


def test_objects_without_pixels_depth_or_partner_are_not_related():
    _, depth_m, owner = render([TABLE_TOP, CUP_ON_TABLE])
    head = GeometricRelationHead(REPLICA_SSG_PREDICATES)
    both = ["table", "cup"]
    blind = np.zeros_like(depth_m)
    for objects in (
        segmented(both, np.zeros(SHAPE), depth_m),
        segmented(both, owner, blind),
        segmented(["cup"], np.ones(SHAPE), np.ones(SHAPE, np.float32)),
    ):
        found = head.relate(objects, 10)
        assert found.pairs.shape == (0, 2) and found.logits.shape == (0, 50)
    # Predicates that geometry cannot judge get little probability.
    found = head.relate(segmented(both, owner, depth_m), 1)
    weights = np.exp(found.logits[0]) / np.exp(found.logits[0]).sum()
    assert weights[REPLICA_SSG_PREDICATES.index("on")] > 0.9
