"""The RGB-D segmenter on rendered scenes with known masks."""

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

from deworldsg_ros.perception.backends import rgbd
from deworldsg_ros.perception.backends.regions import adjacency
from deworldsg_ros.perception.backends.rgbd import RgbdSegmenter, upsample_labels

CHEST = Slab((-0.3, 1.6, 0), (0.3, 2.1, 0.5), (60, 90, 160))
PICTURE = Slab((-0.4, 3.999, 0.5), (0.4, 4.0, 1.1), (20, 60, 90))
TIN = Slab((0.1, 1.7, 0.7), (0.25, 1.85, 0.8), (40, 120, 60))


def segment(rgb, depth_m, boxes):
    return RgbdSegmenter().segment(
        rgb, depth_m, INTRINSICS, np.reshape(boxes, (-1, 4)).astype(float)
    )


def images_of(rgb, depth_m, boxes):
    return [on_image(mask, SHAPE) for mask in segment(rgb, depth_m, boxes)]


@pytest.mark.parametrize(
    ("slabs", "noise_m", "truth", "least"),
    [
        ([CHEST], 0.0, {1}, 0.85),
        ([CHEST], 0.004, {1}, 0.85),
        # A planar table is an object; the mask of the cup excludes the table.
        ([TABLE_TOP], 0.002, {1}, 0.85),
        ([TABLE_TOP, TABLE_LEG, CUP_ON_TABLE], 0.002, {3}, 0.85),
        # Depth does not separate a picture from its wall: colour does.
        ([PICTURE], 0.003, {1}, 0.8),
    ],
)
def test_one_object(slabs, noise_m, truth, least):
    rgb, depth_m, owner = render(slabs, noise_m)
    wanted = np.isin(owner, list(truth))
    (mask,) = segment(rgb, depth_m, box_of(wanted))
    assert overlap(mask, wanted) > least


@pytest.mark.parametrize("invalid", [0.0, np.nan, np.inf, -1.0])
def test_colour_or_depth_alone_separates_an_object_from_the_floor(invalid):
    rgb, depth_m, owner = render([CHEST], 0.002)
    (mask,) = segment(rgb, np.full_like(depth_m, invalid), box_of(owner == 1))
    assert overlap(mask, owner == 1) > 0.7
    (mask,) = segment(np.full_like(rgb, 150), depth_m, box_of(owner == 1))
    assert overlap(mask, owner == 1) > 0.7


def test_what_is_seen_through_an_object_is_not_its_own():
    legs = [
        Slab((x, y, 0), (x + 0.05, y + 0.05, 0.45), (110, 70, 40))
        for x in (-0.3, 0.25)
        for y in (1.6, 2.05)
    ]
    stool = [Slab((-0.3, 1.6, 0.45), (0.3, 2.1, 0.5), (110, 70, 40)), *legs]
    rgb, depth_m, owner = render(stool, 0.003)
    (mask,) = segment(rgb, depth_m, box_of(owner > 0))
    beyond = on_image(mask, SHAPE) & (owner == 0)
    assert overlap(mask, owner > 0) > 0.8
    assert beyond.sum() < 0.1 * (owner > 0).sum()


RUG = Slab((-0.5, 0.9, 0.0), (0.5, 1.7, 0.004), (60, 40, 30))
FOOT = Slab((-0.1, 1.2, 0.0), (0.1, 1.4, 0.4), (110, 70, 40))
BOARD = Slab((-0.6, 1.1, 0.4), (0.6, 1.7, 0.44), (110, 70, 40))


@pytest.mark.parametrize("noise_m", [0.0, 0.004])
def test_an_object_that_rises_from_the_floor_contains_no_part_of_it(monkeypatch, noise_m):
    monkeypatch.setattr(rgbd, "KEPT_BELIEF", 0.0)  # all regions in the box are believed
    rgb, depth_m, owner = render([RUG, FOOT, BOARD], noise_m)
    table = owner >= 2
    (mask,) = segment(rgb, depth_m, box_of(table))
    assert overlap(mask, table) > 0.88


def test_a_rug_in_its_own_box_stays():
    rgb, depth_m, owner = render([RUG], 0.002)
    (mask,) = segment(rgb, depth_m, box_of(owner == 1))
    assert overlap(mask, owner == 1) > 0.8


