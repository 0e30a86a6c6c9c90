"""Figures of worlds, trajectories, maps, errors and local diagrams, drawn on given axes.

The only module that imports matplotlib. Colours are those of Okabe and Ito, which colour-blind
people can tell apart; lines also differ in style, and landmarks in shape.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter
from matplotlib.transforms import Affine2D

from jaxslam.belief import Belief
from jaxslam.grid import GridSpec
from jaxslam.io.occupancy import Occupancy
from jaxslam.nodes import Nodes
from jaxslam.topomap import Graph
from jaxslam.types import CORNER, NODE
from jaxslam.voronoi import Diagram, branches
from jaxslam.world import World

BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, RED, PINK = (
    *("#000000", "#E69F00", "#56B4E9", "#009E73"),
    *("#F0E442", "#0072B2", "#D55E00", "#CC79A7"),
)
GREY = "#8C8C8C"
SIGMAS = 3.0  # standard deviations that ellipses and bounds show
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


def canvas(
    width: float, height: float, rows: int = 1, columns: int = 1
) -> tuple[Figure, np.ndarray]:
    """Figure of a size [inch], 100 dots to the inch, and its axes (rows, columns)."""
    figure = Figure(figsize=(width, height), dpi=100, layout="constrained")
    shared = "col" if rows > 1 else False
    return figure, figure.subplots(rows, columns, squeeze=False, sharex=shared)


def plan(low: np.ndarray, high: np.ndarray) -> tuple[Figure, Axes]:
    """Figure 900 dots wide of the rectangle from `low` (2,) to `high` (2,) [m, world]."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    margin = 0.03 * np.max(high - low) + 0.2
    low, high = low - margin, high + margin
    width, height = high - low
    figure, axes = canvas(9.0, float(np.clip(8.2 * height / width, 2.5, 9.0)) + 1.1)
    axis = axes[0, 0]
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axis.set(xlabel="x [m]", ylabel="y [m]")
    return figure, axis


def legend(figure: Figure) -> None:
    """Put one legend below all that is drawn."""
    figure.legend(loc="outside lower center", ncols=4, frameon=False)


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
    (x, y), pose = points[step[thin], beam[thin]].T, np.asarray(poses)[step[thin]]
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    there = pose[:, 0] + c * x - s * y, pose[:, 1] + s * x + c * y
    axis.plot(*there, ",", color="#B5B5B5", zorder=0.5, label="_echoes", rasterized=True)


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
    place, cov = np.asarray(belief.places), np.asarray(belief.map_cov)
    size, index = len(seen), np.arange(len(seen))
    own = cov.reshape(size, 2, size, 2)[index, :, index]
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


def errors(axes: np.ndarray, cov: np.ndarray, error: np.ndarray | None = None) -> None:
    """Draw errors of heading, y and x with their 3-sigma bounds over the scans.

    Args:
        axes: (3,) axes, one below the other.
        cov: (T, 3, 3) covariance of the poses.
        error: (T, 3) [m, m, rad]; the bounds alone without it.

    References:
        Paper, Fig. 13.
    """
    bound = SIGMAS * np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2), 0.0))  # (T, 3)
    scan = np.arange(len(bound))
    names = (("heading [deg]", 2, 180 / np.pi), ("y [m]", 1, 1.0), ("x [m]", 0, 1.0))
    for axis, (name, k, unit) in zip(axes, names, strict=True):
        high = unit * bound[:, k]
        axis.fill_between(scan, -high, high, color=SKY, alpha=0.35, linewidth=0)
        axis.plot(scan, high, color=BLUE, linewidth=1.0, label=f"{SIGMAS:g}-sigma bound")
        axis.plot(scan, -high, color=BLUE, linewidth=1.0)
        if error is not None:
            axis.plot(scan, unit * error[:, k], color=BLACK, linewidth=1.2, label="error")
        axis.axhline(0.0, color=GREY, linewidth=0.6)
        axis.set(ylabel=name, xlim=(0, max(len(scan) - 1, 1)))
        axis.margins(y=0.08)
    axes[-1].set_xlabel("scan")
    axes[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)


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


def extent(*groups: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest x, y (2,) [m] of groups of points (N, 2) or poses (N, 3)."""
    points = np.concatenate([np.asarray(group)[:, :2] for group in groups])
    points = points[np.isfinite(points).all(axis=1)]
    return points.min(axis=0), points.max(axis=0)


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


def losses(axis: Axes, training: np.ndarray, heldout: np.ndarray, best: int) -> None:
    """Draw losses over the evaluations (N,) of a fit, those of held-out runs where not NaN."""
    steps = np.arange(len(training))
    axis.plot(steps, training, color=SKY, label="training")
    judged = np.isfinite(heldout)
    if judged.any():
        axis.plot(steps[judged], heldout[judged], color=ORANGE, linestyle="--", label="held out")
    axis.axvline(best, color=GREY, linewidth=0.8, label="best")
    axis.set(xlabel="evaluation", ylabel="loss")
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    axis.legend(frameon=False)


def parameters(axis: Axes, names: tuple[str, ...], history: np.ndarray, best: int) -> None:
    """Draw parameters (N, P) over the evaluations of a fit, in units of where they began."""
    colours = (BLACK, ORANGE, SKY, GREEN, BLUE, RED, PINK, GREY)
    styles = ("-", "--", "-.", ":")
    for i, (name, values) in enumerate(zip(names, history.T, strict=True)):
        look = {"color": colours[i % len(colours)], "linestyle": styles[i % len(styles)]}
        axis.plot(values / values[0], label=name, **look)
    axis.axvline(best, color=GREY, linewidth=0.8)
    axis.set(xlabel="evaluation", ylabel="noise / noise at the start", yscale="log")
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_formatter(NullFormatter())
    axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
