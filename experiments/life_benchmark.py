"""Speed of trials in a building of many walls, in life, against those of the plain office."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import common
from experiments.timing import as_long_work, fastest
from jaxslam.core import polylines
from jaxslam.core.batching import map_batches
from jaxslam.core.episode import Episode
from jaxslam.core.types import Array
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend.extract import SCAN_BATCH
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.simulation import (
    Life,
    RangeErrors,
    Traffic,
    WheelFaults,
    World,
    cast,
    life_in,
    trial_episodes,
    with_index,
)
from jaxslam.simulation.named_worlds import named, named_path

BUILDING = "random:1:100x60"  # of 5,918 walls
PATH_LENGTH = 75.0  # [m] of its patrol, as long as the drive of the office
RANGES = RangeErrors(std_by_incidence=0.5, spot=0.003, missing=0.1, black=0.05, glass=0.05)
TRAFFIC = Traffic(people=10)
WHEELS = WheelFaults(slip=0.02, carpet=0.2, lost=0.002, dropped=0.02)


@as_long_work()
def compute(seed: int, num_trials: int, repeats: int) -> common.Numbers:
    """Scans per second of the chain plain and in life, and of ray casting with many walls.

    Args:
        seed: Of the trials.
        num_trials: Of each kind, at once.
        repeats: Rounds in which all are timed in turns.
    """
    config = Config()
    lidar = config.frontend.lidar
    office, robot, path, num_scans = common.drive_in()
    params = NoiseParams.for_simulated_robot(*robot[:2])
    keys = trial_episodes.trial_keys(jax.random.key(seed), np.arange(num_trials))
    plain = World(jnp.asarray(named(BUILDING).walls, float))
    indexed = with_index(plain, lidar.range_max)
    patrol = named_path(BUILDING)
    patrol = patrol[polylines.cumulative_lengths(patrol) < PATH_LENGTH]
    life = life_in(plain, patrol, ranges=RANGES, traffic=TRAFFIC, wheels=WHEELS)

    def simulate(world: World, path: Any, life: Life | None = None) -> Episode:
        return trial_episodes.simulate_drives(
            keys, config.frontend, robot, world, path, num_scans=num_scans, life=life
        )

    def chain(*arguments: Any) -> Any:
        return episodes.filter_episodes(config, params, simulate(*arguments))

    patrol = jnp.asarray(patrol, float)
    poses = {
        "office": simulate(office, path).truth.reshape(-1, 3),
        "building": simulate(indexed, patrol).truth.reshape(-1, 3),
    }

    def ray_casting(world: World, poses: Array) -> Any:
        casting = partial(map_batches, partial(cast, lidar, world), batch_size=SCAN_BATCH)
        return jax.jit(casting), poses

    taken = fastest(
        {
            "office": (chain, office, path),
            "in_life": (chain, indexed, patrol, life),
            "rays_office": ray_casting(office, poses["office"]),
            "rays": ray_casting(indexed, poses["building"]),
        },
        repeats=repeats,
    )
    few = poses["building"][: 4 * SCAN_BATCH.cpu]
    brute_force = fastest({"rays": ray_casting(plain, few)}, repeats=repeats)["rays"] / len(few)
    count = len(poses["office"])
    us = {name: 1e6 * taken[name] / count for name in ("rays_office", "rays")}
    return {
        "walls": len(plain.walls),
        "office_walls": len(office.walls),
        "people": TRAFFIC.people,
        "scans": count,
        "scans_per_second": {name: count / taken[name] for name in ("office", "in_life")},
        "in_life_vs_office": taken["office"] / taken["in_life"],
        "us_per_scan": us | {"rays_brute_force": 1e6 * brute_force},
        "rays_vs_brute_force": 1e6 * brute_force / us["rays"],
        "rays_vs_office": us["rays"] / us["rays_office"],
    }