@pytest.mark.parametrize("fraction", [0.1, 0.3])
def test_holes_in_the_depth_are_filled(fraction):
    rgb, depth_m, owner = render([CHEST], 0.002)
    holes = np.random.default_rng(1).random(SHAPE) < fraction
    box = box_of(owner == 1).astype(int)
    # And one large hole in the object's face.
    x, y = (box[0] + box[2]) // 2, (box[1] + box[3]) // 2
    holes[y - 12 : y + 12, x - 12 : x + 12] = True
    depth_m[holes] = 0
    (mask,) = segment(rgb, depth_m, box)
    assert overlap(mask, owner == 1) > 0.75
    assert on_image(mask, SHAPE)[y, x]


def test_masks_are_disjoint_deterministic_and_in_the_order_of_the_boxes():
    rgb, depth_m, owner = render([TABLE_TOP, CUP_ON_TABLE, TIN], 0.003)
    boxes = np.stack([box_of(owner == k) for k in (1, 2, 3)])
    boxes[0] = box_of(owner > 0)
    before = rgb.copy(), depth_m.copy(), boxes.copy()
    masks = images_of(rgb, depth_m, boxes)
    assert np.sum(masks, axis=0).max() == 1
    for k, mask in enumerate(masks, start=1):
        assert (mask & (owner == k)).sum() / (mask | (owner == k)).sum() > 0.8
    assert np.array_equal(images_of(rgb, depth_m, boxes[[2, 0, 1]]), [masks[k] for k in (2, 0, 1)])
    assert all(np.array_equal(a, b) for a, b in zip(before, (rgb, depth_m, boxes)))
    # Read-only and sliced images use the same compiled kernel.
    from_message = np.frombuffer(rgb.tobytes(), np.uint8).reshape(rgb.shape)
    from_slice = np.repeat(depth_m, 2, axis=1)[:, ::2]
    assert np.array_equal(images_of(from_message, from_slice, boxes), masks)
    assert len(upsample_labels.signatures) == 1
    assert segment(rgb, depth_m, []) == []


@pytest.mark.parametrize(
    "box",
    [
        *([-50, -50, -10, -10], [400, 300, 500, 400], [-20, 100, -1, 200]),
        *([319, 239, 319, 239], [-30, -30, 500, 400], [100, 100, 100.2, 100.2]),
    ],
)
def test_boxes_at_and_beyond_the_border(box):
    rgb, depth_m, _ = render([TABLE_TOP], 0.002)
    (image,) = images_of(rgb, depth_m, box)
    if image.any():
        x1, y1, x2, y2 = box_of(image)
        assert round(box[0]) <= x1 and x2 <= round(box[2])
        assert round(box[1]) <= y1 and y2 <= round(box[3])


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
        cost = (r * r + g * g + w * w) / f(rgbd.COLOUR_STEP * rgbd.COLOUR_STEP)
        if 0 < z < np.inf and cell_depth[b, a] > 0:
            d = (z - cell_depth[b, a]) / (f(rgbd.DEPTH_STEP) * z)
            cost += min(d * d, f(rgbd.MAX_DEPTH_COST))
        d = f(y - b * stride - stride // 2) / f(stride)
        e = f(x - a * stride - stride // 2) / f(stride)
        costs.append(cost + f(rgbd.DISTANCE_WEIGHT) * (d * d + e * e))
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
    coarse = labels, cell_rgb, cell_depth
    for y, x in np.ndindex(shape):
        expected = plain_label(*coarse, rgb[y, x], depth_m[y, x], y, x, stride)
        assert found[y, x] == expected


def test_adjacency_equals_the_plain_loop():
    rng = np.random.default_rng(1)
    labels = rng.integers(0, 7, (9, 13)).astype(np.int32)
    weights = rng.uniform(0, 3, (2, 9, 13)).astype(np.float32)
    borders = {}
    for y, x in np.ndindex(9, 13):
        for direction, (v, u) in enumerate([(y, x + 1), (y + 1, x)]):
            if v < 9 and u < 13 and labels[y, x] != labels[v, u]:
                pair = tuple(sorted((int(labels[y, x]), int(labels[v, u]))))
                borders.setdefault(pair, []).append(float(weights[direction, y, x]))
    pairs, strength, length = adjacency(labels, 7, weights)
    assert [tuple(pair) for pair in pairs.tolist()] == sorted(borders)
    assert strength.tolist() == [sum(borders[p]) / len(borders[p]) for p in sorted(borders)]
    assert length.tolist() == [len(borders[p]) for p in sorted(borders)]
