"""Drawing of routes."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from jaxslam.core import polylines
from jaxslam.mapping.planning import PlannedRoute
from jaxslam.viz.canvas import BLACK, BLUE

MIN_NUMBERED = 0.02  # of the route's extent that a leg must have to be numbered in the picture


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
                zorder=3.0,  # below what is drawn later: start and goal
            )
