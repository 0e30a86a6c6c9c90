"""Speed of trials in a building of many walls, in life, against those of the plain office."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import common
from experiments.timing import fastest
from jaxslam.core.batching import map_batches
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend.extract import SCAN_BATCH
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.simulation import (
    RangeErrors,
    Traffic,
    WheelFaults,
    World,
    cast,
    life_in,
    trials,
    with_index,
)

NUM_WALLS = 5000
RANGES = RangeErrors(std_by_incidence=0.5, spot=0.003, missing=0.1, black=0.05, glass=0.05)
TRAFFIC = Traffic(people=10)
WHEELS = WheelFaults(slip=0.02, carpet=0.2, lost=0.002, dropped=0.02)


def cut(walls: np.ndarray, count: int) -> np.ndarray:
    """About `count` walls (S, 4) [m] that cover the same lines: longer ones in more pieces."""
    length = np.hypot(*(walls[:, 2:] - walls[:, :2]).T)
    pieces = np.maximum(np.round(length / length.sum() * count).astype(int), 1)
    found = []
    for wall, number in zip(walls, pieces, strict=True):
        share = np.linspace(0.0, 1.0, number + 1)[:, None]
        points = wall[:2] + share * (wall[2:] - wall[:2])
        found.append(np.hstack([points[:-1], points[1:]]))
    return np.concatenate(found)


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
    keys = trials.trial_keys(jax.random.key(seed), np.arange(num_trials))
    walls = cut(np.asarray(office.walls), NUM_WALLS)
    plain = World(jnp.asarray(walls, float))
    indexed = with_index(plain, lidar.range_max)
    life = life_in(plain, path, ranges=RANGES, traffic=TRAFFIC, wheels=WHEELS)

    def chain(world: World, **more: Any) -> Any:
        simulated = trials.simulate_keys(
            keys, config, robot, world, path, num_scans=num_scans, **more
        )
        return episodes.filter_episodes(config, params, simulated)

    simulated = trials.simulate_keys(keys, config, robot, office, path, num_scans=num_scans)
    poses = simulated.truth.reshape(-1, 3)

    def ray_casting(world: World) -> Any:
        casting = jax.jit(partial(map_batches, partial(cast, lidar, world), batch_size=SCAN_BATCH))
        return casting, poses

    taken = fastest(
        {
            "office": (chain, office),
            "in_life": (partial(chain, life=life), indexed),
            "rays_office": ray_casting(office),
            "rays": ray_casting(indexed),
        },
        repeats=repeats,
    )
    few = poses[: 4 * SCAN_BATCH]
    slow = jax.jit(partial(map_batches, partial(cast, lidar, plain), batch_size=SCAN_BATCH))
    brute_force = fastest({"rays": (slow, few)}, repeats=repeats)["rays"] / len(few)
    count = len(poses)
    us = {name: 1e6 * taken[name] / count for name in ("rays_office", "rays")}
    return {
        "walls": len(walls),
        "office_walls": len(office.walls),
        "people": TRAFFIC.people,
        "scans": count,
        "scans_per_second": {name: count / taken[name] for name in ("office", "in_life")},
        "in_life_vs_office": taken["office"] / taken["in_life"],
        "us_per_scan": us | {"rays_brute_force": 1e6 * brute_force},
        "rays_vs_brute_force": 1e6 * brute_force / us["rays"],
        "rays_vs_office": us["rays"] / us["rays_office"],
    }
