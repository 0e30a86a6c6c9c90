"""One page on a tuning: what it changed, how sure that is, and whether the filter is consistent."""

import textwrap
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec

from jaxslam.evaluation.filter_consistency import ConsistencyReport
from jaxslam.viz.canvas import BLACK, BLUE, GREY, ORANGE, RED
from jaxslam.viz.charts import draw_losses
from jaxslam.viz.consistency_charts import draw_autocorrelation, draw_pit, draw_squares
from jaxslam.viz.parameter_charts import Estimate, draw_correlations, draw_estimates

SIZE = 8.27, 11.69  # [inch] A4
DOTS_PER_INCH = 150
CHARACTERS = 132  # of a line of text across the page
CHARACTER_WIDTH = 0.055  # [inch] of names
MAX_LINES = 4  # of findings of each state, and of notes


class TuningPage(NamedTuple):
    """All that is on the page.

    Attributes:
        title: What was tuned, on what.
        subtitle: How, and what it is evaluated on.
        before: Consistency of the filter before, on what it is evaluated on; None: not known.
        after: Consistency after.
        estimates: The parameters.
        correlation: (F, F) of those that were tuned, in their order; None: not known.
        training: (N,) loss of each evaluation.
        heldout: (N,) loss of held-out data; NaN where not evaluated.
        best: The best evaluation.
        errors: Rows of a table: name, before, after.
        notes: Warnings, one each.
        series: What the series are whose whiteness is drawn.
    """

    title: str
    subtitle: str
    before: ConsistencyReport | None
    after: ConsistencyReport | None
    estimates: Sequence[Estimate]
    correlation: np.ndarray | None
    training: np.ndarray
    heldout: np.ndarray
    best: int
    errors: Sequence[tuple[str, float | None, float | None]]
    notes: Sequence[str] = ()
    series: str = "innovations"


def tuning_page(page: TuningPage) -> Figure:
    """Draw the page.

    title
    errors before and after    | losses
    NIS against chi-square     | NEES
    probability transforms     | autocorrelation of innovations
    parameters with intervals  | correlations between them
    findings in words, before and after; warnings
    """
    from matplotlib import rc_context

    with rc_context({"font.size": 7, "axes.titlesize": 8, "axes.linewidth": 0.6}):
        figure = Figure(figsize=SIZE, dpi=DOTS_PER_INCH)
        text = _lines(page)
        rows = 1.5, 1.9, 1.7, 0.9 + 0.19 * max(len(page.estimates), 6), 0.25 + 0.15 * len(text)
        grid = GridSpec(
            5, 2, figure=figure, height_ratios=rows, hspace=0.42, wspace=0.24,
            left=0.085, right=0.975, top=0.93, bottom=0.015,
        )  # fmt: skip
        figure.text(0.085, 0.985, page.title, va="top", fontsize=11, fontweight="bold")
        figure.text(0.085, 0.967, page.subtitle, va="top", color=GREY)
        _draw_errors(figure.add_subplot(grid[0, 0]), page.errors)
        losses = figure.add_subplot(grid[0, 1])
        draw_losses(losses, page.training, page.heldout, page.best)
        losses.set_title("Loss", loc="left", fontweight="bold")
        _draw_consistency(figure, grid, page)
        _draw_parameters(figure, grid, page)
        _write(figure.add_subplot(grid[4, :]), text)
    return figure


def _draw_errors(axis: Axes, rows: Sequence[tuple[str, float | None, float | None]]) -> None:
    """Draw the table of errors before and after."""
    axis.axis("off")
    axis.set_title("What changed", loc="left", fontweight="bold")
    columns = ((0.0, "left"), (0.66, "right"), (0.83, "right"), (1.0, "right"))
    step = 1.0 / max(len(rows) + 1, 7)

    def write(line: int, cells: Sequence[str], color: str = BLACK) -> None:
        for (x, side), cell in zip(columns, cells, strict=True):
            axis.text(x, 0.97 - line * step, cell, ha=side, va="top", color=color)

    write(0, ("", "before", "after", "change"), color=GREY)
    for line, (name, before, after) in enumerate(rows, start=1):
        change = ""
        if before is not None and after is not None and before > 0.0 and after > 0.0:
            change = f"{after / before - 1.0:+.0%}"
        cells = ["-" if x is None or not np.isfinite(x) else f"{x:.4g}" for x in (before, after)]
        write(line, (name, *cells, change))


