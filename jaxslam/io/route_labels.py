"""What planners are given of nodes and arcs beyond their geometry: regions, doors, speed limits.

One formula of the speed serves all formats: full speed from a comfortable clearance on, below it in
proportion to the clearance, and never less than a fraction that still moves the robot.
"""

import math
from typing import NamedTuple

import numpy as np

from jaxslam.core.maps import TopologicalMap
from jaxslam.core.regions import Door, PlannerData, Regions

DOOR = "door"  # class of an arc that passes through a door
FULL_SPEED_CLEARANCE = 0.8  # [m] distance to obstacles from which on the speed is full
MAX_LEAF_WIDTH = 1.5  # [m] widest door that is opened
LEAST_SPEED = 0.2  # fraction of the full speed, also where the clearance is not known


class Label(NamedTuple):
    """Region and doors of a node or arc.

    Attributes:
        region: Name of the region that it lies in, empty for none.
        kind: Kind of that region, or `DOOR`; empty for none.
        doors: Names of the doors that an arc passes through, in its direction.
        leaves: Of these, the ones that are narrow enough for a door leaf, to be opened.
    """

    region: str = ""
    kind: str = ""
    doors: tuple[str, ...] = ()
    leaves: tuple[str, ...] = ()


def has_leaf(door: Door) -> bool:
    """Whether a door may have a leaf that opens; a wider one is an opening."""
    return door.width <= MAX_LEAF_WIDTH


def speed_fraction(clearance: float) -> float:
    """Fraction of the full speed at a clearance [m]: clearance / 0.8 m, from 0.2 to 1.

    A clearance that is NaN, not known, has the least speed.
    """
    if math.isnan(clearance):
        return LEAST_SPEED
    return min(max(clearance / FULL_SPEED_CLEARANCE, LEAST_SPEED), 1.0)


def labels(
    graph: TopologicalMap, regions: Regions | None = None, planner: PlannerData | None = None
) -> tuple[tuple[Label, ...], tuple[Label, ...]]:
    """Labels of the N nodes and A arcs of a map, empty ones unless regions and planner are given.

    Raises:
        ValueError: `planner` is of other numbers of nodes or arcs, or an index is of no region or
            door.
    """
    num_nodes, num_arcs = len(graph.id), len(graph.arc_ends)
    if regions is None or planner is None:
        return num_nodes * (Label(),), num_arcs * (Label(),)
    for name, values, count, most in (
        ("node_region", planner.node_region, num_nodes, len(regions.regions)),
        ("arc_region", planner.arc_region, num_arcs, len(regions.regions)),
    ):
        if np.shape(values) != (count,):
            raise ValueError(f"{name} is {np.shape(values)}, not ({count},)")
        if count and not -1 <= np.min(values) <= np.max(values) < most:
            raise ValueError(f"{name} has {np.min(values)} to {np.max(values)} of {most} regions")
    if len(planner.arc_doors) != num_arcs:
        raise ValueError(f"arc_doors has {len(planner.arc_doors)} entries, arc_ends {num_arcs}")
    if not {door for doors in planner.arc_doors for door in doors} <= set(
        range(len(regions.doors))
    ):
        raise ValueError(f"arc_doors has an index of none of {len(regions.doors)} doors")
    arcs = tuple(
        _with_doors(_of_region(regions, int(index)), [regions.doors[door] for door in doors])
        for index, doors in zip(planner.arc_region, planner.arc_doors, strict=True)
    )
    return tuple(_of_region(regions, int(k)) for k in planner.node_region), arcs


def frontier_labels(
    graph: TopologicalMap, regions: Regions | None = None, planner: PlannerData | None = None
) -> tuple[Label, ...]:
    """Labels of the edges to the open ends of a map: their doors, where these are known.

    Raises:
        ValueError: `planner` is of another number of open ends.
    """
    count = len(graph.frontiers)
    if regions is None or planner is None or not planner.frontier_doors:
        return count * (Label(),)
    if len(planner.frontier_doors) != count:
        raise ValueError(f"frontier_doors has {len(planner.frontier_doors)} entries of {count}")
    return tuple(
        _with_doors(Label(), [regions.doors[door] for door in doors])
        for doors in planner.frontier_doors
    )


def _with_doors(label: Label, doors: list[Door]) -> Label:
    """A label of an arc that passes through doors, if there are any."""
    names = tuple(door.name for door in doors)
    leaves = tuple(door.name for door in doors if has_leaf(door))
    return label._replace(kind=DOOR, doors=names, leaves=leaves) if names else label


def arc_clearances(graph: TopologicalMap, planner: PlannerData | None = None) -> np.ndarray:
    """Narrowest clearance (A,) [m] of each arc, of its width profile where there is one, else NaN.

    Without a profile it is `arc_clearance` of the map.

    Raises:
        ValueError: `planner` is of another number of arcs.
    """
    clearance = np.array(graph.arc_clearance, np.float64)
    if planner is None:
        return clearance
    if len(planner.arc_widths) != len(clearance):
        raise ValueError(f"arc_widths has {len(planner.arc_widths)} entries of {len(clearance)}")
    for index, widths in enumerate(planner.arc_widths):
        known = np.asarray(widths, np.float64)[np.isfinite(widths)]
        if known.size:
            clearance[index] = known.min()
    return clearance


def _of_region(regions: Regions, index: int) -> Label:
    """Label of what lies in a region, -1 for none."""
    if index < 0:
        return Label()
    return Label(regions.regions[index].name, regions.regions[index].kind)
