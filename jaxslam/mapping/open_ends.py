"""Open ends of a map: where the robot may go on into space that no scan has seen.

Free space ends at walls, and at unknown cells. If these were free, the robot's centre could cross
some of the edges of its free configurations; such an edge is an open end, and the nearest arc leads
there:

        ##########
        #        :          #  wall          :  unknown cells behind
        #   o----x          x  open end      o  node of the diagram
        #   |    :
        ####|#####

References:
    Yamauchi (1997), A frontier-based approach for autonomous exploration.
"""

import numpy as np
from scipy import ndimage

from jaxslam.core.maps import OccupancyMap
from jaxslam.mapping.open_space import COVER, Approach, FreeSpace, apart
from jaxslam.mapping.plane_graph import PlaneGraph

_EIGHT = np.ones((3, 3), bool)
_NEIGHBOURS = np.array([(0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)])


def find_open_ends(
    graph: PlaneGraph, space: FreeSpace, occupancy: OccupancyMap
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Open ends of a graph, whose arcs are split where the path to one begins.

    Args:
        graph: The graph; all its arcs lie in the free space.
        space: Free configurations, in which the robot was.
        occupancy: The grid of these.

    Returns:
        E polylines (n >= 2, 2) [m], each from a node to an open end, and these nodes (E,) int.
    """
    if not graph.arcs:
        return (), np.zeros(0, int)
    reached = space.clearance > 0.0
    beyond, count = ndimage.label(_first_beyond(space, occupancy), structure=_EIGHT)
    approach = Approach(graph, space)
    lines, nodes = [], []
    for k, box in enumerate(ndimage.find_objects(beyond, count), start=1):
        cells = np.argwhere(beyond[box] == k) + [side.start for side in box]
        ends = (cells + 0.5) * space.resolution + space.corner
        from_middle = np.argsort(np.hypot(*(ends - ends.mean(axis=0)).T), kind="stable")
        for n in from_middle[apart(ends[from_middle], 2 * COVER)].tolist():
            before = _beside(cells[n], reached) * space.resolution + space.corner
            found = approach.to(before)
            if found is not None:
                nodes.append(found[0])
                lines.append(np.vstack([found[1], ends[n]]))
    return tuple(lines), np.array(nodes, int)


def _beside(cell: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Middle (2,) [cells] of a chosen neighbour of a cell, at a side if there is one."""
    around = cell + _NEIGHBOURS
    inside = ((around >= 0) & (around < chosen.shape)).all(axis=1)
    around = around[inside]
    return around[np.argmax(chosen[tuple(around.T)])] + 0.5


def _first_beyond(space: FreeSpace, occupancy: OccupancyMap) -> np.ndarray:
    """Cells (H, W) bool beside the free configurations that lead to unknown ones if these are free.

    What lies behind must hold a disc of the robot's size, of unknown cells alone.
    """
    reached = space.clearance > 0.0
    away = ndimage.distance_transform_edt(np.pad(~occupancy.occupied, 1, constant_values=True))
    fits = (away[1:-1, 1:-1] - 0.5) * space.resolution >= space.robot_radius
    behind, count = ndimage.label(fits & ~reached)
    unknown = fits & ~occupancy.free & ~occupancy.occupied
    size = np.bincount(behind[unknown], minlength=count + 1) * space.resolution**2
    size[0] = 0.0
    leads_on = (size >= np.pi * space.robot_radius**2)[behind]
    return leads_on & ndimage.binary_dilation(reached)
