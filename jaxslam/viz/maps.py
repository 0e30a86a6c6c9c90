"""Map drawing: worlds, trajectories, arcs, occupancy grids.

Lines differ in style as well as in colour.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.transforms import Affine2D
from numpy.typing import ArrayLike

from jaxslam.core.maps import OccupancyMap, TopologicalMap
from jaxslam.core.se2_np import transform
from jaxslam.core.types import as_float64, check_array
from jaxslam.viz.canvas import BLACK, BLUE, GREEN, GREY, ORANGE, RED, SKY

if TYPE_CHECKING:
    from jaxslam.simulation.worlds import World

MAX_HITS = 40_000  # end points of beams drawn at most
MAX_PIXELS = 2000  # of a drawn grid, along its longer side

# Colour, line width, line style and zorder of each trajectory.
TRAJECTORY_STYLES: dict[str, tuple[str, float, Any, float]] = {
    "estimate": (SKY, 3.0, "-", 2.0),
    "truth": (BLACK, 1.2, (0, (4, 2)), 2.2),
    "reference": (BLACK, 1.2, (0, (4, 2)), 2.2),
    "odometry": (RED, 1.1, (0, (1, 1.2)), 2.1),
}


def draw_walls(axis: Axes, world: "World") -> None:
    """Draw the walls of a world."""
    lines = as_float64("world.walls", world.walls, ("N", 4)).reshape(-1, 2, 2)
    axis.add_collection(LineCollection(list(lines), colors=GREY, linewidths=1.4, label="wall"))


def draw_hits(axis: Axes, poses: ArrayLike, points: ArrayLike, hit: ArrayLike) -> None:
    """Draw the end points of the beams, at most `MAX_HITS` of them.

    Args:
        axis: Axis to draw on.
        poses: (T, 3) [m, m, rad] of the scans, world frame.
        points: (T, R, 2) end points of the beams [m, robot frame].
        hit: (T, R) bool, False where there is no return.

    Raises:
        ValueError: An argument has another shape or type.
    """
    poses, hit = as_float64("poses", poses, ("T", 3)), np.asarray(hit)
    check_array("hit", hit, (len(poses), "R"), np.bool_)
    points = as_float64("points", points, (*hit.shape, 2))
    scan, beam = np.nonzero(hit)
    stride = 1 + len(scan) // MAX_HITS
    scan, beam = scan[::stride], beam[::stride]
    x, y = transform(poses[scan], points[scan, beam]).T
    axis.plot(x, y, ",", color="#B5B5B5", zorder=0.5, label="_hits", rasterized=True)


def draw_trajectory(axis: Axes, poses: ArrayLike, what: str) -> None:
    """Draw a trajectory of the robot.

    Args:
        axis: Axis to draw on.
        poses: (T, 3) [m, m, rad], world frame.
        what: One of `TRAJECTORY_STYLES`; also its name in the legend.

    Raises:
        ValueError: `poses` has another shape, or `what` is unknown.
    """
    if what not in TRAJECTORY_STYLES:
        raise ValueError(f"what is {what!r}, not one of {', '.join(TRAJECTORY_STYLES)}")
    colour, width, style, zorder = TRAJECTORY_STYLES[what]
    x, y = as_float64("poses", poses, ("T", 3))[:, :2].T
    axis.plot(x, y, label=what, color=colour, linewidth=width, linestyle=style, zorder=zorder)


def draw_wrong_parts(axis: Axes, poses: ArrayLike, parts: Sequence[tuple[int, int]]) -> None:
    """Mark parts of a trajectory where the map contradicts itself; nothing without any.

    Args:
        axis: Axis to draw on.
        poses: (T, 3) [m, m, rad], map frame.
        parts: First and last index of each part.

    Raises:
        ValueError: `poses` has another shape.
    """
    xy = as_float64("poses", poses, ("T", 3))[:, :2]
    for k, (first, last) in enumerate(parts):
        x, y = xy[first : last + 1].T
        label = "_wrong" if k else "map contradicts itself"
        axis.plot(x, y, "o-", color=RED, markersize=8, linewidth=6, zorder=3.5, label=label)


def draw_probable_poses(axis: Axes, poses: ArrayLike, probability: ArrayLike) -> None:
    """Draw positions coloured by the probability that they are right, with a bar of the colours.

    Args:
        axis: Axis to draw on.
        poses: (T, 3) [m, m, rad], map frame.
        probability: (T,).

    Raises:
        ValueError: An argument has another shape.
    """
    x, y = as_float64("poses", poses, ("T", 3))[:, :2].T
    chance = as_float64("probability", probability, x.shape)
    order = np.argsort(chance, kind="stable")
    dots = axis.scatter(
        x[order], y[order], s=9, c=chance[order], cmap="cividis_r", vmin=0.0, vmax=1.0, zorder=2.0
    )
    axis.figure.colorbar(dots, ax=axis, shrink=0.6, label="probability")


def draw_robot(axis: Axes, pose: ArrayLike, ends: ArrayLike) -> None:
    """Draw the robot and its scan.

    Args:
        axis: Axis to draw on.
        pose: (3,) [m, m, rad], world frame.
        ends: (N, 2) end points of the beams [m, robot frame].

    Raises:
        ValueError: An argument has another shape.
    """
    x, y, heading = pose = as_float64("pose", pose, (3,))
    points = transform(pose, as_float64("ends", ends, ("N", 2)))
    axis.plot(
        points[:, 0], points[:, 1], ".", color=ORANGE, markersize=2.5, zorder=2.5, label="scan"
    )
    marker = (3, 0, np.degrees(heading) - 90)
    axis.plot(x, y, marker=marker, color=BLUE, markersize=10, zorder=4, label="_robot")


def draw_start_and_end(axis: Axes, poses: ArrayLike) -> None:
    """Mark the start S and the finish F of a trajectory (T, 3); raise ValueError if T is 0."""
    poses = as_float64("poses", poses, ("T", 3))
    if not len(poses):
        raise ValueError("poses is empty: it has no start")
    box = {"boxstyle": "circle,pad=0.15", "facecolor": "white", "edgecolor": BLACK}
    for name, pose in (("S", poses[0]), ("F", poses[-1])):
        x, y = pose[:2].tolist()
        axis.text(x, y, name, ha="center", va="center", fontsize=8, weight="bold", bbox=box)


def draw_markers(
    axis: Axes, xy: np.ndarray, marker: str, colour: str, label: str, zorder: float
) -> None:
    """Draw points (N, 2) as small markers with a white edge."""
    axis.plot(
        xy[:, 0],
        xy[:, 1],
        marker,
        linestyle="none",
        label=label,
        zorder=zorder,
        color=colour,
        markersize=4,
        markeredgecolor="white",
        markeredgewidth=0.4,
    )


def draw_arcs(axis: Axes, graph: TopologicalMap) -> None:
    """Draw the arcs of a topological map."""
    axis.add_collection(
        LineCollection(
            graph.arc_lines, label="arc", colors=GREEN, linewidths=1.0, alpha=0.6, zorder=1.5
        )
    )


def known_corners(grid: OccupancyMap) -> np.ndarray:
    """Corners (4, 2) [m, map frame] of the bounding box of the known cells of a grid.

    Raises:
        ValueError: No cell is known.
    """
    known = np.asarray(grid.occupied) | np.asarray(grid.free)
    rows, columns = (np.flatnonzero(known.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        raise ValueError("grid has no known cell, neither occupied nor free")
    low, high = (rows[0], columns[0]), (rows[-1] + 1, columns[-1] + 1)
    return _cells_to_map(grid).transform([low, (high[0], low[1]), high, (low[0], high[1])])


def _cells_to_map(grid: OccupancyMap) -> Affine2D:
    """The transform from cell indices to the map frame."""
    x, y, heading = as_float64("grid.origin", grid.origin, (3,)).tolist()
    return Affine2D().scale(grid.resolution).rotate(heading).translate(x, y)


def draw_occupancy(axis: Axes, grid: OccupancyMap) -> None:
    """Draw an occupancy grid: occupied cells dark, unknown ones grey.

    Of a large grid squares of cells are drawn, dark where any of them is occupied.

    Raises:
        ValueError: The cells do not have one shape (H, W).
    """
    occupied, free = np.asarray(grid.occupied), np.asarray(grid.free)
    check_array("grid.occupied", occupied, ("H", "W"), np.bool_)
    check_array("grid.free", free, occupied.shape, np.bool_)
    image = np.where(free, np.uint8(255), np.uint8(205))
    image[occupied] = 60
    side = max(1, -(-max(image.shape) // MAX_PIXELS))
    for k in range(2):
        image = np.minimum.reduceat(image, np.arange(0, image.shape[k], side), axis=k)
    limits = axis.get_xlim(), axis.get_ylim()
    axis.set_facecolor((205 / 255,) * 3)
    axis.imshow(
        image.T,
        origin="lower",
        extent=(0, side * image.shape[0], 0, side * image.shape[1]),
        transform=_cells_to_map(grid) + axis.transData,
        cmap="gray",
        vmin=0,
        vmax=255,
        interpolation="none",
        zorder=0.5,
    )
    axis.set(xlim=limits[0], ylim=limits[1], aspect="equal")


def draw_topological_map(axis: Axes, graph: TopologicalMap) -> None:
    """Draw the topological map of an occupancy grid; nodes, dead and open ends differ in marker."""
    xy = as_float64("graph.xy", graph.xy, ("N", 2))
    axis.add_collection(
        LineCollection(graph.arc_lines, label="arc", colors=BLUE, linewidths=1.1, zorder=1.5)
    )
    degree = np.bincount(np.ravel(graph.arc_ends), minlength=len(xy))
    for name, marker, colour, use in (
        ("node", "o", RED, degree != 1),
        ("dead end", "s", ORANGE, degree == 1),
    ):
        if use.any():
            draw_markers(axis, xy[use], marker, colour, name, 2)
    if graph.frontiers:
        axis.add_collection(
            LineCollection(graph.frontiers, colors=BLUE, linewidths=0.9, linestyles=":", zorder=1.4)
        )
        ends = np.array([line[-1] for line in graph.frontiers])
        draw_markers(axis, ends, "^", GREEN, "open end", 3)
