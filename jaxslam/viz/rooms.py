"""Drawing of rooms and doors over an occupancy map."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.path import Path

from jaxslam.core.regions import Region, Regions, innermost, signed_area
from jaxslam.io.room_colours import region_colours
from jaxslam.viz.canvas import BLACK, GREY, PINK

SHADE = 0.55  # opacity of the colours of rooms
FONT_SIZE = 5.0  # [points] of the numbers of rooms
_DIGIT = 0.65  # width of a digit, relative to the font size


def draw_rooms(axis: Axes, regions: Regions) -> None:
    """Draw each region in its colour (`room_colours`), and a line across each door.

    The number in its name stands where the region is widest, if it fits in there.

    Args:
        axis: Axis to draw on, in the map frame [m], with its limits set.
        regions: The regions; of these only the polygons with their holes are drawn.
    """
    if regions.regions:
        axis.add_collection(
            PathCollection(
                [_path(region) for region in regions.regions],
                facecolors=region_colours(regions) / 255.0,
                edgecolors="none",
                alpha=SHADE,
                zorder=0.7,
            )
        )
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


def _path(region: Region) -> Path:
    """The rings of a region, the outer one counter-clockwise and its holes clockwise."""
    rings = [region.polygon, *region.holes]
    turns = [1.0, *(-1.0 for _ in region.holes)]
    return Path.make_compound_path(
        *(
            Path(np.concatenate([ring, ring[:1]])[:: 1 if turn * signed_area(ring) > 0 else -1])
            for ring, turn in zip(rings, turns, strict=True)
        )
    )


def _draw_numbers(axis: Axes, regions: Regions) -> None:
    """Write the number of each region that it fits in, over arcs and nodes, below all marks."""
    (x, x_end), (y, y_end) = axis.get_xlim(), axis.get_ylim()
    frame = axis.get_window_extent()  # [dots], before the layout, which makes it larger
    dot = max((x_end - x) / frame.width, (y_end - y) / frame.height)  # [m]
    height = FONT_SIZE * axis.figure.dpi / 72.0 * dot  # [m] of a digit
    for region in regions.regions:
        number = region.name.partition("_")[2]
        needed = 0.5 * height * np.hypot(_DIGIT * len(number), 1.0)
        if needed > 0.5 * np.ptp(region.polygon, axis=0).min():
            continue
        middle, clearance = innermost(region)
        if needed <= clearance:
            axis.text(
                middle[0],
                middle[1],
                number,
                ha="center",
                va="center",
                fontsize=FONT_SIZE,
                color=BLACK,
                zorder=2.2,
                clip_on=True,
                in_layout=False,
                bbox={
                    "boxstyle": "round,pad=0.1",
                    "facecolor": "white",
                    "alpha": 0.7,
                    "linewidth": 0.0,
                },
            )
