"""The RGB-D segmenter on rendered scenes with known masks."""

from __future__ import annotations

import numpy as np
import pytest
from support.perception import (
    CUP_ON_TABLE,
    INTRINSICS,
    SHAPE,
    TABLE_LEG,
    TABLE_TOP,
    Slab,
    box_of,
    on_image,
    overlap,
    render,
)

from deworldsg_ros.perception.backends.regions import adjacency
from deworldsg_ros.perception.backends.rgbd import (
    COLOUR_STEP,
    DEPTH_STEP,
    DISTANCE_WEIGHT,
    MAX_DEPTH_COST,
    RgbdSegmenter,
    upsample_labels,
)

SEGMENTER = RgbdSegmenter()


def segment(rgb, depth_m, boxes):
    return SEGMENTER.segment(rgb, depth_m, INTRINSICS, np.asarray(boxes, dtype=float))


def test_no_boxes():
    rgb, depth_m, _ = render([])
    assert segment(rgb, depth_m, np.zeros((0, 4))) == []


@pytest.mark.parametrize("noise_m", [0.0, 0.004])
def test_a_box_on_the_floor(noise_m):
    rgb, depth_m, owner = render([Slab((-0.3, 1.6, 0), (0.3, 2.1, 0.5), (60, 90, 160))], noise_m)
    (mask,) = segment(rgb, depth_m, [box_of(owner == 1)])
    assert overlap(mask, owner == 1) > 0.85


def test_a_box_of_the_floors_colour_is_segmented_by_its_depth():
    rgb, depth_m, owner = render([Slab((-0.3, 1.6, 0), (0.3, 2.1, 0.5), (150, 140, 130))], 0.002)
    rgb[:] = (150, 140, 130)
    (mask,) = segment(rgb, depth_m, [box_of(owner == 1)])
    assert overlap(mask, owner == 1) > 0.8


def test_the_masks_of_a_cup_and_its_table_are_separate():
    rgb, depth_m, owner = render([TABLE_TOP, TABLE_LEG, CUP_ON_TABLE], 0.002)
    table = (owner == 1) | (owner == 2)
    cup = owner == 3
    table_box = box_of(table | cup)
    masks = segment(rgb, depth_m, [table_box, box_of(cup)])
    assert overlap(masks[1], cup) > 0.85
    assert overlap(masks[0], table) > 0.85
    assert not (on_image(masks[0], SHAPE) & on_image(masks[1], SHAPE)).any()


def test_a_box_of_the_cup_alone_excludes_the_table():
    rgb, depth_m, owner = render([TABLE_TOP, TABLE_LEG, CUP_ON_TABLE], 0.002)
    (mask,) = segment(rgb, depth_m, [box_of(owner == 3)])
    assert overlap(mask, owner == 3) > 0.85


def test_a_planar_table_is_an_object():
    rgb, depth_m, owner = render([TABLE_TOP], 0.002)
    (mask,) = segment(rgb, depth_m, [box_of(owner == 1)])
    assert overlap(mask, owner == 1) > 0.85


def test_a_picture_on_the_wall_is_segmented_by_its_colour():
    rgb, depth_m, owner = render([Slab((-0.4, 3.999, 0.5), (0.4, 4.0, 1.1), (20, 60, 90))], 0.003)
    (mask,) = segment(rgb, depth_m, [box_of(owner == 1)])
    assert overlap(mask, owner == 1) > 0.8


@pytest.mark.parametrize("fraction", [0.1, 0.3])
def test_holes_in_the_depth_are_filled(fraction):
    rgb, depth_m, owner = render([Slab((-0.3, 1.6, 0), (0.3, 2.1, 0.5), (60, 90, 160))], 0.002)
    holes = np.random.default_rng(1).random(SHAPE) < fraction
    box = box_of(owner == 1).astype(int)
    # And one large hole in the object's face.
    x, y = (box[0] + box[2]) // 2, (box[1] + box[3]) // 2
    holes[y - 12 : y + 12, x - 12 : x + 12] = True
    depth_m[holes] = 0
    (mask,) = segment(rgb, depth_m, [box_of(owner == 1)])
    assert overlap(mask, owner == 1) > 0.75
    assert on_image(mask, SHAPE)[y, x]


@pytest.mark.parametrize("invalid", [0.0, np.nan, np.inf, -1.0])
def test_without_valid_depth_colour_is_used(invalid):
    rgb, depth_m, owner = render([Slab((-0.3, 1.6, 0), (0.3, 2.1, 0.5), (60, 90, 160))])
    (mask,) = segment(rgb, np.full_like(depth_m, invalid), [box_of(owner == 1)])
    assert overlap(mask, owner == 1) > 0.7


@pytest.mark.parametrize(
    "box",
    [
        [-50, -50, -10, -10],
        [400, 300, 500, 400],
        [-20, 100, -1, 200],
        [319, 239, 319, 239],
        [-30, -30, 500, 400],
        [100, 100, 100.2, 100.2],
    ],
)
def test_boxes_at_and_beyond_the_border(box):
    rgb, depth_m, _ = render([TABLE_TOP], 0.002)
    (mask,) = segment(rgb, depth_m, [box])
    image = on_image(mask, SHAPE)
    rows, columns = np.nonzero(image)
    if len(rows):
        assert columns.min() >= round(box[0]) and columns.max() <= round(box[2])
        assert rows.min() >= round(box[1]) and rows.max() <= round(box[3])


