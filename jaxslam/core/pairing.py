"""Pairs of the items of two sets, each of which has one partner at most."""

import numpy as np
from numpy.typing import ArrayLike


def one_to_one(pairs: ArrayLike, cost: ArrayLike) -> dict[int, int]:
    """Choose pairs greedily, those of least cost first, and each item once.

    Args:
        pairs: (K, 2) int items of the two sets that may be partners.
        cost: (K,) of each pair; of equal ones that with the lower items comes first.

    Returns:
        Item of the second set, by that of the first, in the order of their choice.
    """
    pairs = np.asarray(pairs, int).reshape(-1, 2)
    partner: dict[int, int] = {}
    taken: set[int] = set()
    for first, second in pairs[np.lexsort((*pairs.T[::-1], np.asarray(cost)))].tolist():
        if first not in partner and second not in taken:
            partner[first] = second
            taken.add(second)
    return partner
