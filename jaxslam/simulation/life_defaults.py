"""What goes wrong on a usual drive: one set of numbers, from four recorded logs.

`experiments.truth_to_life` compares the logs with their simulated counterparts and prints what each
of them asks for; these are about the medians. What a data sheet gives is not among them: noise,
resolution and turn time of a scanner are its own (`Scanner`).
"""

from typing import Any

import numpy as np

from jaxslam.simulation.life import Life, life_in
from jaxslam.simulation.range_errors import RangeErrors
from jaxslam.simulation.traffic import Traffic, walkway
from jaxslam.simulation.wheel_faults import WheelFaults
from jaxslam.simulation.worlds import World

RANGES = RangeErrors(shared_std=0.006, spot=0.0015, missing=0.0003, black=0.04)
"""On straight walls hardly a beam is missing alone: those that are missing are side by side."""
PEOPLE_PER_METRE = 0.013
"""[1 / m] of the walkway, of which metres that are driven again do not count."""
CARTS = 0.1
WHEELS = WheelFaults(slip=0.06, slip_share=0.05)


def typical_settings() -> dict[str, float]:
    """The same numbers by their names, as `jaxslam.io.life_file` has them."""
    found = {"people_per_metre": PEOPLE_PER_METRE, "carts": CARTS}
    for own, none in ((RANGES, RangeErrors()), (WHEELS, WheelFaults())):
        given, default = own._asdict(), none._asdict()
        found |= {key: float(x) for key, x in given.items() if x != default[key]}
    return found


def people_on(path: Any, people_per_metre: float) -> int:
    """Number of people on the walkway along a path (N, 2) [m]."""
    return int(np.round(people_per_metre * walkway_length(path)))


def typical_life(
    world: World,
    path: Any,
    *,
    people_per_metre: float = PEOPLE_PER_METRE,
    ranges: RangeErrors = RANGES,
    wheels: WheelFaults = WHEELS,
    **others: Any,
) -> Life:
    """Life in a world as it is on a usual drive.

    Args:
        world: The walls.
        path: (N, 2) [m] along which people walk.
        people_per_metre: [1 / m] of `walkway_length`.
        ranges: Errors of ranges.
        wheels: Faults of wheels, odometry and scans.
        others: As of `life_in`, but for `traffic`.

    Raises:
        ValueError: An argument is not possible.
    """
    traffic = Traffic(people=float(people_on(path, people_per_metre)), carts=CARTS)
    return life_in(world, path, ranges=ranges, traffic=traffic, wheels=wheels, **others)


def walkway_length(path: Any) -> int:
    """Metres of a path (N, 2) [m]: the squares of a metre that it passes, each counted once."""
    return len(np.unique(np.floor(walkway(path)), axis=0))