def test_masks_are_disjoint_and_in_the_order_of_the_boxes():
    slabs = [TABLE_TOP, CUP_ON_TABLE, Slab((0.1, 1.7, 0.7), (0.25, 1.85, 0.8), (40, 120, 60))]
    rgb, depth_m, owner = render(slabs, 0.003)
    boxes = np.stack([box_of(owner == k) for k in (1, 2, 3)])
    masks = segment(rgb, depth_m, boxes)
    assert sum(on_image(m, SHAPE).astype(int) for m in masks).max() == 1
    order = [2, 0, 1]
    shuffled = segment(rgb, depth_m, boxes[order])
    for position, row in enumerate(order):
        assert np.array_equal(on_image(shuffled[position], SHAPE), on_image(masks[row], SHAPE))


def test_segmentation_is_deterministic_and_keeps_its_input():
    rgb, depth_m, owner = render([TABLE_TOP, CUP_ON_TABLE], 0.003)
    boxes = np.stack([box_of(owner == k) for k in (1, 2)])
    before = rgb.copy(), depth_m.copy(), boxes.copy()
    first, second = segment(rgb, depth_m, boxes), segment(rgb, depth_m, boxes)
    assert all(np.array_equal(a.pixels, b.pixels) for a, b in zip(first, second))
    assert all(np.array_equal(a, b) for a, b in zip(before, (rgb, depth_m, boxes)))


def test_a_narrow_image():
    rgb, depth_m, _ = render([TABLE_TOP])
    patches = SEGMENTER.segment(
        rgb[:100, :90], depth_m[:100, :90], INTRINSICS, np.array([[5.0, 5, 80, 90]])
    )
    assert patches[0].pixels.shape == (86, 76)


def test_read_only_and_sliced_images_use_the_same_compiled_kernel():
    rgb, depth_m, owner = render([TABLE_TOP], 0.002)
    box = [box_of(owner == 1)]
    compiled = len(upsample_labels.signatures)
    (expected,) = segment(rgb, depth_m, box)
    from_message = np.frombuffer(rgb.tobytes(), np.uint8).reshape(rgb.shape)
    from_slice = np.repeat(depth_m, 2, axis=1)[:, ::2]
    (found,) = segment(from_message, from_slice, box)
    assert np.array_equal(found.pixels, expected.pixels)
    assert len(upsample_labels.signatures) == compiled == 1


def plain_label(labels, cell_rgb, cell_depth, rgb, z, y, x, stride):
    """The label of a pixel: of its own cell and those beside it, the first with the least cost."""
    rows, columns = labels.shape
    v, u = min(y // stride, rows - 1), min(x // stride, columns - 1)
    costs, found = [], []
    f = np.float32
    for dv, du in ((-1, 0), (0, -1), (0, 0), (0, 1), (1, 0)):
        b, a = v + dv, u + du
        if not (0 <= b < rows and 0 <= a < columns):
            continue
        r, g, w = rgb.astype(f) - cell_rgb[b, a].astype(f)
        cost = (r * r + g * g + w * w) / f(COLOUR_STEP * COLOUR_STEP)
        if 0 < z < np.inf and cell_depth[b, a] > 0:
            d = (z - cell_depth[b, a]) / (f(DEPTH_STEP) * z)
            cost += min(d * d, f(MAX_DEPTH_COST))
        d = f(y - b * stride - stride // 2) / f(stride)
        e = f(x - a * stride - stride // 2) / f(stride)
        costs.append(cost + f(DISTANCE_WEIGHT) * (d * d + e * e))
        found.append(labels[b, a])
    return found[int(np.argmin(costs))]


@pytest.mark.parametrize("shape", [(20, 31), (8, 8), (12, 15)])
@pytest.mark.parametrize("stride", [1, 2, 3, 5])
@pytest.mark.parametrize("levels", [2, 200])  # few levels give equal costs
def test_pixels_take_the_label_of_the_most_similar_cell(shape, stride, levels):
    rng = np.random.default_rng(len(shape) + stride + levels)
    cells = (shape[0] // stride, shape[1] // stride)
    step = 200 // levels
    cell_rgb = (rng.integers(0, levels, (*cells, 3)) * step).astype(np.uint8)
    rgb = (rng.integers(0, levels, (*shape, 3)) * step).astype(np.uint8)
    depths = np.array([0.0, 1.0, 1.01, 1.02, 2.0, np.nan, np.inf], np.float32)
    depth_m = rng.choice(depths, shape)
    cell_depth = rng.choice(depths[:5], cells)
    labels = rng.integers(-1, 3, cells).astype(np.int32)
    found = upsample_labels(labels, cell_rgb, cell_depth, rgb, depth_m, stride)
    expected = [
        [
            plain_label(labels, cell_rgb, cell_depth, rgb[y, x], depth_m[y, x], y, x, stride)
            for x in range(shape[1])
        ]
        for y in range(shape[0])
    ]
    assert np.array_equal(found, expected)


def test_adjacency_equals_the_plain_loop():
    rng = np.random.default_rng(1)
    labels = rng.integers(0, 7, (9, 13)).astype(np.int32)
    weights = rng.uniform(0, 3, (2, 9, 13)).astype(np.float32)
    borders: dict[tuple[int, int], list[float]] = {}
    for y, x in np.ndindex(9, 13):
        for direction, (v, u) in enumerate([(y, x + 1), (y + 1, x)]):
            if v < 9 and u < 13 and labels[y, x] != labels[v, u]:
                pair = tuple(sorted((int(labels[y, x]), int(labels[v, u]))))
                borders.setdefault(pair, []).append(float(weights[direction, y, x]))
    pairs, strength = adjacency(labels, 7, weights)
    assert [tuple(pair) for pair in pairs.tolist()] == sorted(borders)
    assert strength.tolist() == [sum(borders[p]) / len(borders[p]) for p in sorted(borders)]
