"""Cells between gaps as regions; parts too small for a region join a neighbour."""

from collections.abc import Callable

import numpy as np
from scipy import ndimage

from jaxslam.mapping.gaps import Gaps, line_cells

NICHE_WIDENING = 1.25  # of a niche behind its gaps, at most
NICHE_LENGTH = 2.0  # of a niche, at least, relative to its width
MIN_WIDENING = 2.5  # [cells] of it, that are noise

_FOUR = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])


def divide(
    free: np.ndarray,
    distance: np.ndarray,
    gaps: Gaps,
    *,
    unseen: Callable[[], np.ndarray],
    min_area: float,
    min_radius: float,
    niche_area: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Divide free space along gaps.

    A part smaller than `min_area`, or without a cell `min_radius` away from all obstacles, joins
    the neighbour behind its widest gap; it is no region if it has none. A niche is part of its
    neighbour: it has no other, does not go on in unseen space, is smaller than `niche_area`, long,
    and no wider than its gaps, as the space beside a bed, or between furniture and walls.

    Args:
        free: (H, W) bool; its border is not free.
        distance: (H, W) [cells] to the nearest obstacle.
        gaps: K gaps.
        unseen: Gives (H, W) bool, cells around the map that are not known.
        min_area: [cells] of a region.
        min_radius: [cells] of the largest circle in a region.
        niche_area: [cells] of a region with one neighbour that is no wider than its gaps.

    Returns:
        Label (H, W) int32 of the cells, 0 for none, others from 1 on without a break; and labels
        (K, 2) on the two sides of each gap, 0 for none.
    """
    lines = [line_cells(feet) for feet in gaps.feet]
    is_cut = np.zeros(free.shape, bool)
    for line in lines:
        is_cut[tuple(line.T)] = True
    is_cut &= free
    part, count = ndimage.label(free & ~is_cut)
    sides = _sides(part, lines, gaps)
    area = np.bincount(part.ravel(), minlength=count + 1)
    radius = largest(distance, part, count)
    region = _merged(sides, gaps.width, area, radius, min_area, min_radius)
    niches = _niches(region, sides, gaps.width, area, radius, niche_area)
    if niches:
        front = np.bincount(region[part[ndimage.binary_dilation(unseen())]], minlength=count + 1)
        region = _with_niches(region, niches, front)
    label = region[part]
    _fill_cuts(label, np.argwhere(is_cut))
    return label, region[sides]


def largest(values: np.ndarray, label: np.ndarray, count: int) -> np.ndarray:
    """Largest of some values (H, W) >= 0 in each label (count + 1,); 0 for the label 0."""
    found = np.zeros(count + 1)
    inside = label > 0
    np.maximum.at(found, label[inside], values[inside])
    return found


def _sides(part: np.ndarray, lines: list[np.ndarray], gaps: Gaps) -> np.ndarray:
    """Part (K, 2) with most cells beside each gap: in front of its normal, and behind it."""
    sides = np.zeros((len(lines), 2), np.int64)
    for k, line in enumerate(lines):
        cells = np.concatenate([line + offset for offset in _FOUR])
        cells = cells[((cells >= 0) & (cells < part.shape)).all(axis=1)]
        ahead = (cells - gaps.middle[k]) @ gaps.normal[k]
        found = part[tuple(cells.T)]
        for side, here in enumerate((ahead > 0.0, ahead < 0.0)):
            names, counts = np.unique(found[here & (found > 0)], return_counts=True)
            sides[k, side] = names[counts.argmax()] if len(names) else 0
    return sides


def _merged(
    sides: np.ndarray,
    width: np.ndarray,
    area: np.ndarray,
    radius: np.ndarray,
    min_area: float,
    min_radius: float,
) -> np.ndarray:
    """Region (P + 1,) int32 of each of the parts 0 to P, numbered from 1 on; 0 is none."""
    owner = np.arange(len(area))
    area, radius = area.copy(), radius.copy()
    doors: dict[int, list[int]] = {p: [] for p in range(len(area))}
    for k, (a, b) in enumerate(sides.tolist()):
        if a and b and a != b:
            doors[a].append(k)
            doors[b].append(k)

    def find(p: int) -> int:
        while owner[p] != p:
            owner[p] = owner[owner[p]]
            p = int(owner[p])
        return p

    is_small = (area < min_area) | (radius < min_radius)
    waiting = np.flatnonzero(is_small)[1 if is_small[0] else 0 :]
    for p in waiting[np.lexsort((waiting, area[waiting]))].tolist():
        root = find(p)
        if area[root] >= min_area and radius[root] >= min_radius:
            continue
        for k in sorted(doors[root], key=lambda k: (-width[k], k)):
            other = next((find(s) for s in sides[k].tolist() if find(s) != root), root)
            if other != root:
                owner[root] = other
                area[other] += area[root]
                radius[other] = max(radius[other], radius[root])
                doors[other] += doors[root]
                break
    roots = np.array([find(p) for p in range(len(area))])
    kept = (area >= min_area) & (radius >= min_radius) & (roots == np.arange(len(area)))
    kept[0] = False
    number = np.where(kept, np.cumsum(kept), 0).astype(np.int32)
    return number[roots]


def _niches(
    region: np.ndarray,
    sides: np.ndarray,
    width: np.ndarray,
    part_area: np.ndarray,
    part_radius: np.ndarray,
    niche_area: float,
) -> list[tuple[int, int, float]]:
    """Regions that may be niches, small ones first: region, neighbour, width [cells] of its gap.

    Args:
        region: (P + 1,) int of each part.
        sides: (K, 2) parts on the two sides of each gap.
        width: (K,) [cells] of the gaps.
        part_area: (P + 1,) [cells]
        part_radius: (P + 1,) [cells] of the largest circle in each part.
        niche_area: [cells] of a niche, less than.
    """
    count = int(region.max()) + 1
    area, radius = np.bincount(region, part_area, count), np.zeros(count)
    np.maximum.at(radius, region, part_radius)
    pairs = region[sides]
    joins = (pairs > 0).all(axis=1) & (pairs[:, 0] != pairs[:, 1])
    is_long = area >= NICHE_LENGTH * (2.0 * radius) ** 2
    small = np.flatnonzero((area < niche_area) & is_long & (np.arange(count) > 0))
    found = []
    for k in small[np.argsort(area[small], kind="stable")].tolist():
        gaps = joins & (pairs == k).any(axis=1)
        around = np.setdiff1d(pairs[gaps], k)
        if len(around) == 1:
            narrowest = float(width[gaps].min())
            widest = max(NICHE_WIDENING * narrowest, narrowest + MIN_WIDENING)
            if 2.0 * radius[k] <= widest:
                found.append((k, int(around[0]), narrowest))
    return found


def _with_niches(
    region: np.ndarray, niches: list[tuple[int, int, float]], front: np.ndarray
) -> np.ndarray:
    """Region (P + 1,) int32 of each part, as `region`, with niches as parts of their neighbours.

    Args:
        region: (P + 1,) int of each part.
        niches: As of `_niches`.
        front: Number of cells of each region beside unseen ones; half a gap is no noise.
    """
    owner = np.arange(int(region.max()) + 1)
    for k, neighbour, width in niches:
        is_alone = owner[neighbour] == neighbour and (owner == k).sum() == 1
        if is_alone and front[k] < 0.5 * width:
            owner[k] = neighbour
    kept = owner == np.arange(len(owner))
    number = np.where(kept, np.cumsum(kept) - 1, 0).astype(np.int32)
    return np.asarray(number[owner[region]])


def _fill_cuts(label: np.ndarray, cells: np.ndarray) -> None:
    """Give the cells (n, 2) of cuts the label of a neighbour; changed in place."""
    last = np.array(label.shape) - 1
    for _ in range(2):
        cells = cells[label[tuple(cells.T)] == 0]
        beside = np.clip(cells[:, None] + _FOUR, 0, last)
        label[tuple(cells.T)] = label[beside[..., 0], beside[..., 1]].max(axis=1, initial=0)
