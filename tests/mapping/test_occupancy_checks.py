"""An occupancy map that does not fit is refused, and named, by all functions that take one."""

import made_floor as floor
import numpy as np
import pytest
from made_floor import graph

from jaxslam.core.maps import check_occupancy
from jaxslam.mapping import drivable, extract_topology, find_regions, route
from jaxslam.mapping.global_map import build_global_map
from jaxslam.mapping.planner_data import planner_data

GRID = floor.occupancy()
START, GOAL = floor.at((1.0, 2.0), (8.0, 2.0))
OF_A_MAP = {
    "check": check_occupancy,
    "route": lambda grid: route(graph(), START, GOAL, occupancy=grid),
    "drivable": lambda grid: drivable(graph(), 0.2, occupancy=grid),
    "planner_data": lambda grid: planner_data(graph(), grid),
    "build_global_map": lambda grid: build_global_map(grid, np.zeros((1, 3)), graph(), 100),
}
OF_FIELDS = {
    "extract_topology": lambda grid: extract_topology(*grid[:2], **rest(grid), robot_radius=0.2),
    "find_regions": lambda grid: find_regions(*grid[:2], **rest(grid)),
}
EMPTY = np.zeros((0, 0), bool)
WRONG = [
    ({"occupied": GRID.occupied.astype(int)}, r"occupied is int64 \(121, 71\), not bool \(H, W\)"),
    ({"occupied": GRID.occupied[0]}, r"occupied is bool \(71,\), not bool \(H, W\)"),
    ({"free": GRID.free[1:]}, r"free is bool \(120, 71\), not bool \(121, 71\)"),
    ({"free": GRID.free.astype(np.uint8)}, "free is uint8"),
    ({"free": None}, r"free is object \(\)"),
    ({"occupied": EMPTY, "free": EMPTY}, r"occupied is bool \(0, 0\), without a cell"),
    ({"resolution": np.nan}, "resolution is nan, not a number of metres between 0.001 and 100"),
    ({"resolution": -0.1}, "resolution is -0.1, not a number of metres between 0.001 and 100"),
    ({"resolution": 101}, "resolution is 101.0, not a number of metres between 0.001 and 100"),
    ({"resolution": None}, r"resolution is object \(\), not numbers"),
    ({"origin": np.zeros(2)}, r"origin is float64 \(2,\), not \(3,\)"),
    ({"origin": [0.0, np.nan, 0.0]}, r"origin is \[0.0, nan, 0.0\], not finite"),
    ({"origin": None}, r"origin is object \(\), not numbers"),
]


def rest(grid):
    return {"resolution": grid.resolution, "origin": grid.origin}


@pytest.mark.parametrize("wrong, problem", WRONG)
@pytest.mark.parametrize("name", OF_A_MAP | OF_FIELDS)
def test_the_field_that_does_not_fit_is_named(name, wrong, problem):
    prefix = "occupancy." if name in OF_A_MAP else ""
    with pytest.raises(ValueError, match=f"^{prefix}{problem}"):
        (OF_A_MAP | OF_FIELDS)[name](GRID._replace(**wrong))


@pytest.mark.parametrize("name", OF_A_MAP)
def test_what_is_no_occupancy_map_is_named(name):
    with pytest.raises(ValueError, match="^occupancy is tuple, not OccupancyMap"):
        OF_A_MAP[name](tuple(GRID))
    if name not in ("route", "drivable"):
        with pytest.raises(ValueError, match="^occupancy is NoneType, not OccupancyMap"):
            OF_A_MAP[name](None)


def test_arrays_and_lists_are_taken_and_cells_are_not_copied():
    found = check_occupancy(GRID._replace(resolution=1, origin=[1, 2, 0], notes=("turned",)))
    assert found.occupied is GRID.occupied and found.free is GRID.free
    assert isinstance(found.resolution, float) and found.notes == ("turned",)
    np.testing.assert_array_equal(found.origin, [1.0, 2.0, 0.0])
    listed = check_occupancy(GRID._replace(occupied=GRID.occupied.tolist()))
    np.testing.assert_array_equal(listed.occupied, GRID.occupied)
