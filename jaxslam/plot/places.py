"""Places: worlds, trajectories, landmarks, arcs, occupancy grids, the local diagram of a scan.

Lines differ in style as well as in colour, and landmarks in shape.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import to_rgb
from matplotlib.transforms import Affine2D

from jaxslam.belief import Belief
from jaxslam.covariance import blocks_of
from jaxslam.grid import GridSpec
from jaxslam.io.occupancy import Occupancy
from jaxslam.nodes import Nodes
from jaxslam.plot.sheet import BLACK, BLUE, GREEN, GREY, ORANGE, PINK, RED, SIGMAS, SKY, YELLOW
from jaxslam.poses import placed
from jaxslam.topomap import Graph
from jaxslam.types import CORNER, NODE
from jaxslam.voronoi import Diagram, branches
from jaxslam.world import World

DOTS = 40_000  # ends of beams drawn at most

# Colour, width, dashes and height in the picture of each trajectory.
LINES = {
    "estimate": (SKY, 3.0, "-", 2.0),
    "truth": (BLACK, 1.2, (0, (4, 2)), 2.2),
    "reference": (BLACK, 1.2, (0, (4, 2)), 2.2),
    "odometry": (RED, 1.1, (0, (1, 1.2)), 2.1),
}
# Marker, colour and name in the legend of each kind of landmark that has a place.
MARKS = {NODE: ("o", GREEN, "node"), CORNER: ("s", ORANGE, "corner")}


def walls(axis: Axes, world: World) -> None:
    """Draw the walls of a world."""
    lines = np.asarray(world.walls).reshape(-1, 2, 2)
    axis.add_collection(LineCollection(lines, colors=GREY, linewidths=1.4, label="wall"))


def echoes(axis: Axes, poses: np.ndarray, points: np.ndarray, hit: np.ndarray) -> None:
    """Draw where beams ended, thinned out.

    Args:
        axis: Where to draw.
        poses: (T, 3) of the scans, world.
        points: (T, R, 2) ends of their beams [m, robot frame].
        hit: (T, R) bool, those that returned.
    """
    step, beam = np.nonzero(hit)
    thin = slice(None, None, 1 + len(step) // DOTS)
    there = placed(np.asarray(poses)[step[thin]], points[step[thin], beam[thin]])
    axis.plot(*there.T, ",", color="#B5B5B5", zorder=0.5, label="_echoes", rasterized=True)


def trajectory(axis: Axes, poses: np.ndarray, what: str) -> None:
    """Draw a way of the robot.

    Args:
        axis: Where to draw.
        poses: (T, 3), world.
        what: One of `LINES`; also its name in the legend.
    """
    color, width, dashes, height = LINES[what]
    style = {"color": color, "linewidth": width, "linestyle": dashes, "zorder": height}
    axis.plot(*np.asarray(poses)[:, :2].T, label=what, **style)


def robot(axis: Axes, pose: np.ndarray, ends: np.ndarray) -> None:
    """Draw a robot at a pose (3,) and the ends (N, 2) of its beams [m, robot frame]."""
    x, y, heading = pose = np.asarray(pose, float)
    axis.plot(*placed(pose, ends).T, ".", color=ORANGE, markersize=2.5, zorder=2.5, label="scan")
    marker = (3, 0, np.degrees(heading) - 90)
    axis.plot(x, y, marker=marker, color=BLUE, markersize=10, zorder=4, label="_robot")


def ends(axis: Axes, poses: np.ndarray) -> None:
    """Mark start S and end F of a way (T, 3) of the robot."""
    for name, pose in (("S", poses[0]), ("F", poses[-1])):
        at = np.asarray(pose[:2], float)
        box = {"boxstyle": "circle,pad=0.15", "facecolor": "white", "edgecolor": BLACK}
        axis.text(*at, name, ha="center", va="center", fontsize=8, weight="bold", bbox=box)


def ellipses(axis: Axes, xy: np.ndarray, cov: np.ndarray, color: str) -> None:
    """Draw the 3-sigma ellipses of points.

    Args:
        axis: Where to draw.
        xy: (N, 2) [m].
        cov: (N, 2, 2) [m^2].
        color: Of the lines.
    """
    values, vectors = np.linalg.eigh(np.asarray(cov, float))  # ascending
    width, height = 2 * SIGMAS * np.sqrt(np.maximum(values.T[::-1], 0.0))
    angle = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    style = {"facecolors": "none", "edgecolors": color, "linewidths": 0.9, "zorder": 3}
    axis.add_collection(
        EllipseCollection(
            width, height, angle, units="xy", offsets=xy, offset_transform=axis.transData, **style
        )
    )


def landmarks(axis: Axes, belief: Belief, *, confirm: int) -> None:
    """Draw nodes and corners of a belief that were seen `confirm` times, with their covariance."""
    seen, kind = np.asarray(belief.seen), np.asarray(belief.kind)
    place, own = np.asarray(belief.places), np.asarray(blocks_of(belief.map_cov))
    for which in MARKS:
        _marks(axis, place, own, (seen >= confirm) & (kind == which), which)


def _marks(axis: Axes, xy: np.ndarray, cov: np.ndarray, use: np.ndarray, kind: int) -> None:
    """Draw those landmarks (N, 2) of one kind that `use` (N,) picks, with their ellipses."""
    marker, color, name = MARKS[kind]
    style = {"color": color, "markersize": 4, "markeredgecolor": "white", "markeredgewidth": 0.4}
    label = f"{name}, {SIGMAS:g}-sigma ellipse"
    axis.plot(*xy[use].T, marker, linestyle="none", label=label, zorder=3.5, **style)
    ellipses(axis, xy[use], cov[use], color)


def arcs(axis: Axes, graph: Graph) -> None:
    """Draw the arcs of a topological map."""
    style = {"colors": GREEN, "linewidths": 1.0, "alpha": 0.6, "zorder": 1.5}
    axis.add_collection(LineCollection(graph.lines, label="arc", **style))


def local(
    axis: Axes, diagram: Diagram, sources: np.ndarray, spec: GridSpec, seen: Nodes | None = None
) -> None:
    """Draw the local diagram of a scan as the robot sees it: x up, y to the left.

    Args:
        axis: Where to draw.
        diagram: (H, W) regions.
        sources: (H, W) bool, cells they came from.
        spec: Their grid.
        seen: Landmarks of the scan.
    """
    labels, sources = np.asarray(diagram.labels), np.asarray(sources)
    colors = np.array([to_rgb(c) for c in (SKY, ORANGE, GREEN, PINK, YELLOW, BLUE, RED)])
    lowest = np.log2(np.maximum(labels & -labels.astype(np.int64), 1)).astype(int)
    own = colors[lowest % len(colors)]
    image = np.where((labels != 0)[..., None], 0.3 * own + 0.7, 1.0)
    image[np.asarray(branches(diagram, sources))] = to_rgb(BLACK)
    image[sources] = 0.75 * own[sources]
    extent = (-spec.side, spec.side, -spec.behind, spec.ahead)
    axis.imshow(image, origin="lower", extent=extent, interpolation="none")
    axis.plot(0, 0, "^", color=RED, markersize=8, clip_on=False)
    if seen is not None:
        xy, cov = np.asarray(seen.xy)[:, ::-1], np.asarray(seen.cov)[:, ::-1, ::-1]
        for kind in MARKS:
            _marks(axis, xy, cov, np.asarray(seen.valid & (seen.kind == kind)), kind)
    axis.set(xlim=(spec.side, -spec.side), ylim=(-spec.behind, spec.ahead), aspect="equal")
    axis.set(xlabel="y, to the left [m]", ylabel="x, ahead [m]")


def outline(map: Occupancy) -> np.ndarray:
    """Corners (4, 2) [m, map] of the part of an occupancy grid that is not unknown."""
    known = np.argwhere(map.occupied | map.free)
    low, high = known.min(axis=0), known.max(axis=0) + 1
    return _placing(map).transform([low, (high[0], low[1]), high, (low[0], high[1])])


def _placing(map: Occupancy) -> Affine2D:
    """From cells to the frame of the map."""
    x, y, heading = np.asarray(map.origin, float)
    return Affine2D().scale(map.resolution).rotate(heading).translate(x, y)


def occupancy(axis: Axes, map: Occupancy) -> None:
    """Draw an occupancy grid: occupied cells dark, unknown ones grey."""
    image = np.where(map.free, 255, 205).astype(np.uint8)
    image[map.occupied] = 60
    style = {"cmap": "gray", "vmin": 0, "vmax": 255, "interpolation": "none", "zorder": 0.5}
    extent = (0, image.shape[0], 0, image.shape[1])
    limits = axis.get_xlim(), axis.get_ylim()
    axis.set_facecolor((205 / 255,) * 3)
    axis.imshow(
        image.T, origin="lower", extent=extent, transform=_placing(map) + axis.transData, **style
    )
    axis.set(xlim=limits[0], ylim=limits[1], aspect="equal")


def roads(axis: Axes, graph: Graph) -> None:
    """Draw the topological map of an occupancy grid; junctions and dead ends differ in shape."""
    style = {"colors": BLUE, "linewidths": 1.1, "zorder": 1.5}
    axis.add_collection(LineCollection(graph.lines, label="arc", **style))
    degree = np.bincount(graph.pairs.ravel(), minlength=len(graph.id))
    for name, marker, color, use in (
        ("node", "o", RED, degree != 1),
        ("dead end", "s", ORANGE, degree == 1),
    ):
        style = {"color": color, "markersize": 4, "markeredgecolor": "white", "zorder": 2}
        if use.any():
            edge = {"markeredgewidth": 0.4, "linestyle": "none"}
            axis.plot(*graph.xy[use].T, marker, label=name, **style, **edge)