def _draw_consistency(figure: Figure, grid: GridSpec, page: TuningPage) -> None:
    """Draw NIS, NEES, their transforms and the autocorrelation."""
    before, after = page.before, page.after
    for column, name in enumerate(("NIS", "NEES")):
        axis = figure.add_subplot(grid[1, column])
        what = "innovations" if name == "NIS" else "errors against the truth"
        axis.set_title(f"{name}: {what}", loc="left", fontweight="bold")
        fit, old = (getattr(r, name.lower()) if r is not None else None for r in (after, before))
        if fit is None:
            _say(axis, "no ground truth" if after is not None else "no measurement was used")
        else:
            draw_squares(axis, fit, old, name)
    inner = grid[2, 0].subgridspec(1, 2, wspace=0.08)
    first = None
    for column, name in enumerate(("NIS", "NEES")):
        axis = figure.add_subplot(inner[column], sharey=first)
        axis.set_title(f"{name}: probabilities", loc="left", fontweight="bold")
        fit, old = (getattr(r, name.lower()) if r is not None else None for r in (after, before))
        if fit is None:
            _say(axis, "no ground truth" if after is not None else "no measurement was used")
            continue
        draw_pit(axis, fit, old)
        axis.set_xticks([0.0, 0.5, 1.0], ["0", "0.5", "1"])
        if first is not None:
            axis.set_ylabel("")
            axis.tick_params(labelleft=False)
        first = first or axis
    axis = figure.add_subplot(grid[2, 1])
    series = "NIS" if after is not None and after.whiteness is None else page.series
    axis.set_title(f"Whiteness: {series}", loc="left", fontweight="bold")
    if after is None:
        _say(axis, "no measurement was used")
    elif after.whiteness is None:
        draw_autocorrelation(axis, after.nis_whiteness, before and before.nis_whiteness)
    else:
        draw_autocorrelation(axis, after.whiteness, before and before.whiteness)


def _draw_parameters(figure: Figure, grid: GridSpec, page: TuningPage) -> None:
    """Draw the parameters, positive ones and others apart, and their correlations."""
    kinds = [[e for e in page.estimates if e.positive == positive] for positive in (True, False)]
    kinds = [kind for kind in kinds if kind]
    correlation = page.correlation
    known = correlation is not None and len(correlation) > 1
    # Widths [inch]: of names beyond what the margin holds, the chart, its values, names, matrix.
    left, right = (
        CHARACTER_WIDTH * max((len(text(each)) for each in page.estimates), default=0)
        for text in (lambda each: each.label, lambda each: each.name)
    )
    left, values, matrix = max(0.0, left - 0.35), 1.35, 2.3 if known else 0.0
    widths = left, 7.1 - left - values - right - matrix, values, right, matrix
    outer = grid[3, :].subgridspec(1, 5, width_ratios=np.maximum(widths, 0.01), wspace=0.0)
    inner = outer[1].subgridspec(
        max(len(kinds), 1), 1, height_ratios=[len(kind) + 1 for kind in kinds] or None, hspace=0.5
    )
    for row, kind in enumerate(kinds):
        axis = figure.add_subplot(inner[row])
        draw_estimates(axis, kind)
        if row == 0:
            axis.set_title("Parameters", loc="left", fontweight="bold")
    if correlation is not None and known:
        tuned = [each.name for each in page.estimates if not each.frozen]
        axis = figure.add_subplot(outer[4])
        draw_correlations(axis, tuned, correlation)
        axis.set_title("Correlations", loc="left", fontweight="bold")


def _say(axis: Axes, text: str) -> None:
    """Write why an axis is empty."""
    axis.text(0.5, 0.5, text, ha="center", va="center", color=GREY, transform=axis.transAxes)
    axis.set(xticks=[], yticks=[])


def _lines(page: TuningPage) -> list[tuple[str, str, bool]]:
    """Lines of the text: words, colour, and whether they are a heading."""
    lines: list[tuple[str, str, bool]] = []

    def add(title: str, colour: str, paragraphs: Sequence[str]) -> None:
        lines.append((title, colour, True))
        kept = list(paragraphs[:MAX_LINES])
        if len(paragraphs) > MAX_LINES:
            kept.append(f"and {len(paragraphs) - MAX_LINES} more in metrics.json")
        for paragraph in kept:
            words = paragraph.replace("+-", "\N{PLUS-MINUS SIGN}")
            wrapped = textwrap.wrap(words, CHARACTERS, subsequent_indent="    ")
            lines.extend((line, BLACK, False) for line in wrapped)

    nothing = ["no measurement updated the filter"]
    add("Findings before", ORANGE, page.before.verdicts if page.before else nothing)
    add("Findings after", BLUE, page.after.verdicts if page.after else nothing)
    if page.notes:
        add("Warnings", RED, page.notes)
    return lines


def _write(axis: Axes, lines: Sequence[tuple[str, str, bool]]) -> None:
    """Write lines of text, headings in bold."""
    axis.axis("off")
    line, step = 0.0, 1.0 / max(sum(1.5 if heading else 1.0 for _, _, heading in lines), 1.0)
    for text, colour, heading in lines:
        line += 0.5 * step if heading else 0.0
        weight = "bold" if heading else "normal"
        axis.text(0.0, 1.0 - line, text, va="top", color=colour, fontweight=weight)
        line += step
