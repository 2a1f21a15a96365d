"""The geometric relation head on rendered scenes with obvious relations."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.perception import (
    CUP_ON_TABLE,
    INTRINSICS,
    SHAPE,
    TABLE_LEG,
    TABLE_TOP,
    UP_CAMERA,
    Slab,
    render,
    segmented,
)

from deworldsg_ros.perception.backends.geometric import (
    CEILING_LOGIT,
    FLOOR_LOGIT,
    GeometricRelationHead,
    predicate_logits,
)
from deworldsg_ros.perception.backends.layout import measure_layout, upright_axes
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.vocabulary import REPLICA_SSG_PREDICATES, SCANNET_PREDICATES

SHELF = Slab((-0.5, 2.6, 0.75), (0.5, 2.95, 1.05), (90, 90, 100))
CHEST = Slab((-0.5, 2.5, 0.0), (0.5, 2.98, 0.4), (100, 60, 60))


def see(named, predicates=REPLICA_SSG_PREDICATES, top=100, flying_px=0):
    """Relations of named objects, each a list of slabs, as {(subject, object): predicate}.

    Pixels within `flying_px` of the border of a mask get a depth between those of both sides.
    """
    slabs = [slab for _, parts in named for slab in parts]
    _, depth_m, owner = render(slabs, 0.001)
    instances = np.zeros(SHAPE, np.uint16)
    first = 1
    for row, (_, parts) in enumerate(named):
        mask = (owner >= first) & (owner < first + len(parts))
        instances[mask] = row + 1
        first += len(parts)
    if flying_px:
        window = np.ones((2 * flying_px + 1,) * 2, np.uint8)
        border = cv2.dilate(instances, window) != cv2.erode(instances, window)
        near, far = cv2.erode(depth_m, window), cv2.dilate(depth_m, window)
        part = np.random.default_rng(0).uniform(0, 1, SHAPE).astype(np.float32)
        depth_m = np.where(border, part * near + (1 - part) * far, depth_m)
    head = GeometricRelationHead(predicates)
    general_in = [name for name in ("near", "with") if name in predicates]
    # "book 1" is a book.
    names = [name for name, _ in named]
    found = head.relate(segmented([name.split()[0] for name in names], instances, depth_m), top)
    assert found.logits.shape == (len(found.pairs), len(predicates))
    assert (found.logits >= FLOOR_LOGIT).all() and (found.logits <= CEILING_LOGIT).all()
    general = np.isin(found.logits.argmax(axis=1), [predicates.index(p) for p in general_in])
    for part in (general, ~general):
        assert (np.diff(found.scores[part]) <= 0).all()
    assert (np.diff(general.astype(int)) >= 0).all()
    return {
        (names[s], names[o]): predicates[row.argmax()]
        for (s, o), row in zip(found.pairs, found.logits)
    }


TABLE = ("table", [TABLE_TOP, TABLE_LEG])
CUP = ("cup", [CUP_ON_TABLE])


def test_a_cup_on_a_table():
    related = see([TABLE, CUP])
    assert related["cup", "table"] == "on"
    assert related.get(("table", "cup")) not in {"on", "in", "under"}


def test_a_cup_on_a_table_with_the_predicates_of_3dssg():
    assert see([TABLE, CUP], SCANNET_PREDICATES)["cup", "table"] == "supported by"


def test_two_cups_side_by_side_are_near_each_other():
    other = ("bowl", [Slab((-0.05, 1.6, 0.70), (0.08, 1.73, 0.80), (40, 120, 60))])
    related = see([TABLE, CUP, other])
    assert related["cup", "bowl"] == related["bowl", "cup"] == "near"
    assert related["bowl", "table"] == "on"


def test_small_objects_far_apart_are_not_related():
    other = ("bowl", [Slab((0.35, 1.6, 0.70), (0.48, 1.73, 0.80), (40, 120, 60))])
    related = see([TABLE, CUP, other])
    assert ("cup", "bowl") not in related


def test_a_plant_in_a_vase():
    vase = ("vase", [Slab((-0.1, 1.6, 0.70), (0.05, 1.75, 0.9), (200, 200, 40))])
    plant = ("plant", [Slab((-0.15, 1.58, 0.9), (0.1, 1.77, 1.1), (30, 140, 30))])
    related = see([TABLE, vase, plant])
    assert related["plant", "vase"] == "in"
    assert related["vase", "table"] == "on"


def test_a_wall_shelf_above_a_chest():
    related = see([("shelf", [SHELF]), ("cabinet", [CHEST])])
    assert related["shelf", "cabinet"] == "above"
    assert related["cabinet", "shelf"] == "under"


def test_a_basket_on_the_floor_under_a_table():
    basket = ("basket", [Slab((-0.5, 1.55, 0.0), (-0.2, 1.85, 0.25), (160, 120, 40))])
    high_top = Slab((-0.6, 1.5, 0.95), (0.6, 2.2, 1.0), (120, 70, 40))
    leg = Slab((0.4, 1.7, 0.0), (0.5, 1.8, 0.95), (120, 70, 40))
    related = see([("table", [high_top, leg]), basket])
    assert related["basket", "table"] == "under" and related["table", "basket"] == "above"


def test_a_basket_beside_a_chair_on_the_floor():
    chair = ("chair", [Slab((0.3, 1.9, 0.0), (0.75, 2.35, 0.8), (30, 60, 120))])
    basket = ("basket", [Slab((-0.1, 1.95, 0.0), (0.15, 2.2, 0.25), (160, 120, 40))])
    related = see([chair, basket])
    assert related["basket", "chair"] == related["chair", "basket"] == "near"


def test_a_clock_on_the_wall_above_a_chest():
    chest = ("cabinet", [Slab((-0.5, 3.6, 0.0), (0.5, 4.0, 0.5), (100, 60, 60))])
    clock = ("clock", [Slab((-0.15, 3.95, 0.7), (0.15, 4.0, 0.9), (200, 200, 40))])
    chair = ("chair", [Slab((-0.5, 3.6, 0.0), (0.5, 4.0, 0.5), (100, 60, 60))])
    assert see([chest, clock])["clock", "cabinet"] == "above"
    assert ("clock", "chair") not in see([chair, clock])


def test_the_gap_of_turned_objects():
    # Two strips on the floor, at 45 degrees, seen from 2 m above: their boxes overlap.
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    across = (u - v - 40) / np.sqrt(2)
    instances = (np.abs(across + 40) < 15) + 2 * (np.abs(across - 40) < 15)
    layout = measure_layout(
        np.full(SHAPE, 2.0, np.float32),
        INTRINSICS,
        instances.astype(np.uint16),
        2,
        np.array([0.0, 0.0, -1.0]),
    )
    assert layout.gap_m[0, 1] == pytest.approx((80 - 30) * 2.0 / INTRINSICS.fx, abs=0.03)
    assert layout.covered[0, 1] == layout.shared[0, 1] == 0


def test_a_table_with_its_chair():
    chair = ("chair", [Slab((0.75, 1.5, 0.0), (1.2, 1.95, 0.9), (30, 60, 120))])
    related = see([TABLE, chair])
    assert related["table", "chair"] == "with"
    assert related["chair", "table"] == "near"


def test_furniture_side_by_side():
    low = ("cabinet", [Slab((-0.9, 2.6, 0.0), (-0.1, 3.1, 0.6), (30, 60, 120))])
    high = ("shelf", [Slab((-0.08, 2.6, 0.0), (0.7, 3.1, 0.95), (120, 60, 30))])
    related = see([low, high])
    assert related["cabinet", "shelf"] == "against"


def test_a_window_has_a_curtain_attached():
    window = ("window", [Slab((-0.5, 3.98, 0.7), (0.3, 4.0, 1.4), (90, 160, 220))])
    curtain = ("curtain", [Slab((0.32, 3.9, 0.4), (0.6, 3.98, 1.5), (30, 120, 60))])
    assert see([window, curtain])["curtain", "window"] == "attached to"
    assert see([window, curtain], SCANNET_PREDICATES)["curtain", "window"] == "attached to"


@pytest.mark.parametrize("top", [0, 1, 3])
def test_at_most_max_relations_are_returned(top):
    other = ("bowl", [Slab((-0.05, 1.6, 0.70), (0.08, 1.73, 0.80), (40, 120, 60))])
    assert len(see([TABLE, CUP, other], top=top)) == top


PLATE = ("plate", [Slab((-0.12, 1.6, 0.70), (0.12, 1.84, 0.72), (220, 220, 220))])


def test_a_cup_on_a_plate_is_not_on_the_table_below():
    cup = ("cup", [Slab((-0.05, 1.68, 0.72), (0.05, 1.78, 0.84), (200, 40, 40))])
    related = see([TABLE, PLATE, cup])
    assert related["cup", "plate"] == "on" and related["plate", "table"] == "on"
    assert ("cup", "table") not in related and ("plate", "cup") not in related


def test_a_screen_on_a_table_is_not_above_it():
    screen = ("screen", [Slab((-0.3, 1.9, 0.70), (0.3, 1.95, 1.1), (30, 30, 30))])
    related = see([TABLE, screen])
    assert related["screen", "table"] == "on" and ("table", "screen") not in related


def test_a_bottle_on_a_table_is_not_on_the_chair_beside_it():
    bottle = ("bottle", [Slab((0.5, 1.5, 0.70), (0.57, 1.57, 0.95), (30, 120, 30))])
    # Its back rises past the table top, close to the bottle.
    chair = ("chair", [Slab((0.62, 1.45, 0.0), (0.68, 1.8, 1.0), (30, 60, 120))])
    related = see([TABLE, bottle, chair])
    assert related["bottle", "table"] == "on"
    assert ("bottle", "chair") not in related and ("chair", "table") in related
    assert related["chair", "table"] != "on"


def test_books_side_by_side_do_not_rest_on_each_other():
    books = [
        (f"book {k}", [Slab((x, 1.6, 0.70), (x + 0.05, 1.75, z), (90, 60 + 60 * k, 40))])
        for k, (x, z) in enumerate([(-0.1, 0.95), (-0.05, 0.90), (0.0, 0.93)])
    ]
    related = see([TABLE, *books])
    for first, second in ((0, 1), (1, 2)):
        pair = f"book {first}", f"book {second}"
        assert related[pair] == related[pair[::-1]] == "near"
    # The second one stands between the others.
    assert ("book 0", "book 2") not in related
    assert all(related[f"book {k}", "table"] == "on" for k in range(3))


def test_an_object_is_near_its_two_nearest_only():
    places = [(0.0, 1.7), (0.12, 1.7), (-0.13, 1.7), (0.0, 1.54)]
    phones = [
        (f"phone {k}", [Slab((x, y, 0.70), (x + 0.07, y + 0.07, 0.72), (200, 40 * k, 40))])
        for k, (x, y) in enumerate(places)
    ]
    related = see([TABLE, *phones])
    near = {pair for pair, name in related.items() if name == "near"}
    assert {("phone 0", "phone 1"), ("phone 0", "phone 2")} <= near
    assert not {("phone 0", "phone 3"), ("phone 3", "phone 0")} & near


def test_objects_on_two_supports_are_not_near():
    stool = ("stand", [Slab((0.62, 1.6, 0.0), (0.9, 1.9, 0.70), (60, 60, 60))])
    cup = ("cup", [Slab((0.5, 1.6, 0.70), (0.57, 1.67, 0.80), (200, 40, 40))])
    bowl = ("bowl", [Slab((0.64, 1.62, 0.70), (0.74, 1.72, 0.80), (40, 40, 200))])
    related = see([TABLE, stool, cup, bowl])
    assert related["cup", "table"] == "on" and related["bowl", "stand"] == "on"
    assert ("cup", "bowl") not in related


@pytest.mark.parametrize(
    ("changed", "on"),
    [
        # The top of the support is hidden: only the bottom edge shows it.
        ({"contact_m": np.inf, "covered": 0.0}, True),
        # Another surface is beneath the edge: the contact is a coincidence.
        ({"beneath": 0.0}, False),
        # The bottom edge is hidden: only the contact shows it.
        ({"beneath": np.nan}, True),
    ],
)
def test_a_support_is_known_from_the_contact_or_from_the_bottom_edge(changed, on):
    _, depth_m, owner = render([TABLE_TOP, CUP_ON_TABLE])
    layout = measure_layout(depth_m, INTRINSICS, owner.astype(np.uint16), 2, UP_CAMERA)
    fields = {name: np.full((2, 2), value) for name, value in changed.items()}
    logits = predicate_logits(replace(layout, **fields), ["table", "cup"])["on"]
    assert (logits[1, 0] > 0) == on


def test_a_box_behind_a_clock_does_not_stand_on_it():
    clock = ("clock", [Slab((-0.1, 1.55, 0.70), (0.1, 1.6, 0.73), (200, 200, 40))])
    box = ("box", [Slab((-0.08, 1.62, 0.70), (0.08, 1.7, 0.9), (40, 60, 160))])
    related = see([TABLE, clock, box])
    assert related["box", "table"] == "on" and related.get(("box", "clock")) != "on"


def test_specific_relations_come_before_general_ones():
    other = ("bowl", [Slab((-0.05, 1.6, 0.70), (0.08, 1.73, 0.80), (40, 120, 60))])
    assert list(see([TABLE, CUP, other]).values()) == ["on", "on", "near", "near"]
    assert set(see([TABLE, CUP, other], top=2).values()) == {"on"}


@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
def test_relations_do_not_depend_on_the_roll_of_the_camera(quarter_turns):
    _, depth_m, owner = render([TABLE_TOP, CUP_ON_TABLE])
    side = SHAPE[1]
    # A square image has the same intrinsics after a rotation.
    intrinsics = Intrinsics(262.5, 262.5, (side - 1) / 2, (side - 1) / 2, side, side)
    margin = ((side - SHAPE[0]) // 2,) * 2, (0, 0)
    depth_m, owner = np.pad(depth_m, margin), np.pad(owner, margin).astype(np.uint16)
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    layouts = [
        measure_layout(
            np.ascontiguousarray(np.rot90(depth_m, k)),
            intrinsics,
            np.ascontiguousarray(np.rot90(owner, k)),
            2,
            np.linalg.matrix_power(turn, k) @ UP_CAMERA,
        )
        for k in (0, quarter_turns)
    ]
    expected, found = (predicate_logits(item, ["table", "cup"])["on"] for item in layouts)
    assert layouts[0].beneath[1, 0] > 0.9
    assert np.allclose(layouts[0].beneath, layouts[1].beneath, atol=0.1, equal_nan=True)
    assert found[1, 0] > 0 and found == pytest.approx(expected, abs=0.5)


def test_the_surface_beneath_is_unknown_if_the_bottom_is_hidden():
    front = Slab((-0.4, 1.2, 0.70), (0.1, 1.25, 0.98), (90, 90, 90))
    _, depth_m, owner = render([TABLE_TOP, CUP_ON_TABLE, front])
    layout = measure_layout(depth_m, INTRINSICS, owner.astype(np.uint16), 3, UP_CAMERA)
    assert np.isnan(layout.beneath[1]).all()
    assert not np.isnan(layout.beneath[2]).any()


def test_objects_without_pixels_or_depth_are_not_related():
    _, depth_m, owner = render([TABLE_TOP, CUP_ON_TABLE])
    head = GeometricRelationHead(REPLICA_SSG_PREDICATES)
    for instances, depth in ((np.zeros(SHAPE), depth_m), (owner, np.zeros_like(depth_m))):
        found = head.relate(segmented(["table", "cup"], instances, depth), 10)
        assert len(found.pairs) == 0


def test_flying_pixels_at_the_border_of_a_mask_do_not_change_the_relations():
    named = [TABLE, ("bowl", [Slab((0.2, 1.6, 0.70), (0.33, 1.73, 0.80), (40, 120, 60))]), CUP]
    expected = see(named)
    assert ("cup", "bowl") not in expected and expected["cup", "table"] == "on"
    assert see(named, flying_px=2) == expected


def test_a_thin_object_is_read_from_all_of_its_pixels():
    rod = ("toothbrush", [Slab((-0.25, 1.6, 0.70), (-0.24, 1.61, 0.90), (200, 40, 40))])
    assert see([TABLE, rod])["toothbrush", "table"] == "on"


def test_one_object_has_no_relation():
    head = GeometricRelationHead(SCANNET_PREDICATES)
    found = head.relate(segmented(["cup"], np.ones(SHAPE), np.ones(SHAPE, np.float32)), 10)
    assert found.pairs.shape == (0, 2) and found.logits.shape == (0, 7)


def test_predicates_that_geometry_cannot_judge_get_little_probability():
    _, depth_m, owner = render([TABLE_TOP, CUP_ON_TABLE])
    head = GeometricRelationHead(REPLICA_SSG_PREDICATES)
    found = head.relate(segmented(["table", "cup"], owner, depth_m), 1)
    weights = np.exp(found.logits[0]) / np.exp(found.logits[0]).sum()
    assert weights[REPLICA_SSG_PREDICATES.index("on")] > 0.9


@pytest.mark.parametrize("up", [[0, -1, 0], [0, 0, 1], [0, 0, -1], [0.6, -0.8, 0], [1, 0, 0]])
def test_upright_axes_are_a_rotation_whose_third_axis_is_up(up):
    axes = upright_axes(np.array(up, dtype=float))
    assert np.allclose(axes @ axes.T, np.eye(3)) and np.isclose(np.linalg.det(axes), 1)
    assert np.allclose(axes @ np.array(up), [0, 0, 1])
