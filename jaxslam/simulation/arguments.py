"""Arguments of simulations: taken in any form, and checked before anything is compiled.

An argument that is refused raises ValueError, which names it, what was given, and what is expected.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.arguments import as_float
from jaxslam.core.types import Array
from jaxslam.simulation import named_worlds, worlds
from jaxslam.simulation.path_following import LOOKAHEAD, SEARCH_WINDOW
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.worlds import World

MIN_PATH_POINTS = 6  # the first and the sixth give the direction in which the drive starts
MAX_PATH_GAP = 1.0  # [m] between points of a path; of sparser ones the robot cuts the corners


def check_key(key: Any) -> None:
    """Raise ValueError unless this is one key made by `jax.random.key`."""
    is_key = isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    if not is_key or key.shape:
        given = f"{key.dtype} {key.shape}" if isinstance(key, jax.Array) else repr(key)
        raise ValueError(f"key is {given}, not one key as jax.random.key(seed) makes it")


def as_robot(robot: Any) -> Robot:
    """The robot with Python's floats, so that it is static under jit.

    Raises:
        ValueError: It is no `Robot`, or one of its fields is not possible.
    """
    if not isinstance(robot, Robot):
        raise ValueError(f"robot is {type(robot).__name__}, not Robot")
    robot = Robot(*(_plain(*field) for field in robot._asdict().items()))
    for name in ("wheel_base", "wheel_base_scale", "scan_period"):
        if not 0.0 < getattr(robot, name) < np.inf:
            raise ValueError(f"robot.{name} is {getattr(robot, name)}, not above 0")
    if not 0.0 <= robot.encoder_noise < np.inf:
        raise ValueError(f"robot.encoder_noise is {robot.encoder_noise}, not 0 or more")
    if not all(0.0 < scale < np.inf for scale in robot.wheel_scales):
        raise ValueError(f"robot.wheel_scales is {robot.wheel_scales}, not two numbers above 0")
    if not np.isfinite([*robot.mount, robot.time_offset]).all():
        name = "time_offset" if np.isfinite(robot.mount).all() else "mount"
        raise ValueError(f"robot.{name} is {getattr(robot, name)}, not finite")
    return robot


def _plain(name: str, value: Any) -> Any:
    """A field of a robot as a float, or as a tuple of floats where the default is one."""
    shape = np.shape(Robot._field_defaults[name])
    try:
        numbers = np.asarray(value, float)
    except (TypeError, ValueError):
        numbers = None
    if numbers is None or numbers.shape != shape:
        wanted = f"{shape[0]} numbers" if shape else "a number"
        raise ValueError(f"robot.{name} is {value!r}, not {wanted}")
    return tuple(numbers.tolist()) if shape else float(numbers)


def as_world(world: Any) -> World:
    """A world in JAX's precision, of its name or of walls.

    Raises:
        ValueError: There is no world of this name, or the walls are not (S, 4) finite numbers.
    """
    if isinstance(world, str):
        return World(jnp.asarray(named_worlds.named_world(world).walls, float))
    if not isinstance(world, World):
        raise ValueError(
            f"world is {type(world).__name__}, not World or one of the names "
            f"{', '.join(worlds.NAMES)}"
        )
    walls = as_float("world.walls", world.walls, ("S", 4))
    if not np.isfinite(walls).all():
        raise ValueError("world.walls holds numbers that are not finite")
    return World(walls)


def as_path(path: Any, world: Any) -> Array:
    """A path (N, 2) [m] in JAX's precision.

    Args:
        path: Its points; None for the drive of the world: its own, a patrol in a random building.
        world: Name of the world, or `World`.

    Raises:
        ValueError: The points are not finite, too few, or too far apart or too close together to be
            followed; or there is no path, and the world has none of its own.
    """
    if path is None:
        if not isinstance(world, str):
            raise ValueError(
                "path is None; a world without a name has no drive of its own: find one with "
                "jaxslam.simulation.patrols"
            )
        return jnp.asarray(named_worlds.named_path(world), float)
    points = as_float("path", path, ("N", 2))
    check_path(points)
    if not np.isfinite(points).all():
        raise ValueError("path holds numbers that are not finite")
    gaps = np.hypot(*np.diff(np.asarray(points, float), axis=0).T)
    advice = "make it of waypoints by jaxslam.simulation.path_following.densify"
    if gaps.max() > MAX_PATH_GAP:
        raise ValueError(
            f"path has points {gaps.max():.2f} m apart; at most {MAX_PATH_GAP} m: {advice}"
        )
    if gaps.sum() > LOOKAHEAD > np.median(gaps) * (SEARCH_WINDOW - 1):
        raise ValueError(
            f"path has points {np.median(gaps):.4f} m apart; {SEARCH_WINDOW} of them must span "
            f"{LOOKAHEAD} m: {advice}"
        )
    return points


def check_path(path: Array) -> None:
    """Raise ValueError if a path (N, 2) has too few points to start along; while tracing, too."""
    if path.ndim != 2 or path.shape[1] != 2 or path.shape[0] < MIN_PATH_POINTS:
        raise ValueError(f"path is {path.shape}, not (N >= {MIN_PATH_POINTS}, 2)")
