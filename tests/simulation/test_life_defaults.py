"""The typical life: shares and numbers are those of its parameters."""

import jax
import numpy as np

from jaxslam.simulation import World, densify
from jaxslam.simulation.life import draw_events
from jaxslam.simulation.life_defaults import (
    CARTS,
    PEOPLE_PER_METRE,
    RANGES,
    WHEELS,
    typical_life,
    walkway_length,
)

NUM_WALLS, NUM_SCANS = 1500, 2000
PATH = densify([(0.5, 0.5), (80.5, 0.5), (80.5, 60.5)])


def test_metres_that_are_driven_again_do_not_count():
    once = walkway_length(PATH)
    assert abs(once - 140) <= 2
    assert walkway_length(np.concatenate([PATH, PATH[::-1]])) == once


def test_shares_are_those_of_the_parameters():
    """Walls far from one another are black, wheels slip and people walk as often as they should."""
    start = 10.0 * np.arange(NUM_WALLS)[:, None] * [1.0, 0.0]
    world = World(np.hstack([start, start + [0.0, 3.0]]))
    life = typical_life(world, PATH)
    assert len(life.movers.people) == round(PEOPLE_PER_METRE * walkway_length(PATH)) > 0
    assert float(life.traffic.people) == len(life.movers.people)
    events = draw_events(jax.random.key(0), life, NUM_SCANS)
    slips = np.asarray(events.faults.slip) > 0.0
    for found, share in ((events.black, RANGES.black), (slips, WHEELS.slip)):
        error = np.sqrt(share * (1.0 - share) / np.size(found))
        assert abs(np.asarray(found).mean() - share) < 4.5 * error
    assert not np.asarray(events.glass).any()
    assert float(life.traffic.carts) == CARTS


def test_what_is_given_takes_the_place_of_what_is_typical():
    world = World(np.array([[0.0, 5.0, 9.0, 5.0]]))
    life = typical_life(world, PATH, people_per_metre=0.0, max_people=3)
    assert float(life.traffic.people) == 0.0 and len(life.movers.people) == 3
    still = typical_life(world, PATH, ranges=RANGES._replace(black=0.0), wheels=WHEELS)
    assert float(still.ranges.black) == 0.0 and float(still.wheels.slip) == WHEELS.slip
