"""Precision against recall of methods of place recognition."""

import numpy as np

from experiments.common import Numbers

PRECISION = 0.99  # at which methods are compared
METHODS = {"places": "place recognition", "search": "search everywhere", "pairs": "landmark pairs"}


def curve(rows: list[Numbers], method: str) -> list[tuple[float, float]]:
    """Recall and precision of a method, by its least confidence; the highest first."""
    known = sum(row["in_map"] for row in rows)
    order = sorted(rows, key=lambda row: -row[method]["confidence"])
    right = np.cumsum([row[method]["right"] for row in order])
    found = np.cumsum([row[method]["right"] and row["in_map"] for row in order])
    taken = np.arange(1, len(rows) + 1)
    return list(zip((found / max(known, 1)).tolist(), (right / taken).tolist(), strict=True))


def recall_at(points: list[tuple[float, float]], precision: float = PRECISION) -> float:
    """The largest recall of a curve at no less than a precision; 0 if there is none."""
    return max((recall for recall, p in points if p >= precision), default=0.0)
