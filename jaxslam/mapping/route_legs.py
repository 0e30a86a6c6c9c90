"""The legs of a route: its parts between doors, regions and turns, as a person describes them."""

from typing import NamedTuple

import numpy as np

from jaxslam.core import polylines
from jaxslam.core.maps import TopologicalMap
from jaxslam.core.regions import Regions
from jaxslam.core.se2_np import wrap_angle
from jaxslam.mapping.clearance import ClearanceField, clearance_at
from jaxslam.mapping.planner_data import doors_crossed, most_common, region_at

SPACING = 0.05  # [m] between the points of a route whose clearance and region are taken
AHEAD = 1.0  # [m] over which a heading is taken
MIN_LENGTH = 1.0  # [m] of a leg that ends at a turn, or where a region begins without a door
TURN, BACK = np.radians(40.0), np.radians(150.0)  # turns that end a leg, and that go back


class Leg(NamedTuple):
    """A part of a route, map frame.

    Attributes:
        line: (n, 2) [m] polyline.
        length: [m].
        clearance: [m] distance to the nearest obstacle at its narrowest place; NaN if not known.
            Without an occupancy map that of its arcs, NaN if it follows none.
        heading: [rad] at its start.
        turn: [rad] from the leg before it, left is positive; 0 for the first.
        region: Name of the region that most of it lies in, or None.
        region_kind: Kind of that region, or None.
        door: Name of the door at its end, or None.
        door_width: [m] of that door; NaN without one.
        arcs: Indices of the arcs that it follows, in order.
    """

    line: np.ndarray
    length: float
    clearance: float
    heading: float
    turn: float
    region: str | None
    region_kind: str | None
    door: str | None
    door_width: float
    arcs: tuple[int, ...]


def split_into_legs(
    graph: TopologicalMap,
    line: np.ndarray,
    arc: np.ndarray,
    *,
    field: ClearanceField | None = None,
    regions: Regions | None = None,
) -> tuple[Leg, ...]:
    """The legs of a route: they end at doors, where another region begins, and at turns.

    Args:
        graph: The map.
        line: (n, 2) [m] the route, map frame.
        arc: (n - 1,) index of the arc that each segment follows, -1 for none.
        field: Distances to obstacles, if there is an occupancy map.
        regions: Rooms and doors, if there are any.
    """
    fine = polylines.refine(line, SPACING)
    along = polylines.cumulative_lengths(fine)
    middle = 0.5 * (along[:-1] + along[1:])
    segment = np.searchsorted(polylines.cumulative_lengths(line), middle, side="right") - 1
    arc = arc[np.minimum(segment, len(arc) - 1)]
    crossed = [] if regions is None else doors_crossed(regions.doors, fine)
    doors = {at + 1: door for at, door in crossed if 0 < at + 1 < len(fine) - 1}
    region = np.full(len(fine), -1) if regions is None else region_at(regions, fine)
    cuts = sorted({0, *doors, len(fine) - 1})
    cuts = _with_more(cuts, _region_changes(region, along, cuts), along)
    cuts = _with_more(cuts, _turns(graph, fine, along, arc), along)
    legs = []
    for first, last in zip(cuts[:-1], cuts[1:], strict=True):
        index = most_common(region[first : last + 1])
        inside = None if regions is None or index < 0 else regions.regions[index]
        door = None if regions is None or last not in doors else regions.doors[doors[last]]
        before = _heading(fine, along, along[first] - AHEAD, along[first])
        heading = _heading(fine, along, along[first], min(along[first] + AHEAD, along[last]))
        legs.append(
            Leg(
                line=without_straight_points(fine[first : last + 1]),
                length=float(along[last] - along[first]),
                clearance=_clearance(graph, fine[first : last + 1], arc[first:last], field),
                heading=heading,
                turn=float(wrap_angle(np.array(heading - before))) if first else 0.0,
                region=None if inside is None else inside.name,
                region_kind=None if inside is None else inside.kind,
                door=None if door is None else door.name,
                door_width=np.nan if door is None else float(door.width),
                arcs=followed(arc[first:last]),
            )
        )
    return tuple(legs)


def followed(arc: np.ndarray) -> tuple[int, ...]:
    """Arcs, in order, of the segments (n,) of a route; -1 is none."""
    arc = arc[arc >= 0]
    return tuple(arc[np.append(True, arc[1:] != arc[:-1])[: len(arc)]].tolist())


