"""Charts: pose errors over the scans of a log; losses and parameters over a tuning."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from jaxslam.core.types import AnyArray, as_float64
from jaxslam.viz.canvas import BLACK, BLUE, GREEN, GREY, NUM_SIGMAS, ORANGE, PINK, RED, SKY


def draw_errors(
    axes: Sequence[Axes] | np.ndarray,
    cov: AnyArray,
    error: AnyArray | None = None,
    scans: AnyArray | None = None,
) -> None:
    """Draw the errors of heading, y and x with their 3-sigma bounds over the scans.

    Args:
        axes: (3,) axes, top to bottom.
        cov: (T, 3, 3) pose covariance [m, m, rad].
        error: (T, 3) pose error [m, m, rad]; None: only the bounds are drawn.
        scans: (T,) number of each scan in the log; by default 0 .. T - 1.

    Raises:
        ValueError: An argument has another shape.

    References:
        Paper, Fig. 13.
    """
    if len(axes) != 3:
        raise ValueError(f"axes has {len(axes)} axes, not 3: heading, y and x")
    cov = as_float64("cov", cov, ("T", 3, 3))
    error = None if error is None else as_float64("error", error, (len(cov), 3))
    bound = NUM_SIGMAS * np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2), 0.0))  # (T, 3)
    scan = np.arange(len(bound)) if scans is None else as_float64("scans", scans, (len(cov),))
    rows = (("heading [deg]", 2, 180 / np.pi), ("y [m]", 1, 1.0), ("x [m]", 0, 1.0))
    for axis, (name, column, factor) in zip(axes, rows, strict=True):
        high = factor * bound[:, column]
        axis.fill_between(scan, -high, high, color=SKY, alpha=0.35, linewidth=0)
        axis.plot(scan, high, color=BLUE, linewidth=1.0, label=f"{NUM_SIGMAS:g}-sigma bound")
        axis.plot(scan, -high, color=BLUE, linewidth=1.0)
        if error is not None:
            axis.plot(scan, factor * error[:, column], color=BLACK, linewidth=1.2, label="error")
        axis.axhline(0.0, color=GREY, linewidth=0.6)
        axis.set(ylabel=name, xlim=(0, max(scan.max(initial=0), 1)))
        axis.margins(y=0.08)
    axes[-1].set_xlabel("scan")
    axes[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)


def draw_losses(axis: Axes, training: AnyArray, heldout: AnyArray, best: int) -> None:
    """Draw the losses of a tuning.

    Args:
        axis: Axis to draw on.
        training: (N,) training loss of each evaluation.
        heldout: (N,) loss of the held-out episodes; NaN where not evaluated.
        best: Index of the best evaluation.

    Raises:
        ValueError: An argument has another shape.
    """
    training = as_float64("training", training, ("N",))
    heldout = as_float64("heldout", heldout, (len(training),))
    evaluation = np.arange(len(training))
    axis.plot(evaluation, training, color=SKY, label="training")
    known = np.isfinite(heldout)
    if known.any():
        axis.plot(evaluation[known], heldout[known], color=ORANGE, linestyle="--", label="held out")
    axis.axvline(best, color=GREY, linewidth=0.8, label="best")
    axis.set(xlabel="evaluation", ylabel="loss")
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    axis.legend(frameon=False)


def draw_parameters(axis: Axes, names: Sequence[str], history: AnyArray, best: int) -> None:
    """Draw the parameters over the evaluations of a tuning, relative to their initial values.

    Args:
        axis: Axis to draw on.
        names: (P,) names of the parameters.
        history: (N, P) parameters of each evaluation.
        best: Index of the best evaluation.

    Raises:
        ValueError: `history` has another shape.
    """
    history = as_float64("history", history, ("N", len(names)))
    colours = (BLACK, ORANGE, SKY, GREEN, BLUE, RED, PINK, GREY)
    styles = ("-", "--", "-.", ":")
    for index, (name, values) in enumerate(zip(names, history.T, strict=True)):
        colour, style = colours[index % len(colours)], styles[index % len(styles)]
        axis.plot(values / values[0], label=name, color=colour, linestyle=style)
    axis.axvline(best, color=GREY, linewidth=0.8)
    axis.set(xlabel="evaluation", ylabel="noise / initial noise", yscale="log")
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_formatter(NullFormatter())
    axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
