"""Map drawing: worlds, trajectories, landmarks, arcs, occupancy grids, local Voronoi diagrams.

Lines differ in style as well as in colour, and landmarks in shape.
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import to_rgb
from matplotlib.transforms import Affine2D

from jaxslam.core.features import Features
from jaxslam.core.maps import OccupancyMap, TopologicalMap
from jaxslam.core.se2_np import transform
from jaxslam.core.types import CORNER, JUNCTION, AnyArray, as_float64, check_array
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.covariance import slot_blocks
from jaxslam.frontend.automaton import Diagram
from jaxslam.frontend.grid import GridSpec
from jaxslam.frontend.voronoi import branch_cells
from jaxslam.simulation.worlds import World
from jaxslam.viz.canvas import BLACK, BLUE, GREEN, GREY, NUM_SIGMAS, ORANGE, PINK, RED, SKY, YELLOW

MAX_HITS = 40_000  # end points of beams drawn at most

# Colour, line width, line style and zorder of each trajectory.
TRAJECTORY_STYLES: dict[str, tuple[str, float, Any, float]] = {
    "estimate": (SKY, 3.0, "-", 2.0),
    "truth": (BLACK, 1.2, (0, (4, 2)), 2.2),
    "reference": (BLACK, 1.2, (0, (4, 2)), 2.2),
    "odometry": (RED, 1.1, (0, (1, 1.2)), 2.1),
}
# Marker, colour and legend name of each kind of landmark that has a position.
LANDMARK_STYLES = {JUNCTION: ("o", GREEN, "junction"), CORNER: ("s", ORANGE, "corner")}


def draw_walls(axis: Axes, world: World) -> None:
    """Draw the walls of a world."""
    lines = as_float64("world.walls", world.walls, ("N", 4)).reshape(-1, 2, 2)
    axis.add_collection(LineCollection(list(lines), colors=GREY, linewidths=1.4, label="wall"))


def draw_hits(axis: Axes, poses: AnyArray, points: AnyArray, hit: AnyArray) -> None:
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
    check_array("hit", hit, (len(poses), "R"), jnp.bool_)
    points = as_float64("points", points, (*hit.shape, 2))
    scan, beam = np.nonzero(hit)
    stride = 1 + len(scan) // MAX_HITS
    scan, beam = scan[::stride], beam[::stride]
    x, y = transform(poses[scan], points[scan, beam]).T
    axis.plot(x, y, ",", color="#B5B5B5", zorder=0.5, label="_hits", rasterized=True)


def draw_trajectory(axis: Axes, poses: AnyArray, what: str) -> None:
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


def draw_wrong_parts(axis: Axes, poses: AnyArray, parts: Sequence[tuple[int, int]]) -> None:
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


def draw_probable_poses(axis: Axes, poses: AnyArray, probability: AnyArray) -> None:
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


def draw_robot(axis: Axes, pose: AnyArray, ends: AnyArray) -> None:
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


def draw_start_and_end(axis: Axes, poses: AnyArray) -> None:
    """Mark the start S and the finish F of a trajectory (T, 3); raise ValueError if T is 0."""
    poses = as_float64("poses", poses, ("T", 3))
    if not len(poses):
        raise ValueError("poses is empty: it has no start")
    box = {"boxstyle": "circle,pad=0.15", "facecolor": "white", "edgecolor": BLACK}
    for name, pose in (("S", poses[0]), ("F", poses[-1])):
        x, y = pose[:2].tolist()
        axis.text(x, y, name, ha="center", va="center", fontsize=8, weight="bold", bbox=box)


def draw_ellipses(axis: Axes, xy: AnyArray, cov: AnyArray, color: str) -> None:
    """Draw the 3-sigma ellipses of points.

    Args:
        axis: Axis to draw on.
        xy: (N, 2) [m] centres.
        cov: (N, 2, 2) [m^2] covariances.
        color: Colour of the lines.

    Raises:
        ValueError: `xy` or `cov` has another shape.
    """
    xy = as_float64("xy", xy, ("N", 2))
    values, vectors = np.linalg.eigh(as_float64("cov", cov, (len(xy), 2, 2)))  # ascending
    width, height = 2 * NUM_SIGMAS * np.sqrt(np.maximum(values.T[::-1], 0.0))
    angle = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    axis.add_collection(
        EllipseCollection(
            width,
            height,
            angle,
            units="xy",
            offsets=xy,
            offset_transform=axis.transData,
            facecolors="none",
            edgecolors=color,
            linewidths=0.9,
            zorder=3,
        )
    )


def draw_landmarks(axis: Axes, belief: Belief, *, confirm_count: int) -> None:
    """Draw the junctions and corners of a belief, with their 3-sigma ellipses.

    Args:
        axis: Axis to draw on.
        belief: Belief of the filter.
        confirm_count: Least number of observations of a landmark.
    """
    count, kind = np.asarray(belief.num_seen), np.asarray(belief.kind)
    position, cov = np.asarray(belief.landmark_positions), np.asarray(slot_blocks(belief.map_cov))
    for drawn in LANDMARK_STYLES:
        use = (count >= confirm_count) & (kind == drawn)
        _draw_landmarks(axis, position[use], cov[use], drawn)


def _draw_landmarks(axis: Axes, xy: np.ndarray, cov: np.ndarray, kind: int) -> None:
    """Draw landmarks (N, 2) of one kind with the ellipses of their covariances (N, 2, 2)."""
    marker, colour, name = LANDMARK_STYLES[kind]
    _draw_markers(axis, xy, marker, colour, f"{name}, {NUM_SIGMAS:g}-sigma ellipse", 3.5)
    draw_ellipses(axis, xy, cov, colour)


def _draw_markers(
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


def draw_local_diagram(
    axis: Axes,
    diagram: Diagram,
    sources: AnyArray,
    spec: GridSpec,
    features: Features | None = None,
) -> None:
    """Draw the local Voronoi diagram of a scan in the robot frame: x up, y to the left.

    Args:
        axis: Axis to draw on.
        diagram: (H, W) Voronoi regions.
        sources: (H, W) bool, occupied cells that the regions grew from.
        spec: Grid of the cells.
        features: Features of the scan.

    Raises:
        ValueError: The diagram or the sources do not have the cells of the grid.
    """
    labels, sources = np.asarray(diagram.labels), np.asarray(sources)
    check_array("diagram.labels", labels, spec.shape)
    check_array("sources", sources, spec.shape, jnp.bool_)
    palette = np.array([to_rgb(colour) for colour in (SKY, ORANGE, GREEN, PINK, YELLOW, BLUE, RED)])
    lowest_bit = np.log2(np.maximum(labels & -labels.astype(np.int64), 1)).astype(int)
    cell_colours = palette[lowest_bit % len(palette)]
    image = np.where((labels != 0)[..., None], 0.3 * cell_colours + 0.7, 1.0)
    image[np.asarray(branch_cells(diagram, jnp.asarray(sources)))] = to_rgb(BLACK)
    image[sources] = 0.75 * cell_colours[sources]
    extent = (-spec.y_half, spec.y_half, spec.x_min, spec.x_max)
    axis.imshow(image, origin="lower", extent=extent, interpolation="none")
    axis.plot(0, 0, "^", color=RED, markersize=8, clip_on=False)
    if features is not None:
        xy, cov = np.asarray(features.xy)[:, ::-1], np.asarray(features.cov)[:, ::-1, ::-1]
        for kind in LANDMARK_STYLES:
            use = np.asarray(features.valid & (features.kind == kind))
            _draw_landmarks(axis, xy[use], cov[use], kind)
    axis.set(xlim=(spec.y_half, -spec.y_half), ylim=(spec.x_min, spec.x_max), aspect="equal")
    axis.set(xlabel="y (left) [m]", ylabel="x (forward) [m]")


def known_corners(grid: OccupancyMap) -> np.ndarray:
    """Corners (4, 2) [m, map frame] of the bounding box of the known cells of a grid.

    Raises:
        ValueError: No cell is known.
    """
    known = np.argwhere(np.asarray(grid.occupied) | np.asarray(grid.free))
    if not len(known):
        raise ValueError("grid has no known cell, neither occupied nor free")
    low, high = known.min(axis=0), known.max(axis=0) + 1
    return _cells_to_map(grid).transform([low, (high[0], low[1]), high, (low[0], high[1])])


def _cells_to_map(grid: OccupancyMap) -> Affine2D:
    """The transform from cell indices to the map frame."""
    x, y, heading = as_float64("grid.origin", grid.origin, (3,)).tolist()
    return Affine2D().scale(grid.resolution).rotate(heading).translate(x, y)


def draw_occupancy(axis: Axes, grid: OccupancyMap) -> None:
    """Draw an occupancy grid: occupied cells dark, unknown ones grey.

    Raises:
        ValueError: The cells do not have one shape (H, W).
    """
    occupied, free = np.asarray(grid.occupied), np.asarray(grid.free)
    check_array("grid.occupied", occupied, ("H", "W"), jnp.bool_)
    check_array("grid.free", free, occupied.shape, jnp.bool_)
    image = np.where(free, 255, 205).astype(np.uint8)
    image[occupied] = 60
    limits = axis.get_xlim(), axis.get_ylim()
    axis.set_facecolor((205 / 255,) * 3)
    axis.imshow(
        image.T,
        origin="lower",
        extent=(0, image.shape[0], 0, image.shape[1]),
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
            _draw_markers(axis, xy[use], marker, colour, name, 2)
    if graph.frontiers:
        axis.add_collection(
            LineCollection(graph.frontiers, colors=BLUE, linewidths=0.9, linestyles=":", zorder=1.4)
        )
        ends = np.array([line[-1] for line in graph.frontiers])
        _draw_markers(axis, ends, "^", GREEN, "open end", 3)
