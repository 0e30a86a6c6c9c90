"""The order in which places are visited: a short closed tour or open walk.

The nearest neighbour first, then 2-opt and Or-opt until neither makes it shorter. An open walk is a
tour through one more place that is at no distance from any other, and is cut there.

References:
    Croes (1958), A method for solving traveling-salesman problems. Or (1976), Traveling
    salesman-type combinatorial problems and their relation to the logistics of regional blood
    banking.
"""

import numpy as np

LONGEST_MOVED = 3  # places in succession that Or-opt moves together
_LEAST = 1e-9  # of the longest distance, by which a change makes the tour shorter, at least


def visiting_order(distance: np.ndarray, *, closed: bool, first: bool) -> list[int]:
    """Indices of K places in the order of the visit; a closed tour ends with its first.

    Args:
        distance: (K, K) finite, symmetric, zero on the diagonal.
        closed: Whether it ends where it begins.
        first: Whether it begins at place 0; an open walk begins at any otherwise.
    """
    count = len(distance)
    if count < 2:
        return [0] * (count + closed)
    scale = float(distance.max())
    if closed:
        table = np.asarray(distance, float)
    else:
        table = np.pad(np.asarray(distance, float), ((0, 1), (0, 1)))
        if first:  # nothing but the cut is so near to place 0
            table[0, count] = table[count, 0] = -2.0 * scale * count
    tour = _nearest_first(table)
    while _two_opt(tour, table, scale * _LEAST) or _or_opt(tour, table, scale * _LEAST):
        pass
    tour = np.roll(tour, -int(np.flatnonzero(tour == (0 if closed else count))[0]))
    if closed:
        return [*tour.tolist(), 0]
    order: list[int] = tour[1:].tolist()
    return order[::-1] if first and order[0] != 0 else order


def _nearest_first(table: np.ndarray) -> np.ndarray:
    """Tour (K,) from the last place to the nearest one that is left, again and again."""
    left = np.ones(len(table), bool)
    tour = [len(table) - 1]
    for _ in range(len(table) - 1):
        left[tour[-1]] = False
        tour.append(int(np.where(left, table[tour[-1]], np.inf).argmin()))
    return np.array(tour)


def _two_opt(tour: np.ndarray, table: np.ndarray, least: float) -> bool:
    """Turn parts of a tour (K,) round where that makes it shorter, in place; was there one?"""
    changed = False
    for i in range(len(tour) - 1):
        # Edges (i, i + 1) and (j, j + 1) become (i, j) and (i + 1, j + 1).
        here, following = tour[i + 1 :], np.roll(tour, -1)[i + 1 :]
        gain = table[tour[i], tour[i + 1]] + table[here, following]
        gain -= table[tour[i], here] + table[tour[i + 1], following]
        j = int(gain.argmax())
        if gain[j] > least:
            tour[i + 1 : i + 2 + j] = tour[i + 1 : i + 2 + j][::-1].copy()
            changed = True
    return changed


def _or_opt(tour: np.ndarray, table: np.ndarray, least: float) -> bool:
    """Move a few places in succession to where the tour (K,) gets shorter, in place; was there?"""
    changed = False
    for size in range(1, min(LONGEST_MOVED, len(tour) - 2) + 1):
        for place in tour.tolist():
            turned = np.roll(tour, -int(np.flatnonzero(tour == place)[0]))
            part, rest = turned[:size], turned[size:]
            first, last, following = part[0], part[-1], np.roll(rest, -1)
            saved = table[rest[-1], first] + table[last, rest[0]] - table[rest[-1], rest[0]]
            ahead = table[rest, first] + table[last, following]
            back = table[rest, last] + table[first, following]
            added = np.minimum(ahead, back) - table[rest, following]
            k = int(added.argmin())
            if saved - added[k] > least:
                part = part if ahead[k] <= back[k] else part[::-1]
                tour[:] = np.concatenate([rest[: k + 1], part, rest[k + 1 :]])
                changed = True
    return changed
