"""Colours, figures, axes and legends of all plots.

The palette is that of Okabe and Ito, which is safe for colour-blind readers.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, RED, PINK = (
    *("#000000", "#E69F00", "#56B4E9", "#009E73"),
    *("#F0E442", "#0072B2", "#D55E00", "#CC79A7"),
)
GREY = "#8C8C8C"
NUM_SIGMAS = 3.0  # standard deviations that ellipses and bounds are drawn at


def canvas(
    width: float, height: float, rows: int = 1, columns: int = 1
) -> tuple[Figure, np.ndarray]:
    """Figure of a size [inch] at 100 dots per inch, and its axes (rows, columns)."""
    figure = Figure(figsize=(width, height), dpi=100, layout="constrained")
    shared = "col" if rows > 1 else False
    return figure, figure.subplots(rows, columns, squeeze=False, sharex=shared)


def map_canvas(low: np.ndarray, high: np.ndarray) -> tuple[Figure, Axes]:
    """Figure 900 dots wide, of the rectangle from `low` (2,) to `high` (2,) [m, world frame]."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    margin = 0.03 * np.max(high - low) + 0.2
    low, high = low - margin, high + margin
    width, height = high - low
    figure, axes = canvas(9.0, float(np.clip(8.2 * height / width, 2.5, 9.0)) + 1.1)
    axis = axes[0, 0]
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axis.set(xlabel="x [m]", ylabel="y [m]")
    return figure, axis


def extent(*groups: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounding box, lowest and highest x, y (2,) [m], of points (N, 2) or poses (N, 3)."""
    points = np.concatenate([np.asarray(group)[:, :2] for group in groups])
    points = points[np.isfinite(points).all(axis=1)]
    return points.min(axis=0), points.max(axis=0)


def legend(figure: Figure) -> None:
    """Add one legend below all axes of a figure."""
    figure.legend(loc="outside lower center", ncols=4, frameon=False)
