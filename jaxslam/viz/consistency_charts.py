"""Charts of a filter's consistency: normalised squares, their transform, autocorrelation."""

import numpy as np
from matplotlib.axes import Axes

from jaxslam.evaluation.chi_square_fit import ChiSquareFit, histogram
from jaxslam.evaluation.whiteness import Whiteness
from jaxslam.viz.canvas import BLACK, BLUE, GREEN, GREY, ORANGE, PINK, RED, SKY

PIT_BINS = 20
MAX_DENSITY = 4.0  # drawn of the probability transform; what is higher is cut off
COLOURS = (BLUE, RED, GREEN, PINK, ORANGE)
MARKERS = ("o", "s", "^", "D", "v")


def draw_squares(
    axis: Axes, fit: ChiSquareFit, before: ChiSquareFit | None = None, name: str = "NIS"
) -> None:
    """Draw the histogram of NIS or NEES against the chi-square distribution.

    Several degrees of freedom are compared with the mixture of their distributions. The last bin
    holds all that is beyond the axis.

    Args:
        axis: Axis to draw on.
        fit: The squares.
        before: Those of an earlier state of the filter, drawn as an outline.
        name: What they are.
    """
    edges, counts, expected = histogram(fit)
    width = edges[1]
    edges = np.append(edges[:-1], edges[-2] + width)  # the last bin, which has no end, is drawn
    scale = 100.0 / fit.num_values
    axis.stairs(counts * scale, edges, fill=True, color=SKY, alpha=0.6, label=_label("after", fit))
    if before is not None:
        limits = np.append(edges[:-1], np.inf)
        _, old, _ = histogram(before, edges=limits)
        label = _label("before", before)
        axis.stairs(
            old * 100.0 / before.num_values, edges, color=ORANGE, linewidth=1.2, label=label
        )
    middle = (edges[1:] + edges[:-1]) / 2
    dof = np.unique(fit.dof[fit.dof > 0])
    which = f"{dof[0]}" if len(dof) == 1 else f"{dof[0]} to {dof[-1]}, mixed"
    axis.plot(
        middle, expected * scale, color=BLACK, linewidth=1.2, label=f"chi-square, dof {which}"
    )
    axis.set(
        xlabel=f"{name} of a step", ylabel="steps [%]", xlim=(0.0, edges[-1]), ylim=(0.0, None)
    )
    axis.annotate(
        "beyond", (edges[-1], 0), (-1, 3), textcoords="offset points", rotation=90, fontsize=5,
        ha="right", va="bottom", color=GREY,
    )  # fmt: skip
    axis.legend(frameon=False, loc="upper right")


def _label(when: str, fit: ChiSquareFit) -> str:
    low, high = fit.interval
    return f"{when}: {fit.per_dof:.2f} per dof ({low:.2f} to {high:.2f})"


def draw_pit(axis: Axes, fit: ChiSquareFit, before: ChiSquareFit | None = None) -> None:
    """Draw the probability integral transform of NIS or NEES, which is uniform if all is right.

    Args:
        axis: Axis to draw on.
        fit: The squares.
        before: Those of an earlier state of the filter, drawn as an outline.
    """
    edges = np.linspace(0.0, 1.0, PIT_BINS + 1)

    def density(of: ChiSquareFit) -> np.ndarray:
        return np.histogram(of.pit[of.dof > 0], edges)[0] * PIT_BINS / of.num_values

    half = 1.96 * np.sqrt((PIT_BINS - 1) / fit.num_values)
    axis.axhspan(max(1.0 - half, 0.0), 1.0 + half, color=GREY, alpha=0.3, linewidth=0)
    axis.axhline(1.0, color=BLACK, linewidth=0.8)
    axis.stairs(density(fit), edges, fill=True, color=SKY, alpha=0.6)
    if before is not None:
        axis.stairs(density(before), edges, color=ORANGE, linewidth=1.2)
    axis.set(xlim=(0.0, 1.0), xlabel="chi-square probability", ylabel="density")
    most = max(density(each).max() for each in (fit, before) if each is not None)
    axis.set_ylim(0.0, np.clip(1.1 * most, 2.0, MAX_DENSITY))


def draw_autocorrelation(axis: Axes, white: Whiteness, before: Whiteness | None = None) -> None:
    """Draw the autocorrelation of whitened innovations, and the band of white noise.

    Args:
        axis: Axis to draw on.
        white: The series.
        before: Those of an earlier state of the filter, drawn dashed; the same series.
    """
    lags = np.arange(1, white.autocorrelation.shape[1])
    axis.fill_between(
        lags, -white.band[:, 1:].max(axis=0), white.band[:, 1:].max(axis=0), color=GREY, alpha=0.3,
        linewidth=0, label="95 % if white",
    )  # fmt: skip
    axis.axhline(0.0, color=BLACK, linewidth=0.8)
    for k, name in enumerate(white.names):
        colour, marker = COLOURS[k % len(COLOURS)], MARKERS[k % len(MARKERS)]
        axis.plot(
            lags, white.autocorrelation[k, 1:], color=colour, marker=marker, markersize=2.5,
            linewidth=1.0, label=name,
        )  # fmt: skip
        if before is not None:
            old = before.autocorrelation[k, 1:]
            axis.plot(
                lags[: len(old)], old[: len(lags)], color=colour, linestyle=":", linewidth=1.0
            )
    axis.set(xlabel="lag [updates]", ylabel="autocorrelation", xlim=(0.5, len(lags) + 0.5))
    if before is not None:
        axis.plot([], [], color=GREY, linestyle=":", linewidth=1.0, label="before")
    low, high = axis.get_ylim()
    axis.set_ylim(min(low, -0.25), max(high, 0.25))
    axis.legend(frameon=False, ncols=2, loc="upper right")
