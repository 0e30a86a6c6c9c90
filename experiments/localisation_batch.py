"""How many robots are localised at once: steps a second on all devices, against one by one.

Robots start at random places beside a drive through the simulated office, and follow it. On a CPU a
batch is a loop on each device, so no more than the number of cores is to be gained; the
vectorised program is that of an accelerator.
"""

import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from experiments.common import Numbers
from jaxslam.core.devices import DeviceMap
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import compose, increments
from jaxslam.core.types import Array
from jaxslam.localisation import (
    LocaliseInfo,
    LocaliseSpec,
    LocaliseState,
    PlaceMap,
    init,
    map_of_scans,
    step,
)
from jaxslam.simulation import path_following, ray_casting, worlds

LIDAR = Lidar(num_beams=181, angle_increment=np.pi / 180, range_max=15.0, range_std=0.01)
SPEC = LocaliseSpec()
STEP = 0.5  # [m] from scan to scan
STEPS = 20  # of a robot
OFFSET = (0.2, 0.3)  # [m], [rad] from the drive that the map is of, at most
SINGLE = 16  # robots that are localised one by one
BATCH = 512  # robots of a vectorised batch on a device


def office_path() -> np.ndarray:
    """Poses (T, 3) of a drive through the office, 0.5 m apart."""
    path = path_following.densify(worlds.waypoints("office"))
    return path_following.poses_along(path, STEP)


def office_scans(poses: np.ndarray, seed: int) -> Scan:
    """Scans [T] of the office from poses (T, 3), with noise."""
    return _cast(jnp.asarray(poses, float), jax.random.split(jax.random.key(seed), len(poses)))


@jax.jit
def _cast(poses: Array, keys: Array) -> Scan:
    walls = worlds.World(jnp.asarray(worlds.named("office").walls, float))
    scans = lax.map(partial(ray_casting.cast, LIDAR, walls), poses)
    return jax.vmap(partial(ray_casting.add_range_noise, lidar=LIDAR))(keys, scan=scans)


def office_map() -> PlaceMap:
    """The map of the office, of scans along its drive."""
    path = office_path()
    return map_of_scans(SPEC, LIDAR, path, office_scans(path, 0))


def office_drives(count: int, steps: int, seed: int) -> tuple[np.ndarray, Scan, np.ndarray]:
    """Drives of B robots: poses (B, T, 3), scans [B, T], and odometry (B, T, 3) with noise."""
    path, rng = office_path(), np.random.default_rng(seed)
    first = rng.integers(0, len(path) - steps, count)
    position, heading = OFFSET
    off = rng.uniform(-1, 1, (count, 1, 3)) * [position, position, heading]
    poses = compose(path[first[:, None] + np.arange(steps)], off)
    odometry = np.stack([increments(one) for one in poses])
    odometry = odometry * rng.normal(1.0, 0.02, odometry.shape)
    odometry += rng.normal(0.0, (0.005, 0.005, 0.003), odometry.shape)
    odometry[:, 0] = 0.0
    scans = office_scans(poses.reshape(-1, 3), seed + 1)
    return poses, jax.tree.map(lambda x: x.reshape(count, steps, -1), scans), odometry


def _run(place_map: PlaceMap, item: tuple[Scan, Array]) -> LocaliseInfo:
    """All steps of a robot; vectorised over robots it is a batch."""

    def body(state: LocaliseState, now: tuple[Scan, Array]) -> tuple[LocaliseState, LocaliseInfo]:
        return step(SPEC, LIDAR, place_map, state, *now)

    return lax.scan(body, init(SPEC, LIDAR), item)[1]


_RUN_ALL = DeviceMap(_run, size=BATCH)


def measure(robots: int, seed: int) -> Numbers:
    """Steps a second of a batch on all devices, and of robots that are localised one by one."""
    place_map = office_map()
    poses, scans, odometry = office_drives(robots, STEPS, seed)
    items = jax.tree.map(np.asarray, (scans, odometry.astype(scans.ranges.dtype)))
    size = -(-robots // jax.device_count())
    warm = jax.tree.map(lambda x: x[: min(BATCH, size) * jax.device_count()], items)
    _RUN_ALL(place_map, warm)  # compiles
    start = time.perf_counter()
    infos = _RUN_ALL(place_map, items)
    batched = robots * STEPS / (time.perf_counter() - start)
    off = np.asarray(infos.pose, float)[:, -1] - poses[:, -1]
    single = _single_speed(place_map, items)
    return {
        "robots": robots,
        "steps": STEPS,
        "devices": jax.device_count(),
        "platform": jax.default_backend(),
        "right_at_the_end": float((np.hypot(off[:, 0], off[:, 1]) < 0.25).mean()),
        "batched_steps_per_s": batched,
        "single_steps_per_s": single,
        "ratio": batched / single,
    }


def _single_speed(place_map: PlaceMap, items: Any) -> float:
    """Steps a second of calls for one robot after the other, each waited for."""
    one = jax.jit(step, static_argnums=(0, 1))
    count = min(SINGLE, len(items[1]))

    def drive(robot: int) -> None:
        state = init(SPEC, LIDAR)
        for k in range(STEPS):
            scan, odometry = jax.tree.map(lambda x: x[robot, k], items)  # noqa: B023
            state, info = one(SPEC, LIDAR, place_map, state, scan, odometry)
            jax.block_until_ready(info)

    drive(0)  # compiles
    start = time.perf_counter()
    for robot in range(count):
        drive(robot)
    return count * STEPS / (time.perf_counter() - start)
