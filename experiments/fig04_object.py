"""Fig. 4 of the paper: edge codes of a box, and the diagram around it in both label modes."""

from pathlib import Path

import numpy as np

from experiments.common import (
    BLACK,
    BLUE,
    GREEN,
    GRID,
    LABEL_KEYS,
    ORANGE,
    PINK,
    RED,
    SKY,
    Numbers,
    canvas,
    cut,
    draw_picture,
    local_diagram,
    parse,
    picture,
    save,
    scan_of,
)
from jaxslam.core.scan import Lidar
from jaxslam.frontend.edge_codes import edge_codes
from jaxslam.frontend.grid import centres, rasterise
from jaxslam.frontend.voronoi import block_union, branch_cells

WINDOW = (-0.25, 3.25, -2.25, 2.25)
FRONT = (1.35, 1.45, 0.45, 0.85)  # the face of the box across the sensor axis
SIDE = (1.55, 1.95, 0.25, 0.35)  # and the one along it, both without their common corner
CORNER = (1.35, 1.45, 0.25, 0.35)  # where they meet
COLOURS = {1: BLACK, 2: ORANGE, 3: SKY, 4: GREEN, 5: BLUE, 6: PINK}


def labels_of(face: tuple[float, ...], labels: np.ndarray) -> int:
    """Union of the label bits of the sources on a face."""
    return int(np.bitwise_or.reduce(cut(labels, face), axis=None))


def between_faces(diagram, sources: np.ndarray) -> Numbers:
    """Branch cells within 1 m of the box that separate the regions of its two faces.

    Edge codes give the corner of the box its own label. There the region of the corner separates
    the faces, with a branch on either side.
    """
    labels = np.asarray(diagram.labels)
    starts = np.where(sources, labels, 0)
    front, side, corner = (labels_of(face, starts) for face in (FRONT, SIDE, CORNER))
    corner &= ~(front | side)
    near = np.asarray(block_union(np.where(sources, 0, labels)))
    x, y = np.moveaxis(np.asarray(centres(GRID)), -1, 0)
    close = np.hypot(x - CORNER[0] - 0.05, y - CORNER[2] - 0.05) < 1.0
    branch = np.asarray(branch_cells(diagram, sources)) & close

    def touching(*regions: int) -> int:
        return int((branch & np.all([near & region != 0 for region in regions], axis=0)).sum())

    direct, first, second = touching(front, side), touching(front, corner), touching(corner, side)
    return {
        "faces_differ": front & side == 0 and front != 0 and side != 0,
        "between_faces_cells": direct,
        "front_and_corner_cells": first,
        "corner_and_side_cells": second,
        "holds": front & side == 0 and (direct >= 4 or min(first, second) >= 4),
    }


def compute() -> Numbers:
    """Codes of the cells, and in each mode the diagram and the branch between the faces."""
    lidar = Lidar()
    code = edge_codes(GRID, rasterise(lidar, GRID, scan_of("fig04", lidar)))
    diagrams = {LABEL_KEYS[mode]: local_diagram("fig04", mode) for mode in ("codes", "segments")}
    return {
        "window_m": WINDOW,
        "codes": ["".join(str(c) if c else "." for c in row) for row in cut(code, WINDOW).tolist()],
        "branch_between_faces": {key: between_faces(*pair) for key, pair in diagrams.items()},
        "pictures": {key: picture(*pair, WINDOW) for key, pair in diagrams.items()},
    }


def draw_codes(axis, lines: list[str], window: list[float]) -> None:
    """Draw the edge codes, each with its number."""
    low, high, right, left = window
    height, width = (high - low) / len(lines), (left - right) / len(lines[0])
    for code, colour in COLOURS.items():
        cells = [
            (i, j) for i, line in enumerate(lines) for j, c in enumerate(line) if c == str(code)
        ]
        for i, j in cells:
            x, y = low + i * height, right + j * width
            axis.fill([y, y + width, y + width, y], [x, x, x + height, x + height], color=colour)
        if cells:
            axis.fill([], [], color=colour, label=f"e{code}")
    axis.legend(loc="center right", fontsize=9)
    axis.plot(0, 0, "^", color=RED, markersize=8, clip_on=False)
    axis.set(xlim=(left, right), ylim=(low, high), aspect="equal", title="edge codes")
    axis.set(xlabel="y, to the left [m]", ylabel="x, ahead [m]")


def draw(numbers: Numbers, path: Path) -> None:
    """Draw the codes and both diagrams."""
    figure, axes = canvas(9.4, 3.2, 1, 3)
    draw_codes(axes[0, 0], numbers["codes"], numbers["window_m"])
    for axis, mode in zip(axes[0, 1:], ("codes", "segments"), strict=True):
        draw_picture(axis, numbers["pictures"][LABEL_KEYS[mode]])
        axis.set_title(f"diagram, labels: {mode}")
        axis.label_outer()
    figure.savefig(path)


def main(argv: list[str] | None = None) -> None:
    """Run the experiment."""
    args = parse(__doc__, argv)
    save(args.out, "fig04_object", compute(), draw)


if __name__ == "__main__":
    main()
