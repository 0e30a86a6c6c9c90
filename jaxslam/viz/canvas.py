"""Colours, figures, axes and legends of all plots.

The palette is that of Okabe and Ito, which is safe for colour-blind readers.
"""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from jaxslam.core.types import as_float64

BLACK = "#000000"
ORANGE = "#E69F00"
SKY = "#56B4E9"
GREEN = "#009E73"
YELLOW = "#F0E442"
BLUE = "#0072B2"
RED = "#D55E00"
PINK = "#CC79A7"
GREY = "#8C8C8C"
NUM_SIGMAS = 3.0  # standard deviations that ellipses and bounds are drawn at


def canvas(
    width: float, height: float, rows: int = 1, columns: int = 1
) -> tuple[Figure, np.ndarray]:
    """Figure of a size [inch] at 100 dots per inch, and its axes (rows, columns)."""
    figure = Figure(figsize=(width, height), dpi=100, layout="constrained")
    return figure, figure.subplots(
        rows, columns, squeeze=False, sharex="col" if rows > 1 else False
    )


def map_canvas(low: ArrayLike, high: ArrayLike) -> tuple[Figure, Axes]:
    """Figure 900 dots wide, with an axis for the map of a rectangle, in metres at one scale.

    Args:
        low: (2,) [m] lowest x, y, map frame; a margin is added.
        high: (2,) [m] highest x, y.

    Raises:
        ValueError: `low` or `high` is not two finite numbers, or `high` is below `low`.
    """
    lowest, highest = as_float64("low", low, (2,)), as_float64("high", high, (2,))
    if not (np.isfinite([lowest, highest]).all() and (lowest <= highest).all()):
        wanted = "which is no rectangle"
        raise ValueError(f"low is {lowest.tolist()} and high {highest.tolist()}, {wanted}")
    margin = 0.03 * np.max(highest - lowest) + 0.2
    lowest, highest = lowest - margin, highest + margin
    width, height = highest - lowest
    figure, axes = canvas(9.0, float(np.clip(8.2 * height / width, 2.5, 9.0)) + 1.1)
    axis = axes[0, 0]
    axis.set(xlim=(lowest[0], highest[0]), ylim=(lowest[1], highest[1]), aspect="equal")
    axis.set(xlabel="x [m]", ylabel="y [m]")
    return figure, axis


def extent(*groups: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Bounding box of points or poses; those that are not finite are left out.

    Args:
        *groups: (N, 2) points [m] or (N, 3) poses [m, m, rad], each.

    Returns:
        Lowest and highest x, y, (2,) [m] each.

    Raises:
        ValueError: A group has another shape, or no point is finite.
    """
    points = [as_float64(f"groups[{k}]", group, ("N", "D")) for k, group in enumerate(groups)]
    for k, group in enumerate(points):
        if group.shape[1] not in (2, 3):
            raise ValueError(f"groups[{k}] has the shape {group.shape}, not (N, 2) or (N, 3)")
    every = np.concatenate([np.zeros((0, 2)), *(group[:, :2] for group in points)])
    every = every[np.isfinite(every).all(axis=1)]
    if not len(every):
        raise ValueError("groups hold no finite point, and so have no extent")
    return every.min(axis=0), every.max(axis=0)


def legend(figure: Figure) -> None:
    """Add one legend below all axes of a figure."""
    figure.legend(loc="outside lower center", ncols=4, frameon=False)


def save(figure: Figure, path: Path) -> None:
    """Write a figure to a file; its layout is made first, so that it is drawn only once."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
    figure.set_layout_engine(None)
    figure.savefig(path)
