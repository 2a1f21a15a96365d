"""Which regions inside a box are the object: those the background outside does not reach.

The background is what lies mostly outside the box. It spreads inwards over the borders between
regions, and to regions that continue one of its planes (the floor seen through a chair, the table
under a cup). How much it had to overcome to reach a region is that region's distance. The cut
between near (background) and far (object) regions is where two things agree: the distances fall
into two classes (Otsu), and what is kept still touches all four sides of the box.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.perception.superpixels import Regions

# A region with less than this share inside the box is background.
INSIDE_SHARE = 0.6
# Borders count with this power of their strength: many weak ones are no strong one, and a very
# strong one (a depth step) is not stronger than several clear ones.
STRENGTH_POWER = 0.6
# A plane that goes on beyond the box reaches coplanar regions at this price, plus colour and fit.
PLANE_PRICE = 1.0
PLANE_COLOUR_STEP = 20.0
# Noise of a region's mean depth: a floor, and growth with the square of the depth.
PLANE_NOISE_M, PLANE_NOISE_PER_M2 = 0.008, 0.002
PLANE_MIN_CELLS = 6
# How much touching the box counts beside the two-class criterion, which is in [0, 1].
TIGHTNESS = 2.0
FAR = 20.0


def cut_boxes(regions: Regions, boxes_cells: NDArray[np.int64]) -> NDArray[np.int32]:
    """The object of each region, (c,) int32: row of the box, or -1.

    Small boxes choose first: a cup's regions lie in the table's box too, but not the reverse.

    Args:
        regions: of the reduced image.
        boxes_cells: (n, 4) inclusive cell bounds x1, y1, x2, y2, inside the image.
    """
    owner = np.full(len(regions.area), -1, dtype=np.int32)
    sides = boxes_cells[:, 2:] - boxes_cells[:, :2] + 1
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
            regions.strength**STRENGTH_POWER,
            boxes_cells[row],
            owner,
            row,
        )
    return owner


@numba.njit(cache=True, nogil=True)
def _cut_box(  # type: ignore[no-untyped-def]
    labels, area, lab, valid, point, normal, flatness, pairs, strength, box, owner, row
):
    x1, y1, x2, y2 = box
    count = len(area)
    inside = np.zeros(count, np.int32)
    bounds = np.empty((count, 4), np.int32)
    for y in range(y1, y2 + 1):
        for x in range(x1, x2 + 1):
            r = labels[y, x]
            if inside[r] == 0:
                bounds[r, 0], bounds[r, 1], bounds[r, 2], bounds[r, 3] = x, y, x, y
            inside[r] += 1
            bounds[r, 0] = min(bounds[r, 0], x)
            bounds[r, 2] = max(bounds[r, 2], x)
            bounds[r, 3] = max(bounds[r, 3], y)
    distance = np.full(count, np.inf)
    candidate = np.zeros(count, np.bool_)
    for r in range(count):
        if owner[r] >= 0:
            continue
        if inside[r] > INSIDE_SHARE * area[r]:
            candidate[r] = True
        else:
            distance[r] = 0.0
    members = np.flatnonzero(candidate)
    if len(members) == 0:
        return
    _reach_by_planes(members, distance, candidate, owner, area, lab, valid, point, normal, flatness)
    _reach_by_borders(distance, owner, pairs, strength)
    for r in members:
        distance[r] = min(distance[r], FAR)
    order = members[np.argsort(-distance[members], kind="mergesort")]
    free = 0.0
    for r in range(count):
        if inside[r] > 0 and owner[r] < 0:
            free += inside[r]
    kept = _best_prefix(order, distance, area, bounds, free, (x2 - x1 + 1) * (y2 - y1 + 1))
    for i in range(kept):
        owner[order[i]] = row


@numba.njit(cache=True, nogil=True)
def _reach_by_planes(  # type: ignore[no-untyped-def]
    members, distance, candidate, owner, area, lab, valid, point, normal, flatness
):
    for q in range(len(area)):
        if candidate[q] or owner[q] >= 0 or valid[q] < PLANE_MIN_CELLS or flatness[q] < 0.9:
            continue
        for r in members:
            if valid[r] < 3:
                continue
            off = 0.0
            cosine = 0.0
            for k in range(3):
                off += (point[r, k] - point[q, k]) * normal[q, k]
                cosine += normal[r, k] * normal[q, k]
            noise = PLANE_NOISE_M + PLANE_NOISE_PER_M2 * point[r, 2] ** 2
            off = abs(off) / noise
            if off > 3.0:
                continue
            colour = 0.0
            for k in range(3):
                colour += ((lab[r, k] - lab[q, k]) / PLANE_COLOUR_STEP) ** 2
            price = PLANE_PRICE + np.sqrt(0.3 * off * off + 5.0 * (1.0 - cosine) + colour)
            distance[r] = min(distance[r], price)


@numba.njit(cache=True, nogil=True)
def _reach_by_borders(distance, owner, pairs, strength):  # type: ignore[no-untyped-def]
    # Bellman-Ford; the pairs are in scan order, so a few sweeps settle it.
    changed = True
    while changed:
        changed = False
        for i in range(len(pairs)):
            a, b = pairs[i]
            if owner[a] >= 0 or owner[b] >= 0:
                continue
            if distance[b] + strength[i] < distance[a] - 1e-9:
                distance[a] = distance[b] + strength[i]
                changed = True
            elif distance[a] + strength[i] < distance[b] - 1e-9:
                distance[b] = distance[a] + strength[i]
                changed = True


@numba.njit(cache=True, nogil=True)
def _best_prefix(order, distance, area, bounds, free, box_area):  # type: ignore[no-untyped-def]
    total, total_square = 0.0, 0.0
    for r in order:
        total += area[r] * distance[r]
        total_square += area[r] * distance[r] ** 2
    variance = max(total_square / free - (total / free) ** 2, 1e-9)
    left, top, right, bottom = bounds[order[0]]
    near, weight, best, kept = 0.0, 0.0, -1.0, 0
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
        score = between / variance + TIGHTNESS * tight
        if score > best:
            best, kept = score, i + 1
    return kept
