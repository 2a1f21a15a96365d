"""Which regions inside a box are the object: those the background outside does not reach.

The background is what lies mostly outside the box. It spreads inwards over the borders between
regions, and to regions that continue one of its planes (the floor seen through a chair, the table
under a cup). How much it had to overcome to reach a region is that region's distance. The cut
between near (background) and far (object) regions is where three things agree: the distances fall
into two classes (Otsu), what is kept still touches all four sides of the box, and it fills it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.perception.superpixels.superpixels import Regions
from deworldsg_ros.scene.arrays import Float64, Int32, Int64


class CutSettings(NamedTuple):
    """How background and object are told apart; the same for every object and scene.

    Attributes:
        inside_share: share of a region's cells inside the box above which it may be the object's.
        slack_cells, slack_share: error of a box's edge, cells and share of the side. What lies
            between box and slack, a strip that a box drawn too small cuts off, is neither object
            nor does it vouch for the background.
        strength_power: borders count with this power of their strength: many weak ones are no
            strong one, and a depth step is not stronger than several clear ones.
        plane_price: what the background pays to reach a region that continues its plane.
        plane_colour: difference in CIE Lab that costs as much as 1.
        plane_noise_m, plane_noise_per_m2: error of a region's mean depth, and its growth with the
            square of the depth.
        plane_min_cells: size below which a region's plane is not trusted.
        tightness: weight of touching the box, beside the two-class criterion in [0, 1].
        fill_expected, fill_weight: least share of its box that an object is expected to fill, and
            the weight of what is missing.
        far: distance beyond which all is equally far.
    """

    inside_share: float = 0.8
    slack_cells: float = 1.0
    slack_share: float = 0.04
    strength_power: float = 0.6
    plane_price: float = 2.0
    plane_colour: float = 12.0
    plane_noise_m: float = 0.008
    plane_noise_per_m2: float = 0.002
    plane_min_cells: float = 12.0
    tightness: float = 1.0
    fill_expected: float = 0.4
    fill_weight: float = 0.5
    far: float = 5.0


SETTINGS = CutSettings()


def cut_boxes(regions: Regions, boxes_cells: Int64, settings: CutSettings = SETTINGS) -> Int32:
    """The object of each region, (c,) int32: row of the box, or -1.

    Small boxes choose first: a cup's regions lie in the table's box too, but not the reverse.

    Args:
        regions: of the reduced image.
        boxes_cells: (n, 4) inclusive cell bounds x1, y1, x2, y2, inside the image.
        settings: see there.
    """
    owner = np.full(len(regions.area), -1, dtype=np.int32)
    sides = boxes_cells[:, 2:] - boxes_cells[:, :2] + 1
    strength = regions.strength**settings.strength_power
    for row in np.argsort(sides.prod(axis=1), kind="stable"):
        _cut_box(
            regions.labels,
            regions.area,
            regions.lab,
            regions.valid,
            regions.point,
            regions.normal,
            regions.flatness,
            regions.pairs,
            strength,
            boxes_cells[row],
            owner,
            row,
            settings,
        )
    return owner


@kernel
def _cut_box(
    labels: Int32,
    area: Float64,
    lab: Float64,
    valid: Float64,
    point: Float64,
    normal: Float64,
    flatness: Float64,
    pairs: Int32,
    strength: Float64,
    box: Int64,
    owner: Int32,
    row: int,
    settings: CutSettings,
) -> None:
    x1, y1, x2, y2 = box
    count = len(area)
    inside, loosely, bounds = _count_inside(labels, count, box, settings)
    distance = np.full(count, np.inf)
    candidate = np.zeros(count, np.bool_)
    for r in range(count):
        if owner[r] >= 0:
            continue
        if inside[r] > settings.inside_share * area[r]:
            candidate[r] = True
        elif loosely[r] <= settings.inside_share * area[r]:
            distance[r] = 0.0
    members = np.flatnonzero(candidate)
    if len(members) == 0:
        return
    _reach_by_planes(members, distance, owner, area, lab, valid, point, normal, flatness, settings)
    _reach_by_borders(distance, owner, pairs, strength)
    distance = np.minimum(distance, settings.far)
    order = members[np.argsort(-distance[members], kind="mergesort")]
    free = 0.0
    for r in range(count):
        if inside[r] > 0 and owner[r] < 0:
            free += inside[r]
    box_area = (x2 - x1 + 1) * (y2 - y1 + 1)
    kept = _best_prefix(order, distance, area, bounds, free, box_area, settings)
    for i in range(kept):
        owner[order[i]] = row


@kernel
def _count_inside(
    labels: Int32, count: int, box: Int64, settings: CutSettings
) -> tuple[Int32, Int32, Int32]:
    x1, y1, x2, y2 = box
    rows, columns = labels.shape
    inside = np.zeros(count, np.int32)
    bounds = np.zeros((count, 4), np.int32)
    for y in range(y1, y2 + 1):
        for x in range(x1, x2 + 1):
            r = labels[y, x]
            if inside[r] == 0:
                bounds[r, 0], bounds[r, 1], bounds[r, 2], bounds[r, 3] = x, y, x, y
            inside[r] += 1
            bounds[r, 0] = min(bounds[r, 0], x)
            bounds[r, 2] = max(bounds[r, 2], x)
            bounds[r, 3] = max(bounds[r, 3], y)
    loosely = inside.copy()
    slack_x = int(settings.slack_cells + settings.slack_share * (x2 - x1) + 0.5)
    slack_y = int(settings.slack_cells + settings.slack_share * (y2 - y1) + 0.5)
    for y in range(max(y1 - slack_y, 0), min(y2 + slack_y, rows - 1) + 1):
        for x in range(max(x1 - slack_x, 0), min(x2 + slack_x, columns - 1) + 1):
            if x < x1 or x > x2 or y < y1 or y > y2:
                loosely[labels[y, x]] += 1
    return inside, loosely, bounds


@kernel
def _reach_by_planes(
    members: Int64,
    distance: Float64,
    owner: Int32,
    area: Float64,
    lab: Float64,
    valid: Float64,
    point: Float64,
    normal: Float64,
    flatness: Float64,
    settings: CutSettings,
) -> None:
    for q in range(len(area)):
        if distance[q] > 0.0 or owner[q] >= 0 or valid[q] < settings.plane_min_cells:
            continue
        if flatness[q] < 0.9:
            continue
        for r in members:
            if valid[r] < 3:
                continue
            off = 0.0
            for k in range(3):
                off += (point[r, k] - point[q, k]) * normal[q, k]
            noise = settings.plane_noise_m + settings.plane_noise_per_m2 * point[r, 2] ** 2
            off = abs(off) / noise
            if off > 3.0:
                continue
            cosine = 0.0
            colour = 0.0
            for k in range(3):
                cosine += normal[r, k] * normal[q, k]
                colour += ((lab[r, k] - lab[q, k]) / settings.plane_colour) ** 2
            price = np.sqrt(0.3 * off * off + 5.0 * (1.0 - cosine) + colour)
            distance[r] = min(distance[r], settings.plane_price + price)


@kernel
def _reach_by_borders(distance: Float64, owner: Int32, pairs: Int32, strength: Float64) -> None:
    # Borders between two regions of the background cannot matter.
    relevant = np.empty(len(pairs), np.int32)
    found = 0
    for i in range(len(pairs)):
        a, b = pairs[i]
        if owner[a] < 0 and owner[b] < 0 and (distance[a] > 0.0 or distance[b] > 0.0):
            relevant[found] = i
            found += 1
    # Bellman-Ford; the pairs are in scan order, so a few sweeps settle it.
    changed = True
    while changed:
        changed = False
        for k in range(found):
            i = relevant[k]
            a, b = pairs[i]
            if distance[b] + strength[i] < distance[a] - 1e-9:
                distance[a] = distance[b] + strength[i]
                changed = True
            elif distance[a] + strength[i] < distance[b] - 1e-9:
                distance[b] = distance[a] + strength[i]
                changed = True


@kernel
def _best_prefix(
    order: Int64,
    distance: Float64,
    area: Float64,
    bounds: Int32,
    free: float,
    box_area: int,
    settings: CutSettings,
) -> int:
    total, total_square = 0.0, 0.0
    for r in order:
        total += area[r] * distance[r]
        total_square += area[r] * distance[r] ** 2
    variance = max(total_square / free - (total / free) ** 2, 1e-9)
    left, top, right, bottom = bounds[order[0]]
    near, weight, best, kept = 0.0, 0.0, -np.inf, 0
    for i in range(len(order)):
        r = order[i]
        near += area[r]
        weight += area[r] * distance[r]
        left, top = min(left, bounds[r, 0]), min(top, bounds[r, 1])
        right, bottom = max(right, bounds[r, 2]), max(bottom, bounds[r, 3])
        share = min(near / free, 1.0)
        rest = max(free - near, 1e-9)
        between = share * (1.0 - share) * (weight / near - (total - weight) / rest) ** 2
        tight = (right - left + 1) * (bottom - top + 1) / box_area
        sparse = max(1.0 - near / (settings.fill_expected * free), 0.0)
        score = between / variance + settings.tightness * tight - settings.fill_weight * sparse
        if score > best:
            best, kept = score, i + 1
    return kept
