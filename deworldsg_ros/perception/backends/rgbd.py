"""Segmenter for RGB-D images without a network: regions inside each box, at the image's size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deworldsg_ros.base.kernels import kernel, read_only
from deworldsg_ros.perception.backends.regions import Regions, find_regions, reduce_frame
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int16, Int32, Int64, UInt8
from deworldsg_ros.scene.camera import Intrinsics, MaskPatch

# --- The regions inside each box that belong to its object.
#
# The background starts with the regions that lie mostly outside the box. It spreads inwards over
# the borders between regions, and to regions that continue one of its planes: the floor under a
# chair, the table under a cup. The distance of a region, the cost of this path, gives the first
# belief that the region is the object's. Three rounds of logistic regression refine the beliefs:
# how unlike the background the region is, and how like the regions that are believed so far (their
# colours, their depths, the borders with them).
#
# The constants are the same for every object and scene. The weights were fitted to simulated rooms
# (tools/calibration/fit_segmenter.py), the others chosen on every 16th frame of two rendered rooms,
# and both tested on the rendered rooms (bench/segmenter_iou.py). Colours are CIE Lab, 8-bit scale.

# A region can belong to the object if more than this fraction of its cells is inside the box.
INSIDE_FRACTION = 0.8
# Error of an edge of the box: cells, and a fraction of the side. A box that is too small cuts off
# a strip of its object; regions in this strip are neither object nor background.
SLACK_CELLS = 1.0
SLACK_FRACTION = 0.04
# Exponent of the strength of a border. Below 1, a strong border costs less than many weak ones.
STRENGTH_POWER = 0.6

# Cost of a step from the background to a region that continues its plane.
PLANE_COST = 2.0
# Difference of colour that costs 1 in that step.
PLANE_COLOUR = 12.0
# Weights of the squared offset from the plane, in standard deviations, and of 1 - cos of the angle.
PLANE_OFFSET_WEIGHT = 0.3
PLANE_ANGLE_WEIGHT = 5.0
# Regions with a larger offset from the plane do not continue it, in standard deviations.
PLANE_MAX_OFFSET = 3.0
# Standard deviation of a region's mean depth: a constant, and a part that grows with depth squared.
PLANE_NOISE_M = 0.008
PLANE_NOISE_PER_M2 = 0.002
# A plane is fitted to at least this many cells, with at least this flatness.
PLANE_MIN_CELLS = 12.0
PLANE_MIN_FLATNESS = 0.9
# A region needs this many cells with depth to be compared with a plane.
POINT_MIN_CELLS = 3

# Larger distances and plane costs all count as these.
MAX_DISTANCE = 5.0
MAX_PLANE_COST = 8.0
# A difference of colour that counts 1 as evidence, and the largest ones that count.
EVIDENCE_COLOUR = 10.0
MAX_NEAREST_COLOUR = 4.0
MAX_MEAN_COLOUR = 6.0
# Cells of a border with an unknown region, which every region has.
UNKNOWN_BORDER = 0.3
# A region touches a side of the box that is at most this fraction of the box's side away.
TOUCHING_FRACTION = 0.04
# The colours of the object come from its COLOURS largest regions with at least this belief.
COLOURS = 16
COLOUR_BELIEF = 0.6
# The object's depths are between these fractions of its cells, ordered by depth. Differences
# are divided by the middle one, and larger ones count as MAX_DEPTH_DIFFERENCE.
DEPTH_QUANTILES = (0.1, 0.5, 0.9)
MAX_DEPTH_DIFFERENCE = 0.5
# Beliefs keep this far from 0 and 1 in log odds.
MIN_BELIEF = 2e-3
# Regions with at least this belief are the object.
KEPT_BELIEF = 0.45
# The floor is the largest plane with next to nothing below it that is level in an upright image:
# least height of its unit normal, least fraction of the image, what counts as below, and the most
# of that, as a fraction of the floor.
FLOOR_MIN_UP, FLOOR_MIN_AREA = 0.5, 0.02
BELOW_FLOOR_M, FLOOR_MAX_BELOW = 0.1, 0.1
# Regions of the floor have normals so near to its own, and are so near to it, in standard
# deviations: more while it is looked for, less in the end: the base of a lamp is 2 cm high.
FLOOR_MIN_COSINE, FLOOR_SEARCH_OFFSET, FLOOR_OFFSET = 0.95, 3.0, 0.6
# An object of which at least this fraction is so far above the floor contains no part of it.
ABOVE_FLOOR_M, ABOVE_FRACTION = 0.1, 0.15
# Columns of the evidence. Those up to "rank" are fixed, the others depend on the beliefs.
EVIDENCE = (
    "distance",  # from the background
    "plane",  # cost to continue a plane of the background
    "background_colour",  # difference to the most similar region beside the candidates
    "area",  # logarithm of the fraction of the box
    "top",  # distance from the top side of the box, of its height
    "bottom",
    "inside",  # fraction of the region inside the box
    "rank",  # fraction of the candidates' cells that are at most as far from the background
    "neighbours",  # log odds of the neighbours' beliefs; weak borders count most
    "mean_colour",  # difference to the object's mean
    "nearest_colour",  # difference to the most similar one of the object's other regions
    "behind",  # depth behind the object's depths, relative
    "before",
    "alone",  # sides of the box that no other region of the object touches
    "belief",  # log odds
)
# Weights of the evidence in each round; the last one is the constant.
WEIGHTS = np.array(
    [
        [
            0.212,
            0.104,
            1.045,
            0.296,
            -1.551,
            -1.052,
            11.751,
            0.447,
            0.453,
            -0.366,
            0.0,
            -9.777,
            -8.109,
            0.549,
            0.0,
            -10.791,
        ],
        [
            0.292,
            0.104,
            0.971,
            0.356,
            -1.903,
            -1.514,
            15.027,
            0.387,
            0.823,
            -0.28,
            -0.275,
            -8.904,
            -9.161,
            0.81,
            -0.374,
            -13.132,
        ],
        [
            0.117,
            0.044,
            0.404,
            0.125,
            -0.683,
            -0.55,
            6.093,
            0.158,
            0.447,
            -0.115,
            -0.116,
            -4.234,
            -4.416,
            0.462,
            0.348,
            -5.437,
        ],
    ]
)

# `Regions` from `lab` on.
_Surfaces = tuple[Float64, Float64, Float64, Float64, Float64, Int32, Float64, Float64]


def cut_boxes(regions: Regions, boxes_cells: Int64) -> Int32:
    """The object of each region, (c,) int32: row of the box, or -1.

    Small boxes choose first: the regions of a cup are also in the box of its table, but the
    regions of the table are not in the box of the cup.

    Args:
        regions: c regions of the reduced image.
        boxes_cells: (n, 4) int64 inclusive bounds x1, y1, x2, y2, cells, inside the image.
    """
    owner = np.full(len(regions.area), -1, dtype=np.int32)
    sides = boxes_cells[:, 2:] - boxes_cells[:, :2] + 1
    regions = regions._replace(strength=regions.strength**STRENGTH_POWER)
    for row in np.argsort(sides.prod(axis=1), kind="stable"):
        _cut_box(regions, boxes_cells[row], owner, row)
    _leave_out_floor(regions, owner, len(boxes_cells))
    return owner


def _leave_out_floor(regions: Regions, owner: Int32, count: int) -> None:
    """Take the floor from the `count` objects that rise from it.

    A rug below a table lies wholly in the box of the table, and is like nothing around it.
    """
    seen, point = regions.valid >= POINT_MIN_CELLS, regions.point
    noise_m = PLANE_NOISE_M + PLANE_NOISE_PER_M2 * point[:, 2] ** 2
    is_level = (regions.valid >= PLANE_MIN_CELLS) & (regions.flatness >= PLANE_MIN_FLATNESS)
    is_level &= regions.normal[:, 1] < -FLOOR_MIN_UP
    planes, origins = regions.normal[is_level], point[is_level]
    heights_m = planes @ point.T - (planes * origins).sum(axis=1)[:, None]
    are_on = seen & (np.abs(heights_m) <= FLOOR_SEARCH_OFFSET * noise_m)
    are_on &= planes @ regions.normal.T >= FLOOR_MIN_COSINE
    areas = are_on @ regions.area
    below = (seen & (heights_m < -BELOW_FLOOR_M)) @ regions.area
    is_floor = (areas >= FLOOR_MIN_AREA * regions.area.sum()) & (below <= FLOOR_MAX_BELOW * areas)
    if not is_floor.any():
        return
    # The plane through all of its regions: the normal of one is too rough.
    on = are_on[np.argmax(is_floor * areas)]
    weights = regions.area[on] / regions.area[on].sum()
    center = weights @ point[on]
    apart = point[on] - center
    up = np.linalg.eigh((apart * weights[:, None]).T @ apart)[1][:, 0]
    up *= -np.sign(up[1])
    height_m = (point - center) @ up
    on = (np.abs(height_m) <= FLOOR_OFFSET * noise_m) & (regions.normal @ up >= FLOOR_MIN_COSINE)
    # The fraction of each object above.
    owned = seen & (owner >= 0)
    total = np.bincount(owner[owned], regions.area[owned], count)
    high = owned & (height_m > ABOVE_FLOOR_M)
    rises = np.bincount(owner[high], regions.area[high], count) >= ABOVE_FRACTION * total
    owner[owned & on & rises[owner]] = -1


def _cut_box(regions: Regions, box: Int64, owner: Int32, row: int) -> None:
    """Set `owner` to `row` for the regions of the object in the box."""
    candidates = find_candidates(regions, box, owner)
    if candidates is None:
        return
    for weights in WEIGHTS:
        candidates.refine(regions, owner, weights)
    owner[candidates.members[candidates.belief >= KEPT_BELIEF]] = row


@dataclass
class Candidates:
    """The m regions that can be the object in a box.

    Attributes:
        members: (m,) int64 regions.
        evidence: (m, len(EVIDENCE)) float64.
        belief: (m,) float64, that a region is the object's.
        by_depth: (m,) int64, rows of `members` in the order of their depths.
        touches: (m, 4) bool, the left, top, right and bottom side of the box.
    """

    members: Int64
    evidence: Float64
    belief: Float64
    by_depth: Int64
    touches: Bool

    def refine(self, regions: Regions, owner: Int32, weights: Float64) -> None:
        """New beliefs from the evidence of the present ones; weights (len(EVIDENCE) + 1,)."""
        self.weigh(regions, owner)
        self.belief = 1.0 / (1.0 + np.exp(-(self.evidence @ weights[:-1] + weights[-1])))

    def weigh(self, regions: Regions, owner: Int32) -> None:
        """Set the evidence that depends on the beliefs."""
        _weigh(
            self.evidence,
            self.belief,
            regions[1:],
            self.members,
            self.by_depth,
            self.touches,
            owner,
        )


def find_candidates(regions: Regions, box: Int64, owner: Int32) -> Candidates | None:
    """The regions without an owner that can be the object, with their first beliefs.

    Args:
        regions: of the reduced image; strengths are costs.
        box: (4,) int64 inclusive bounds, cells.
        owner: (c,) int32; -1 = none yet.
    """
    area = regions.area
    inside, loosely, bounds = _count_inside(regions.labels, len(area), box)
    free = owner < 0
    candidate = free & (inside > INSIDE_FRACTION * area)
    members = np.flatnonzero(candidate)
    if len(members) == 0:
        return None
    background = free & ~candidate & (loosely <= INSIDE_FRACTION * area)
    distance = np.where(background, 0.0, np.inf)
    costs = _spread(regions[2:], members, candidate, distance, owner)
    distance = np.minimum(distance[members], MAX_DISTANCE)
    corner, sides = box[:2], (box[2:] - box[:2] + 1).astype(np.float64)
    gaps = (
        np.hstack((bounds[members, :2] - corner, box[2:] - bounds[members, 2:]))
        / sides[[0, 1, 0, 1]]
    )
    area = area[members]
    evidence = np.zeros((len(members), len(EVIDENCE)))
    evidence[:, 0] = distance
    evidence[:, 1:3] = costs
    evidence[:, 3] = np.log(area / sides.prod())
    evidence[:, 4:6] = gaps[:, 1::2]
    evidence[:, 6] = inside[members] / area
    order = np.argsort(distance, kind="stable")
    evidence[order, 7] = np.cumsum(area[order]) / area.sum()
    return Candidates(
        members=members,
        evidence=evidence,
        belief=distance / MAX_DISTANCE,
        by_depth=np.argsort(regions.point[members, 2], kind="stable"),
        touches=gaps < TOUCHING_FRACTION,
    )


@kernel
def _count_inside(labels: Int32, count: int, box: Int64) -> tuple[Int64, Int64, Int64]:
    """For each region: its cells in the box, and in the box with slack; its bounds in the box."""
    x1, y1, x2, y2 = box[0], box[1], box[2], box[3]
    rows, columns = labels.shape
    inside, loosely = np.zeros(count, np.int64), np.empty(count, np.int64)
    bounds = np.zeros((count, 4), np.int64)
    for y in range(y1, y2 + 1):
        for x in range(x1, x2 + 1):
            r = labels[y, x]
            if inside[r] == 0:
                bounds[r, 0], bounds[r, 1], bounds[r, 2], bounds[r, 3] = x, y, x, y
            inside[r] += 1
            bounds[r, 0] = min(bounds[r, 0], x)
            bounds[r, 2] = max(bounds[r, 2], x)
            bounds[r, 3] = max(bounds[r, 3], y)
    for r in range(count):
        loosely[r] = inside[r]
    slack_x = int(SLACK_CELLS + SLACK_FRACTION * (x2 - x1) + 0.5)
    slack_y = int(SLACK_CELLS + SLACK_FRACTION * (y2 - y1) + 0.5)
    for y in range(max(y1 - slack_y, 0), min(y2 + slack_y, rows - 1) + 1):
        for x in range(max(x1 - slack_x, 0), min(x2 + slack_x, columns - 1) + 1):
            if x < x1 or x > x2 or y < y1 or y > y2:
                loosely[labels[y, x]] += 1
    return inside, loosely, bounds


@kernel
def _spread(
    surfaces: _Surfaces, members: Int64, candidate: Bool, distance: Float64, owner: Int32
) -> Float64:
    """Lower the distances of regions to the costs of their paths from the background.

    Returns:
        (m, 2) of each member: the least cost to continue a plane of the background, and the least
        difference of colour to a region beside the candidates.
    """
    lab, valid, point, normal, flatness, pairs, strength, _ = surfaces
    costs = np.empty((len(members), 2), np.float64)
    costs[:, 0], costs[:, 1] = MAX_PLANE_COST, MAX_NEAREST_COLOUR
    beside = np.zeros(len(valid), np.bool_)
    # To members that continue a plane of the background.
    for q in range(len(valid)):
        is_plane = valid[q] >= PLANE_MIN_CELLS and flatness[q] >= PLANE_MIN_FLATNESS
        if distance[q] > 0.0 or owner[q] >= 0 or not is_plane:
            continue
        for m in range(len(members)):
            r = members[m]
            if valid[r] < POINT_MIN_CELLS:
                continue
            offset = cosine = colour = 0.0
            for k in range(3):
                offset += (point[r, k] - point[q, k]) * normal[q, k]
                cosine += normal[r, k] * normal[q, k]
                colour += ((lab[r, k] - lab[q, k]) / PLANE_COLOUR) ** 2
            offset = abs(offset) / (PLANE_NOISE_M + PLANE_NOISE_PER_M2 * point[r, 2] ** 2)
            if offset > PLANE_MAX_OFFSET:
                continue
            angle = PLANE_ANGLE_WEIGHT * (1.0 - cosine)
            cost = np.sqrt(PLANE_OFFSET_WEIGHT * offset * offset + angle + colour)
            costs[m, 0] = min(costs[m, 0], cost)
            distance[r] = min(distance[r], PLANE_COST + cost)
    # Shortest paths over the borders (Bellman-Ford). Those within the background have no effect.
    relevant, found = np.empty(len(pairs), np.int32), 0
    for i in range(len(pairs)):
        a, b = pairs[i, 0], pairs[i, 1]
        if owner[a] < 0 and owner[b] < 0 and (distance[a] > 0.0 or distance[b] > 0.0):
            relevant[found] = i
            found += 1
            if candidate[a] != candidate[b]:
                beside[b if candidate[a] else a] = True
    # The pairs are in scan order, so that a few sweeps are enough.
    changed = True
    while changed:
        changed = False
        for k in range(found):
            i = relevant[k]
            a, b = pairs[i, 0], pairs[i, 1]
            if distance[b] + strength[i] < distance[a] - 1e-9:
                distance[a] = distance[b] + strength[i]
                changed = True
            elif distance[a] + strength[i] < distance[b] - 1e-9:
                distance[b] = distance[a] + strength[i]
                changed = True
    for q in range(len(beside)):
        for m in range(len(members) if beside[q] else 0):
            square = 0.0
            for k in range(3):
                square += ((lab[members[m], k] - lab[q, k]) / EVIDENCE_COLOUR) ** 2
            costs[m, 1] = min(costs[m, 1], np.sqrt(square))
    return costs


@kernel
def _weigh(
    evidence: Float64,
    belief: Float64,
    surfaces: tuple[Float64, Float64, Float64, Float64, Float64, Float64, Int32, Float64, Float64],
    members: Int64,
    by_depth: Int64,
    touches: Bool,
    owner: Int32,
) -> None:
    """Write the columns of the evidence that depend on the beliefs. `surfaces`: from `area` on."""
    area, lab, valid, point, _, _, pairs, strength, length = surfaces
    # The beliefs of the neighbours, and the lengths of their borders.
    of_region, is_member = np.zeros(len(area), np.float64), np.zeros(len(area), np.bool_)
    for m in range(len(members)):
        of_region[members[m]], is_member[members[m]] = belief[m], True
    for_it = np.full(len(area), 0.5 * UNKNOWN_BORDER)
    total = np.full(len(area), UNKNOWN_BORDER)
    for i in range(len(pairs)):
        a, b = pairs[i, 0], pairs[i, 1]
        if owner[a] < 0 and owner[b] < 0 and (is_member[a] or is_member[b]):
            weight = length[i] * np.exp(-strength[i])
            for_it[a] += weight * of_region[b]
            for_it[b] += weight * of_region[a]
            total[a] += weight
            total[b] += weight
    # The mean colour of the object, and those of its largest regions.
    colours, cells = np.zeros((1 + COLOURS, 3), np.float64), 1e-9
    largest, found = np.full(1 + COLOURS, -1, np.int64), 1
    for m in np.argsort(-area[members]):
        r = members[m]
        cells += area[r] * belief[m]
        colours[0] += area[r] * belief[m] * lab[r]
        if belief[m] > COLOUR_BELIEF and found <= COLOURS:
            largest[found], colours[found] = r, lab[r]
            found += 1
    colours[0] /= cells
    # Its depths.
    cells, before = 1e-9, 0.0
    for m in range(len(members)):
        if valid[members[m]] > 0:
            cells += area[members[m]] * belief[m]
    near = middle = far = 0.0
    for m in by_depth:
        r = members[m]
        if valid[r] > 0:
            if before <= DEPTH_QUANTILES[0] * cells:
                near = point[r, 2]
            if before <= DEPTH_QUANTILES[1] * cells:
                middle = point[r, 2]
            if before <= DEPTH_QUANTILES[2] * cells:
                far = point[r, 2]
            before += area[r] * belief[m]
    # The strongest two beliefs at each side of the box.
    strongest = np.zeros((4, 2), np.float64)
    for m in range(len(members)):
        for side in range(4):
            if touches[m, side] and belief[m] > strongest[side, 0]:
                strongest[side, 1] = strongest[side, 0]
                strongest[side, 0] = belief[m]
            elif touches[m, side] and belief[m] > strongest[side, 1]:
                strongest[side, 1] = belief[m]
    for m in range(len(members)):
        r = members[m]
        mean = nearest = np.inf
        for i in range(found):
            square = 0.0
            for k in range(3):
                square += ((lab[r, k] - colours[i, k]) / EVIDENCE_COLOUR) ** 2
            if i == 0:
                mean = np.sqrt(square)
            elif largest[i] != r:
                nearest = min(nearest, np.sqrt(square))
        alone = 0.0
        for side in range(4):
            if touches[m, side]:
                is_first = belief[m] >= strongest[side, 0]
                alone += 1.0 - strongest[side, 1 if is_first else 0]
        depth = point[r, 2] if valid[r] > 0 else middle
        odds = min(max(belief[m], MIN_BELIEF), 1.0 - MIN_BELIEF)
        evidence[m, 8] = np.log(for_it[r] / (total[r] - for_it[r]))
        evidence[m, 9] = min(mean, MAX_MEAN_COLOUR)
        evidence[m, 10] = min(nearest, MAX_NEAREST_COLOUR)
        scale = max(middle, 1e-9)
        evidence[m, 11] = min(max((depth - far) / scale, 0.0), MAX_DEPTH_DIFFERENCE)
        evidence[m, 12] = min(max((near - depth) / scale, 0.0), MAX_DEPTH_DIFFERENCE)
        evidence[m, 13] = alone
        evidence[m, 14] = np.log(odds / (1.0 - odds))


# --- Labels of cells → labels of pixels, guided by the image.

# The cost of a cell sums squared differences between it and the pixel. Each of these counts 1:
# RGB colour, 8 bit; depth, relative to the depth.
COLOUR_STEP = 12.0
DEPTH_STEP = 0.015
# Cost of the squared distance to the cell's centre, in cell widths.
DISTANCE_WEIGHT = 0.5
# Maximum cost of the depth. A flying pixel is far from the surfaces on both sides.
MAX_DEPTH_COST = 9.0
# Row and column offsets of the candidate cells. Of several with one cost, the first in scan order
# is chosen: those above and on the left come before the pixel's own cell.
CANDIDATES = ((0, 0), (-1, 0), (0, -1), (0, 1), (1, 0))

_Candidates = tuple[Float32, Int64, Int16, int, int]


@kernel
def upsample_labels(
    labels: Int32, cell_rgb: UInt8, cell_depth: Float32, rgb: UInt8, depth_m: Float32, stride: int
) -> Int16:
    """Each pixel takes the label of the most similar of its own cell and the four beside it.

    Args:
        labels: (h, w) int32 of cells, below 2^15.
        cell_rgb: (h, w, 3) uint8 mean colour of cells.
        cell_depth: (h, w) float32 metres; 0 = invalid.
        rgb: (H, W, 3) uint8.
        depth_m: (H, W) float32 metres; 0, NaN or infinity = invalid.
        stride: pixels per cell.

    Returns:
        (H, W) int16.
    """
    height, width = depth_m.shape
    rows, columns = labels.shape
    result = np.empty((height, width), np.int16)
    near = np.empty((len(CANDIDATES), 4), np.float32)
    centres = np.empty((len(CANDIDATES), 2), np.int64)
    near_labels = np.empty(len(CANDIDATES), np.int16)
    # The cost of each distance along an axis, from `reach` pixels before a centre on.
    reach = 2 * stride
    along = np.empty(6 * stride, np.float32)
    for i in range(len(along)):
        d = np.float32(i - reach) / np.float32(stride)
        along[i] = d * d
    for v in range(rows):
        # The last cells also cover the pixels that the stride leaves over.
        top, bottom = v * stride, height if v == rows - 1 else (v + 1) * stride
        for u in range(columns):
            right = width if u == columns - 1 else (u + 1) * stride
            for x in range(u * stride, right):
                result[top, x] = labels[v, u]
        for y in range(top + 1, bottom):
            for x in range(width):
                result[y, x] = result[top, x]
        for u in range(columns):
            is_uniform = True
            for dv, du in CANDIDATES:
                b, a = v + dv, u + du
                if 0 <= b < rows and 0 <= a < columns and labels[b, a] != labels[v, u]:
                    is_uniform = False
            if is_uniform:
                continue
            before = (v > 0) + (u > 0)
            count = 1 + before + (u < columns - 1) + (v < rows - 1)
            i = 0
            for dv, du in CANDIDATES:
                b, a = v + dv, u + du
                if b < 0 or a < 0 or b >= rows or a >= columns:
                    continue
                for k in range(3):
                    near[i, k] = cell_rgb[b, a, k]
                near[i, 3] = cell_depth[b, a]
                centres[i, 0] = b * stride + stride // 2 - reach
                centres[i, 1] = a * stride + stride // 2 - reach
                near_labels[i] = labels[b, a]
                i += 1
            right = width if u == columns - 1 else (u + 1) * stride
            pixels = (top, bottom, u * stride, right)
            candidates = (near, centres, near_labels, count, before)
            _choose(candidates, along, rgb, depth_m, pixels, result)
    return result


@kernel
def _choose(
    candidates: _Candidates,
    along: Float32,
    rgb: UInt8,
    depth_m: Float32,
    pixels: tuple[int, int, int, int],
    result: Int16,
) -> None:
    """Write the label of the candidate with the least cost to each pixel of a cell.

    Args:
        candidates: their colour and depth (k, 4), the own cell first; row and column (k, 2) from
            which `along` counts; labels; their number; those from 1 to this one win against the
            own cell at the same cost.
        along: cost of the distance along an axis.
        rgb: (H, W, 3) uint8.
        depth_m: (H, W) float32 metres.
        pixels: first and last row, first and last column, without the last.
        result: (H, W) int16, written.
    """
    near, centres, labels, count, before = candidates
    colour_weight = np.float32(COLOUR_STEP * COLOUR_STEP)
    for y in range(pixels[0], pixels[1]):
        for x in range(pixels[2], pixels[3]):
            red, green, blue = (
                np.float32(rgb[y, x, 0]),
                np.float32(rgb[y, x, 1]),
                np.float32(rgb[y, x, 2]),
            )
            z = depth_m[y, x]
            depth_step = np.float32(DEPTH_STEP) * z
            has_depth = z > 0 and z < np.inf
            # Above this, colour and distance alone cost more than the best; divisions take long.
            most = best = np.float32(np.inf)
            chosen = 0
            for i in range(count):
                d, e, f = red - near[i, 0], green - near[i, 1], blue - near[i, 2]
                cost = d * d + e * e + f * f
                distance = along[y - centres[i, 0]] + along[x - centres[i, 1]]
                distance = np.float32(DISTANCE_WEIGHT) * distance
                if cost + colour_weight * distance > most:
                    continue
                cost /= colour_weight
                if has_depth and near[i, 3] > 0:
                    d = (z - near[i, 3]) / depth_step
                    cost += min(d * d, np.float32(MAX_DEPTH_COST))
                cost += distance
                if cost < best or (cost == best and chosen == 0 and i <= before):
                    best, chosen = cost, i
                    most = best * np.float32(COLOUR_STEP * COLOUR_STEP * (1.0 + 1e-5))
            result[y, x] = labels[chosen]


# --- Segmenter for RGB-D images without a network.

# Cells across the image. Fewer cells lose chair legs, more cost time.
TARGET_WIDTH = 213


class RgbdSegmenter:
    """The visible surface of the object in each box, from colour and depth, all boxes jointly."""

    def __init__(self) -> None:
        # Compile the kernels now, so that the first image does not wait.
        side = 24
        self.segment(
            np.zeros((side, side, 3), dtype=np.uint8),
            np.ones((side, side), dtype=np.float32),
            Intrinsics(side, side, side / 2, side / 2, side, side),
            # In the small box lies no whole region, in the large one there is one.
            np.array([[4.0, 4.0, 16.0, 16.0], [0.0, 0.0, side, side]]),
        )

    def segment(
        self,
        rgb: UInt8,
        depth_m: Float32,
        intrinsics: Intrinsics,
        boxes_xyxy: Float64,
    ) -> list[MaskPatch]:
        """One mask for each box; see `Segmenter`. Masks do not overlap."""
        if len(boxes_xyxy) == 0:
            return []
        rgb, depth_m = read_only(rgb), read_only(depth_m)
        height, width = depth_m.shape
        stride = max(1, round(width / TARGET_WIDTH))
        cells = reduce_frame(rgb, depth_m, intrinsics, stride)
        regions = find_regions(cells)
        rows, columns = regions.labels.shape
        limits = np.array([columns - 1, rows - 1] * 2)
        boxes_cells = np.clip(np.round(boxes_xyxy) // stride, 0, limits).astype(np.int64)
        owner = cut_boxes(regions, boxes_cells)
        labels = upsample_labels(
            owner[regions.labels], cells.rgb, cells.points[..., 2], rgb, depth_m, stride
        )
        patches = []
        for row, box in enumerate(boxes_xyxy):
            left, top = np.clip(np.round(box[:2]), 0, [width, height]).astype(int)
            right, bottom = np.clip(np.round(box[2:]) + 1, 0, [width, height]).astype(int)
            patches.append(MaskPatch(int(top), int(left), labels[top:bottom, left:right] == row))
        return patches
