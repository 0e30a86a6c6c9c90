"""The picture of `topology`, drawn from its JSON file."""

from pathlib import Path

import numpy as np

from experiments import common
from experiments.common import Numbers
from experiments.roadmaps import Roadmap
from jaxslam.core.maps import OccupancyMap
from jaxslam.core.regions import Door, Region, Regions
from jaxslam.core.se2_np import inverse_transform
from jaxslam.mapping.rooms import find_regions
from jaxslam.viz.rooms import draw_rooms

COARSE = 2  # cells of the map, along each side, in one of the picture
WALL, FREE, UNKNOWN = "#", ".", " "
COLOURS = {
    "grid": common.BLUE,
    "map": common.SKY,
    "merged": common.ORANGE,
    "thinning": common.GREEN,
    "brushfire": common.PINK,
}
ALL = 0.995  # share of the pairs that are joined, below which it is written
KINDS = {"log": "", "hall": "hall: ", "map": "map: "}


def picture_of(occupancy: OccupancyMap, roadmap: Roadmap, robot_radius: float) -> Numbers:
    """What is drawn of a map: its cells as lines of text, y ascending, its graph, rooms and doors.

    Positions are in the frame of the grid [m].
    """
    rooms = find_regions(
        occupancy.occupied,
        occupancy.free,
        resolution=occupancy.resolution,
        origin=np.zeros(3),
        robot_radius=robot_radius,
    )
    rows, columns = (COARSE * (n // COARSE) for n in occupancy.free.shape)

    def coarse(cells: np.ndarray) -> np.ndarray:
        blocks = cells[:rows, :columns].reshape(rows // COARSE, COARSE, columns // COARSE, COARSE)
        return blocks.any(axis=(1, 3))

    wall, free = coarse(occupancy.occupied).T, coarse(occupancy.free).T
    letters = np.where(wall, WALL, np.where(free, FREE, UNKNOWN))
    return {
        "cell_m": COARSE * occupancy.resolution,
        "cells": ["".join(line) for line in letters.tolist()],
        "nodes": inverse_transform(occupancy.origin, roadmap.xy[~roadmap.is_open]).round(2),
        "lines": [inverse_transform(occupancy.origin, x).round(2) for x in roadmap.lines],
        "rooms": [
            {
                "name": room.name,
                "area_m2": room.area,
                "rings": [ring.round(2) for ring in (room.polygon, *room.holes)],
            }
            for room in rooms.regions
        ],
        "doors": [door.jambs.round(2) for door in rooms.doors],
    }


def draw(numbers: Numbers, path: Path) -> None:
    """The graph, rooms and doors of one log over its map, and the detours of all graphs."""
    figure, axes = common.canvas(9.0, 4.6, 1, 2, [6, 5])
    _draw_graph(axes[0, 0], numbers["drawn"])
    _draw_detours(axes[0, 1], numbers["graphs"])
    figure.savefig(path)


def _draw_graph(axis, drawn: Numbers) -> None:
    cells = np.array([list(line) for line in drawn["cells"]])
    shade = np.where(cells == WALL, 0.25, np.where(cells == FREE, 1.0, 0.88))
    known = cells != UNKNOWN
    size = drawn["cell_m"]
    height, width = cells.shape
    extent = (0.0, width * size, 0.0, height * size)
    axis.imshow(shade, origin="lower", extent=extent, cmap="gray", vmin=0.0, vmax=1.0)
    rows, columns = (np.flatnonzero(known.any(axis=side)) for side in (1, 0))
    axis.set(xlim=(columns[0] * size, (columns[-1] + 1) * size))
    axis.set(ylim=(rows[0] * size, (rows[-1] + 1) * size), aspect="equal")
    draw_rooms(axis, _regions(drawn))
    for line in drawn["lines"]:
        axis.plot(*np.array(line).T, color=common.BLUE, linewidth=0.9)
    axis.plot(*np.array(drawn["nodes"]).T, ".", color=common.RED, markersize=3.5)
    axis.set(title=f"{drawn['name']}: rooms, doors and routes", xlabel="x [m]", ylabel="y [m]")


def _regions(drawn: Numbers) -> Regions:
    """The rooms and doors that are drawn."""
    rooms = [[np.array(ring) for ring in room["rings"]] for room in drawn["rooms"]]
    return Regions(
        label=np.zeros((0, 0), np.int32),
        regions=tuple(
            Region(room["name"], "room", rings[0], room["area_m2"], (), (), tuple(rings[1:]))
            for room, rings in zip(drawn["rooms"], rooms, strict=True)
        ),
        doors=tuple(
            Door(f"door_{k}", np.mean(jambs, axis=0), np.array(jambs), 1.0, (0, 0))
            for k, jambs in enumerate(drawn["doors"], start=1)
        ),
        resolution=1.0,
        origin=np.zeros(3),
    )


def _draw_detours(axis, rows: list[Numbers]) -> None:
    """Bars of the median detour, lines to that of nine routes of ten, and the share joined."""
    groups: dict[str, list[Numbers]] = {}
    for row in rows:
        groups.setdefault(KINDS[row["kind"]] + row["name"], []).append(row)
    methods = [name for name in COLOURS if any(row["method"] == name for row in rows)]
    y, ticks = 0.0, []
    for own in groups.values():
        first = y
        for row in sorted(own, key=lambda row: methods.index(row["method"])):
            if row["detour_median"] is not None:
                colour = COLOURS[row["method"]]
                axis.barh(y, row["detour_median"] - 1.0, left=1.0, height=0.85, color=colour)
                axis.plot([row["detour_median"], row["detour_p90"]], [y, y], color="0.3", lw=1.0)
                if row["routed"] < ALL:
                    text = f" {row['routed']:.0%}"
                    axis.text(row["detour_p90"], y, text, va="center", fontsize=7)
            y += 1.0
        ticks.append((first + y - 1.0) / 2)
        y += 0.8
    for name in methods:
        axis.barh(0.0, 0.0, color=COLOURS[name], label=name)
    axis.set_yticks(ticks, list(groups))
    axis.set(
        title="length of route / shortest path",
        xlabel="median (bar), 90 % of routes (line)",
    )
    axis.set_xlim(left=1.0)
    axis.invert_yaxis()
    axis.legend(frameon=False, fontsize=8)
