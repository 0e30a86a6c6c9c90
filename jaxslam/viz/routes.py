"""Drawing of rooms, doors and routes."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.patheffects import withStroke

from jaxslam.core import polylines
from jaxslam.core.regions import Regions
from jaxslam.mapping.planning import PlannedRoute
from jaxslam.viz.canvas import BLACK, BLUE, GREEN, ORANGE, PINK, RED, SKY, YELLOW

COLOURS = {
    "room": (SKY, YELLOW, PINK, GREEN),
    "corridor": (ORANGE,),
    "hall": (BLUE,),
}
"""Colours of each kind of region, of which the regions of a kind take turns."""

MIN_NUMBERED = 0.02  # of the route's extent that a leg must have to be numbered in the picture


def draw_regions(axis: Axes, regions: Regions) -> None:
    """Draw rooms, corridors and halls in light colours with their names, and doors as lines."""
    colours = [
        COLOURS[region.kind][k % len(COLOURS[region.kind])]
        for k, region in enumerate(regions.regions)
    ]
    axis.add_collection(
        PolyCollection(
            [region.polygon for region in regions.regions],
            facecolors=colours,
            edgecolors="none",
            alpha=0.25,
            zorder=0.8,
        )
    )
    for region in regions.regions:
        x, y = region.polygon.mean(axis=0)
        axis.text(x, y, region.name, fontsize=5, ha="center", va="center", zorder=2.0)
    if regions.doors:
        jambs = [door.jambs for door in regions.doors]
        lines = LineCollection(jambs, colors=RED, linewidths=1.5, zorder=1.6, label="door")
        axis.add_collection(lines)


def draw_route(axis: Axes, planned: PlannedRoute) -> None:
    """Draw a route as a bold line, with the numbers of its legs where there is space."""
    x, y = planned.line.T
    axis.plot(x, y, color=BLUE, linewidth=3.0, zorder=3.0, label="route", solid_capstyle="round")
    size = max(float(np.ptp(planned.line, axis=0).max()), 1e-9)
    outline = [withStroke(linewidth=2.5, foreground="white")]
    for number, leg in enumerate(planned.legs, start=1):
        if leg.length >= MIN_NUMBERED * size:
            x, y = polylines.points_along(leg.line, np.array([0.5 * leg.length]))[0]
            axis.annotate(
                str(number),
                (x, y),
                (5, 5),
                textcoords="offset points",
                fontsize=9,
                weight="bold",
                color=BLACK,
                path_effects=outline,
                zorder=3.6,
            )