def describe(legs: tuple[Leg, ...], goal: str) -> list[str]:
    """Legs as lines of text, as in `turn left, 3.2 m in room_4 to the door door_2 (0.91 m wide)`.

    Args:
        legs: All legs of a route.
        goal: What the last one leads to.
    """
    lines: list[str] = []
    for leg in legs:
        where = "" if leg.region is None else f" in {leg.region}"
        if leg.region_kind not in (None, "room"):
            where = f" along the {leg.region_kind} {leg.region}"
        end = "" if leg.door is None else f" to the door {leg.door} ({leg.door_width:.2f} m wide)"
        turn = "" if lines else f"heading {np.degrees(leg.heading):.0f} deg, "
        if abs(leg.turn) >= BACK:
            turn = "turn back, "
        elif abs(leg.turn) >= TURN:
            turn = f"turn {'left' if leg.turn > 0 else 'right'}, "
        lines.append(f"{turn}{leg.length:.1f} m{where}{end}")
    lines[-1] += f" to {goal}"
    return lines


def without_straight_points(line: np.ndarray) -> np.ndarray:
    """A polyline (n, 2) without the points where it goes straight on, or stays; two are left."""
    moved = line[np.append(True, np.hypot(*np.diff(line, axis=0).T) > 1e-9)]
    line = moved if len(moved) > 1 else line[[0, -1]]
    before, after = np.diff(line[:-1], axis=0), np.diff(line[1:], axis=0)
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    size = np.hypot(*before.T) * np.hypot(*after.T)
    straight = (np.abs(cross) < 1e-6 * size) & (np.sum(before * after, axis=1) > 0)
    return line[np.concatenate([[True], ~straight, [True]])] if len(line) > 2 else line


def narrowest(legs: tuple[Leg, ...], field: ClearanceField | None) -> float:
    """Clearance [m] of all legs of a route, NaN if not known; without a field that of its arcs."""
    # Without a field, straight lines to the arcs are not known to be free: arcs alone count.
    known = [leg.clearance for leg in legs if leg.arcs or field is not None]
    return float(np.min(known)) if known else np.nan


def _clearance(
    graph: TopologicalMap, points: np.ndarray, arc: np.ndarray, field: ClearanceField | None
) -> float:
    """Clearance [m] of points (n, 2) on a route with arcs (n - 1,), NaN if not known.

    It is that of its arcs beyond a field, and without one.
    """
    if field is None:
        return float(graph.arc_clearance[arc[arc >= 0]].min()) if (arc >= 0).any() else np.nan
    of_arc = np.append(graph.arc_clearance, np.nan)[arc]
    here = clearance_at(field, points)
    return float(np.where(np.isnan(here), np.append(of_arc, of_arc[-1:]), here).min())


def _with_more(cuts: list[int], more: list[int], along: np.ndarray) -> list[int]:
    """Cuts with those of `more` that are `MIN_LENGTH` from all others."""
    for cut in more:
        if min(abs(along[cut] - along[other]) for other in cuts) >= MIN_LENGTH:
            cuts = sorted([*cuts, cut])
    return cuts


def _region_changes(region: np.ndarray, along: np.ndarray, cuts: list[int]) -> list[int]:
    """Points where a region begins that lasts for `MIN_LENGTH`, between cuts."""
    starts = np.flatnonzero(np.append(True, region[1:] != region[:-1]))
    ends = np.append(starts[1:], len(region) - 1)
    known = (region[starts] >= 0) & (along[ends] - along[starts] >= MIN_LENGTH)
    starts = starts[known]
    changes = starts[1:][region[starts[1:]] != region[starts[:-1]]].tolist()
    return [change for change in changes if change not in cuts]


def _turns(
    graph: TopologicalMap, fine: np.ndarray, along: np.ndarray, arc: np.ndarray
) -> list[int]:
    """Points where a route turns at a junction, or onto an arc or off it, the sharpest first."""
    degree = np.bincount(np.ravel(graph.arc_ends).astype(int), minlength=len(graph.xy))
    places = 1 + np.flatnonzero(arc[1:] != arc[:-1])
    junctions = graph.xy[degree >= 3]
    turns = []
    for at in places.tolist():
        joint = (arc[[at - 1, at]] < 0).any()
        if joint or np.hypot(*(junctions - fine[at]).T).min(initial=np.inf) < SPACING:
            before = _heading(fine, along, along[at] - AHEAD, along[at])
            after = _heading(fine, along, along[at], along[at] + AHEAD)
            turns.append((abs(float(wrap_angle(np.array(after - before)))), at))
    return [at for turn, at in sorted(turns, reverse=True) if turn >= TURN]


def _heading(fine: np.ndarray, along: np.ndarray, first: float, last: float) -> float:
    """Heading [rad] from a point at one length [m] along a route to that at another."""
    points = np.array([np.interp([first, last], along, fine[:, axis]) for axis in (0, 1)])
    return float(np.arctan2(*(points[:, 1] - points[:, 0])[::-1]))
