"""Drawing of rooms and doors over an occupancy map."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.transforms import Affine2D
from numpy.typing import ArrayLike
from scipy import ndimage

from jaxslam.core.regions import Regions
from jaxslam.core.se2_np import transform
from jaxslam.viz.canvas import BLACK, GREY, PINK

SHADE = 0.55  # opacity of the colours of rooms
MAX_NAMES = 150  # rooms whose numbers are drawn


def draw_rooms(axis: Axes, regions: Regions, colours: ArrayLike) -> None:
    """Draw each region in its colour, with the number of its name, and a line across each door.

    Args:
        axis: Axis to draw on, in the map frame [m].
        regions: The regions, with their label (H, W).
        colours: (R, 3) [0, 255] of the regions.
    """
    palette = np.zeros((len(regions.regions) + 1, 4), np.uint8)
    palette[1:, :3] = colours
    palette[1:, 3] = round(255 * SHADE)
    height, width = regions.label.shape
    x, y, heading = regions.origin.tolist()
    to_map = Affine2D().scale(regions.resolution).rotate(heading).translate(x, y)
    limits = axis.get_xlim(), axis.get_ylim()
    axis.imshow(
        palette[regions.label.T],
        origin="lower",
        extent=(0, height, 0, width),
        transform=to_map + axis.transData,
        interpolation="none",
        zorder=0.7,
    )
    axis.set(xlim=limits[0], ylim=limits[1], aspect="equal")
    if regions.regions:
        label = "room (colour), its number"
        axis.plot([], [], "s", color=GREY, alpha=SHADE, markersize=8, label=label)
        _draw_numbers(axis, regions)
    if regions.doors:
        axis.add_collection(
            LineCollection(
                [door.jambs for door in regions.doors],
                colors=PINK,
                linewidths=2.2,
                capstyle="butt",
                zorder=2.5,
                label="door",
            )
        )


def _draw_numbers(axis: Axes, regions: Regions) -> None:
    """Write the numbers of the largest regions near their middles, inside them."""
    largest = sorted(range(len(regions.regions)), key=lambda k: -regions.regions[k].area)
    boxes = ndimage.find_objects(regions.label)
    for k in largest[:MAX_NAMES]:
        cells = np.argwhere(regions.label[boxes[k]] == k + 1) + [side.start for side in boxes[k]]
        middle = cells[np.abs(cells - cells.mean(axis=0)).sum(axis=1).argmin()]
        x, y = transform(regions.origin, (middle + 0.5) * regions.resolution).tolist()
        number = regions.regions[k].name.partition("_")[2]
        box = {"boxstyle": "round,pad=0.1", "facecolor": "white", "alpha": 0.7, "linewidth": 0.0}
        text = axis.text(x, y, number, fontsize=5, color=BLACK, bbox=box, in_layout=False)
        text.set(ha="center", va="center")
