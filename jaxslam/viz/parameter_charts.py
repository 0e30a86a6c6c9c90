"""Charts of tuned parameters: before and after with intervals, and their correlations."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator, NullFormatter

from jaxslam.core.types import AnyArray, as_float64
from jaxslam.viz.canvas import BLUE, GREY, ORANGE, RED

NORMAL_QUANTILE = 1.959964  # of the 95 % interval
MAX_NUMBERS = 12  # parameters up to which the matrix of correlations has numbers


class Estimate(NamedTuple):
    """A parameter before and after a tuning.

    Attributes:
        name: Its name.
        before: Its value before.
        after: Its value after.
        std_error: Standard error of `after`, of its logarithm if it is positive; NaN or infinite:
            not known.
        positive: Whether it can only be positive; its axis is then logarithmic.
        frozen: Whether it was not tuned.
        identifiable: Whether the data determine it.
        unit: Its unit; "" for none.
    """

    name: str
    before: float
    after: float
    std_error: float = np.nan
    positive: bool = True
    frozen: bool = False
    identifiable: bool = True
    unit: str = ""

    @property
    def label(self) -> str:
        """Name and unit."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval, NaN where it is not known."""
        half = NORMAL_QUANTILE * self.std_error
        if not np.isfinite(half):
            return np.nan, np.nan
        if self.positive:
            return self.after * np.exp(-half), self.after * np.exp(half)
        return self.after - half, self.after + half


def draw_estimates(axis: Axes, estimates: Sequence[Estimate]) -> None:
    """Draw parameters before and after a tuning, with 95 % intervals, one row each.

    Positive parameters have a logarithmic axis in common. Others, whose units differ, are drawn as
    the change in standard errors; so all of one chart are of one kind.

    Args:
        axis: Axis to draw on.
        estimates: The parameters, all positive or all not.

    Raises:
        ValueError: There are none, or of both kinds.
    """
    if len({each.positive for each in estimates}) != 1:
        raise ValueError("estimates are none, or of both kinds; draw positive ones apart")
    positive = estimates[0].positive
    for row, each in enumerate(estimates):
        sure = each.identifiable and not each.frozen
        colour = GREY if each.frozen else BLUE if sure else RED
        before, after, low, high = _places(each)
        axis.plot([before, after], [row, row], color=GREY, linewidth=0.8, zorder=1)
        axis.plot(before, row, "o", color=ORANGE, markerfacecolor="white", markersize=4.5)
        if np.isfinite([low, high]).all():
            axis.plot([low, high], [row, row], color=colour, linewidth=2.5, alpha=0.6, zorder=2)
        axis.plot(after, row, "o" if sure else "x", color=colour, markersize=4.5, zorder=3)
        axis.annotate(
            _text(each), (1.0, row), (4, 0), xycoords=("axes fraction", "data"),
            textcoords="offset points", va="center", fontsize=6, color=colour,
        )  # fmt: skip
    axis.set_yticks(range(len(estimates)), [each.label for each in estimates])
    axis.set_ylim(len(estimates) - 0.4, -0.6)
    axis.grid(axis="x", linewidth=0.3)
    if positive:
        axis.set_xscale("log")
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.set_xlabel("value (open: before; bar: 95 % interval)")
    else:
        axis.xaxis.set_major_locator(MaxNLocator(5))
        axis.set_xlabel("change in standard errors (bar: 95 % interval)")


def _places(each: Estimate) -> tuple[float, float, float, float]:
    """Where a parameter before, after, and its interval are drawn."""
    if each.positive:
        return (each.before, each.after, *each.interval)
    unit = each.std_error if np.isfinite(each.std_error) and each.std_error > 0.0 else np.nan
    change = 0.0 if each.after == each.before else (each.after - each.before) / unit
    return 0.0, change, change - NORMAL_QUANTILE, change + NORMAL_QUANTILE


def _text(each: Estimate) -> str:
    """Values of a parameter, and how sure the last is."""
    change = f"{each.before:.3g} \N{RIGHTWARDS ARROW} {each.after:.3g}"
    if each.frozen:
        return f"{each.after:.3g}, frozen"
    if not each.identifiable:
        return f"{change}, not identifiable"
    if not np.isfinite(each.std_error):
        return change
    error = f"{each.std_error:.0%}" if each.positive else f"{each.std_error:.2g}"
    return f"{change} \N{PLUS-MINUS SIGN} {error}"


def draw_correlations(axis: Axes, names: Sequence[str], correlation: AnyArray) -> None:
    """Draw the matrix of correlations between the estimates of parameters.

    Args:
        axis: Axis to draw on.
        names: (P,) names of the parameters.
        correlation: (P, P) from -1 to 1; NaN where not known.

    Raises:
        ValueError: `correlation` has another shape.
    """
    count = len(names)
    correlation = as_float64("correlation", correlation, (count, count))
    axis.set_facecolor("#EEEEEE")  # where it is not known
    axis.imshow(correlation, cmap="RdBu_r", vmin=-1.0, vmax=1.0)
    axis.set_xticks(range(count), names, rotation=90)
    axis.set_yticks(range(count), names)
    axis.tick_params(length=0)
    if count > MAX_NUMBERS:
        return
    for i, j in np.argwhere(np.isfinite(correlation) & ~np.eye(count, dtype=bool)).tolist():
        value = correlation[i, j]
        colour = "white" if abs(value) > 0.6 else "black"
        axis.text(j, i, f"{value:.1f}", ha="center", va="center", fontsize=5, color=colour)
