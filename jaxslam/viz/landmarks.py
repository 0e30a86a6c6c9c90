"""Drawing of landmarks and of the local Voronoi diagrams that they come from.

Landmarks differ in shape as well as in colour.
"""

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.colors import to_rgb

from jaxslam.core.features import Features
from jaxslam.core.types import CORNER, JUNCTION, AnyArray, as_float64, check_array
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.covariance import slot_blocks
from jaxslam.frontend.automaton import Diagram
from jaxslam.frontend.grid import GridSpec
from jaxslam.frontend.voronoi import branch_cells
from jaxslam.viz.canvas import BLACK, BLUE, GREEN, NUM_SIGMAS, ORANGE, PINK, RED, SKY, YELLOW
from jaxslam.viz.maps import draw_markers

# Marker, colour and legend name of each kind of landmark that has a position.
LANDMARK_STYLES = {JUNCTION: ("o", GREEN, "junction"), CORNER: ("s", ORANGE, "corner")}

# One program, not one for each of its operations.
_slot_blocks = jax.jit(slot_blocks)


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
    position, cov = np.asarray(belief.landmark_positions), np.asarray(_slot_blocks(belief.map_cov))
    for drawn in LANDMARK_STYLES:
        use = (count >= confirm_count) & (kind == drawn)
        _draw_landmarks(axis, position[use], cov[use], drawn)


def _draw_landmarks(axis: Axes, xy: np.ndarray, cov: np.ndarray, kind: int) -> None:
    """Draw landmarks (N, 2) of one kind with the ellipses of their covariances (N, 2, 2)."""
    marker, colour, name = LANDMARK_STYLES[kind]
    draw_markers(axis, xy, marker, colour, f"{name}, {NUM_SIGMAS:g}-sigma ellipse", 3.5)
    draw_ellipses(axis, xy, cov, colour)


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
