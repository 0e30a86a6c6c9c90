"""Paths of svgelements as polylines."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

MAX_PIXELS = 1e12
MAX_PIECES = 10**5  # of a curve


def polylines_of(shape: Any, tolerance: float) -> Iterator[np.ndarray]:
    """Polylines (n, 2) [px] of a shape, within a tolerance [px] of its curves.

    Raises:
        ValueError: A coordinate is beyond `MAX_PIXELS` or not finite, or a curve needs more than
            `MAX_PIECES` segments.
    """
    import svgelements

    points: list[tuple[float, float]] = []
    # A shape that is turned or skewed keeps its transform apart from its numbers.
    for part in svgelements.Path(shape).segments(transformed=True):
        if isinstance(part, svgelements.Move):
            if len(points) > 1:
                yield np.array(points)
            points = _checked(part.end)
            continue
        if not points:
            if part.start is None:
                raise ValueError("a path does not begin with M")
            points = _checked(part.start)
        count = _pieces(part, tolerance)
        if count > MAX_PIECES:
            raise ValueError(f"a curve needs {count} segments")
        points += [(p.x, p.y) for p in (part.point(k / count) for k in range(1, count))]
        points += _checked(part.end)
    if len(points) > 1:
        yield np.array(points)


def _checked(*points: Any) -> list[tuple[float, float]]:
    """Coordinates of points; ValueError if one is beyond `MAX_PIXELS` or not finite."""
    for point in points:
        if not (abs(point.x) <= MAX_PIXELS and abs(point.y) <= MAX_PIXELS):
            raise ValueError(f"a coordinate is beyond {MAX_PIXELS:g}")
    return [(float(point.x), float(point.y)) for point in points]


def _pieces(part: Any, tolerance: float) -> int:
    """Number of segments for a part of a path.

    References:
        Wang, Shen, Zheng (1984): a Bezier curve of degree n with second differences of its control
        points of M at most is within n (n - 1) M / (8 k^2) of k segments at equal parameters.
    """
    import svgelements

    if isinstance(part, svgelements.Arc):
        _checked(part.start, part.center, part.end)
        radius = max(part.rx, part.ry)
        if not tolerance < radius <= MAX_PIXELS:
            return 4
        step = 2.0 * math.acos(1.0 - tolerance / radius)
        return max(1, math.ceil(abs(float(part.sweep)) / step))
    if isinstance(part, svgelements.QuadraticBezier):
        control = _checked(part.start, part.control, part.end)
    elif isinstance(part, svgelements.CubicBezier):
        control = _checked(part.start, part.control1, part.control2, part.end)
    else:
        return 1
    bend = np.diff(np.array(control), 2, axis=0)
    degree = len(control) - 1
    furthest = float(np.hypot(*bend.T).max())
    return max(1, math.ceil(math.sqrt(degree * (degree - 1) * furthest / (8.0 * tolerance))))
