"""Fig. 6 of the paper: local diagrams of a corridor, in both label modes."""

from pathlib import Path

import numpy as np
from scipy.ndimage import label

from experiments.common import (
    GRID,
    LABEL_KEYS,
    Numbers,
    canvas,
    draw_picture,
    local_diagram,
    parse,
    picture,
    save,
)
from jaxslam.frontend.grid import centres
from jaxslam.frontend.voronoi import branch_cells, junction_cells

WINDOW = (-0.25, 6.05, -2.25, 2.25)
MEASURED = (0.25, 4.75)  # [m] along x
HALF = 1.1  # [m] to either side: branches beyond are in an alcove or behind a column
MODES = ("segments", "codes")
WORLDS = {
    "fig06a": "(a) parallel walls",
    "fig06b": "(b) an opening",
    "fig06c": "(c) a column",
    "fig06d": "(d) uneven walls",
}
CELL = GRID.cell_size


def measure(diagram, sources: np.ndarray) -> Numbers:
    """Position of the branches of a corridor.

    The middle line is, in each row of cells, the branch cell nearest to the one in the row before;
    branch cells more than a cell and a half away from it, sideways, are side branches.
    """
    x, y = np.moveaxis(np.asarray(centres(GRID)), -1, 0)
    inside = (x > MEASURED[0]) & (x < MEASURED[1]) & (np.abs(y) < HALF)
    branch = np.asarray(branch_cells(diagram, sources)) & inside
    profile, at, side_cells = [], 0.0, 0
    for row in np.flatnonzero(branch.any(axis=1)):
        cells = y[row, branch[row]]
        at = cells[np.argmin(np.abs(cells - at))]
        side_cells += int(np.sum(np.abs(cells - at) > 1.5 * CELL))
        profile.append([x[row, 0], at])
    line = np.array(profile)
    return {
        "offset_m": line.round(3),
        "largest_offset_m": round(float(np.abs(line[:, 1]).max()), 3),
        "rows_without_branch": int((inside.any(axis=1) & ~branch.any(axis=1)).sum()),
        "pieces": int(label(branch, np.ones((3, 3)))[1]),
        "side_branch_cells": side_cells,
        "junctions": int(
            label(np.asarray(junction_cells(diagram, sources)) & inside, np.ones((3, 3)))[1]
        ),
    }


def between(measured: Numbers, low: float, high: float) -> np.ndarray:
    """Offsets [m] of the middle line where x is between `low` and `high` [m]."""
    line = np.asarray(measured["offset_m"])
    return line[(line[:, 0] > low) & (line[:, 0] < high), 1]


def claims(measured: dict[str, Numbers]) -> Numbers:
    """Whether the paper's statements on Fig. 6 hold; in the middle means within a cell."""
    a, b, c, d = (measured[name] for name in WORLDS)
    bend, shift = between(b, 2.5, 3.5).min(), between(c, 2.5, 3.0).mean()
    return {
        "a_line_in_the_middle": bool(a["largest_offset_m"] <= CELL and a["pieces"] == 1),
        "a_no_false_branch": a["side_branch_cells"] == 0,
        "b_bends_to_the_opening": bool(bend <= -CELL),
        "b_largest_bend_m": round(float(bend), 3),
        "b_straight_before": bool(np.abs(between(b, 0.25, 2.0)).max() <= CELL),
        "c_shifts_to_the_right_wall": bool(abs(shift + 0.25) <= CELL),
        "c_shift_m": round(float(shift), 3),
        "c_middle_of_column_and_wall_m": -0.25,
        "d_line_in_the_middle": bool(d["largest_offset_m"] <= CELL and d["pieces"] == 1),
        "d_no_false_branch": d["side_branch_cells"] == 0 and d["junctions"] == 0,
    }


def compute() -> Numbers:
    """Diagram of each world in each label mode, measurements on it, and the paper's claims."""
    numbers: Numbers = {"claims": {}, "measured": {}, "pictures": {}}
    for mode in MODES:
        key = LABEL_KEYS[mode]
        diagrams = {name: local_diagram(name, mode) for name in WORLDS}
        measured = {name: measure(*pair) for name, pair in diagrams.items()}
        numbers["claims"][key] = claims(measured)
        numbers["measured"][key] = measured
        numbers["pictures"][key] = {name: picture(*pair, WINDOW) for name, pair in diagrams.items()}
    return numbers


def draw(numbers: Numbers, path: Path) -> None:
    """Draw worlds in columns and modes in rows."""
    figure, axes = canvas(9.4, 7.2, len(MODES), len(WORLDS))
    for column, (name, title) in enumerate(WORLDS.items()):
        for row, mode in enumerate(MODES):
            draw_picture(axes[row, column], numbers["pictures"][LABEL_KEYS[mode]][name])
        axes[0, column].set_title(title)
    for row, mode in enumerate(MODES):
        axes[row, 0].set_ylabel(f"labels: {mode}\nx, ahead [m]")
    for axis in axes.flat:
        axis.label_outer()
    figure.savefig(path)


def main(argv: list[str] | None = None) -> None:
    """Run the experiment."""
    args = parse(__doc__, argv)
    save(args.out, "fig06_local", compute(), draw)


if __name__ == "__main__":
    main()
