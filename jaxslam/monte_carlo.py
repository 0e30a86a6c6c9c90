"""Many runs at once: simulate them, filter them, sum up their errors.

The only module, beside `fit`, in which arrays lead with B, the runs.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam import lidar, motion, online, plan, slam
from jaxslam.alignment import Aligned
from jaxslam.batches import Spread, map_batches
from jaxslam.geometry import compose
from jaxslam.lidar import Scan
from jaxslam.metrics import nees, pose_error
from jaxslam.motion import Robot
from jaxslam.nodes import Nodes
from jaxslam.online import Survey
from jaxslam.slam import Config, Inputs, Noise
from jaxslam.types import Array, Key
from jaxslam.world import World

SUBSTEPS = 4  # parts in which the wheels' noise is drawn between two scans
RUNS = 4  # runs that are filtered together


class Log(NamedTuple):
    """One run, simulated or recorded: what happened and what the robot was told of it."""

    truth: Array  # (T, 3) pose at each scan, world frame; the first is where the filter starts
    motion: Array  # (T, 3) odometry since the scan before, zero at the first
    nodes: Nodes  # [T] features of each scan
    known: Array | None = None  # (T, M) int32 landmark each feature is, -1 unknown; or match
    judged: Array | None = None  # (T,) bool, where the truth is known; everywhere unless given
    length: Array | None = None  # () int32 steps that took place, the first ones; all unless given
    aligned: Aligned | None = None  # [T] the motions by scans, where odometry is taken from them


def inputs_of(log: Log) -> Inputs:
    """What the filter is given of a run."""
    return Inputs(log.motion, log.nodes, log.known, log.aligned)


class Track(NamedTuple):
    """One filtered run, for evaluation."""

    truth: Array  # (T, 3)
    estimate: Array  # (T, 3)
    cov: Array  # (T, 3, 3)
    odometry: Array  # (T, 3) dead reckoning
    matches: Array  # (T,) int32 features that updated the state
    landmarks: Array  # () int32 landmarks that count at the end
    finite: Array  # () bool
    judged: Array  # (T,) bool, where the truth is known
    length: Array  # () int32 steps that took place


def start(path: Array) -> Array:
    """Pose (3,) at the beginning of a path (N, 2), looking along it."""
    ahead = path[5] - path[0]
    return jnp.append(path[0], jnp.arctan2(ahead[1], ahead[0]))


def drive(key: Key, robot: Robot, path: Array, *, steps: int) -> tuple[Array, Array]:
    """Drive along a path (N, 2), steered by the true pose.

    Returns:
        True poses (T, 3) and odometry increments (T, 3), one for each of `steps` scans.
    """
    first = start(path)
    draws = jax.random.normal(key, (steps - 1, SUBSTEPS, 2), path.dtype)

    def body(now, draw):
        pose, place = now
        told, place = plan.follow(path, place, pose)
        pose = compose(pose, motion.roll(robot, draw, told))
        return (pose, place), (pose, told)

    _, (poses, told) = lax.scan(body, (first, jnp.int32(0)), draws)
    return jnp.concatenate([first[None], poses]), jnp.pad(told, ((1, 0), (0, 0)))


def drive_steps(robot: Robot, path: Array) -> int:
    """Number of scans on a noise-free drive to the end of a path (N, 2)."""
    most = 40 + int(4 * np.sum(np.linalg.norm(np.diff(path, axis=0), axis=1)) / 0.3)
    still = robot._replace(wheel_noise=0.0)
    told = jax.jit(partial(drive, steps=most), static_argnums=1)(jax.random.key(0), still, path)[1]
    moving = np.abs(np.asarray(told)[1:]).sum(axis=1) > 0
    return 1 + int(moving.sum())


def simulate_one(
    key: Key, config: Config, world: World, robot: Robot, path: Array, *, steps: int
) -> Log:
    """Drive once along `path` (N, 2) and look at the world `steps` times."""
    truth, told, scan_keys = _drive(key, robot, path, steps=steps)

    def look(now: tuple[Array, Key]) -> Nodes:
        return slam.front_end(config, _scan(config, world, *now))

    seen = map_batches(look, (truth, scan_keys), size=slam.BATCH)
    return Log(truth=truth, motion=told, nodes=seen)


def simulate_scans(
    key: Key, config: Config, world: World, robot: Robot, path: Array, *, steps: int
) -> tuple[Array, Array, Scan]:
    """True poses (T, 3), odometry (T, 3) and scans [T] of the drive of `simulate_one`."""
    truth, told, scan_keys = _drive(key, robot, path, steps=steps)
    return truth, told, lax.map(lambda now: _scan(config, world, *now), (truth, scan_keys))


def _drive(key: Key, robot: Robot, path: Array, *, steps: int) -> tuple[Array, Array, Key]:
    drive_key, scan_key = jax.random.split(key)
    return *drive(drive_key, robot, path, steps=steps), jax.random.split(scan_key, steps)


def _scan(config: Config, world: World, pose: Array, key: Key) -> Scan:
    return lidar.disturb(key, lidar.cast(world, pose, config.lidar), config.lidar)


def replay(
    key: Key,
    config: Config,
    noise: Noise,
    world: World,
    robot: Robot,
    path: Array,
    *,
    run: int,
    steps: int,
) -> tuple[Array, Survey]:
    """Simulate one run of an experiment again and map it: its true poses (T, 3) and its survey."""
    own = run_keys(key, jnp.array([run]))[0]

    alone = lambda own: simulate_scans(own, config, world, robot, path, steps=steps)
    truth, told, scans = jax.jit(alone)(own)
    return truth, online.survey(config, noise, truth[0], told, scans)


@partial(jax.jit, static_argnames=("config", "robot", "steps"))
def simulate_keys(
    keys: Key, config: Config, world: World, robot: Robot, path: Array, *, steps: int
) -> Log:
    """Simulate one run of `steps` scans for each of the keys (B,)."""
    return lax.map(lambda key: simulate_one(key, config, world, robot, path, steps=steps), keys)


def run_keys(key: Key, runs: Array) -> Key:
    """Keys (B,) of the runs with numbers (B,): one run can be replayed without the others."""
    return jax.vmap(partial(jax.random.fold_in, key))(runs)


def simulate(
    key: Key, config: Config, world: World, robot: Robot, path: Array, *, runs: int, steps: int
) -> Log:
    """Simulate runs 0 to B - 1, each of `steps` scans along `path` (N, 2)."""
    keys = run_keys(key, jnp.arange(runs))
    return simulate_keys(keys, config, world, robot, path, steps=steps)


def dead_reckoning(first: Array, told: Array) -> Array:
    """Poses (T, 3) by composing odometry increments (T, 3) from the pose `first` (3,)."""

    def body(pose, step):
        pose = compose(pose, step)
        return pose, pose

    return lax.scan(body, first, told)[1]


def track(config: Config, noise: Noise, log: Log) -> Track:
    """Filter one run from its true start."""
    belief, info = slam.run(config, noise, slam.init(config, log.truth[0]), inputs_of(log))
    return Track(
        truth=log.truth,
        estimate=info.pose,
        cov=info.pose_cov,
        odometry=dead_reckoning(log.truth[0], log.motion),
        matches=jnp.sum(info.used, axis=1, dtype=jnp.int32),
        landmarks=jnp.sum(slam.confirmed(config, belief), dtype=jnp.int32),
        finite=jnp.all(info.finite),
        judged=jnp.ones(len(log.truth), bool) if log.judged is None else log.judged,
        length=jnp.int32(len(log.truth)) if log.length is None else log.length,
    )


@partial(jax.jit, static_argnames="config")
def tracks(config: Config, noise: Noise, logs: Log) -> Track:
    """Filter B runs, all with the same noise; a few at a time, which stays in the cache."""
    return map_batches(partial(track, config, noise), logs, size=RUNS)


class _Setting(NamedTuple):
    """What all runs of an experiment have in common."""

    key: Array  # the data of a key, which NumPy can hold
    noise: Noise
    world: World
    path: Array  # (N, 2)


def _group(
    config: Config, robot: Robot, steps: int, kind: Any, setting: _Setting, numbers: Array
) -> Track:
    """Simulate the runs with a few numbers (RUNS,) one by one, and filter them together."""
    keys = run_keys(jax.random.wrap_key_data(setting.key, impl=kind), numbers)
    logs = simulate_keys(keys, config, setting.world, robot, setting.path, steps=steps)
    return tracks(config, setting.noise, logs)


_groups = Spread(_group, size=1, static=4)


def experiment(
    key: Key,
    config: Config,
    noise: Noise,
    world: World,
    robot: Robot,
    path: Array,
    *,
    runs: int,
    steps: int,
    first: int = 0,
    devices: Sequence[jax.Device] | None = None,
) -> Iterator[Track]:
    """Simulate and filter runs `first` to B - 1; yield their tracks a few at a time, in order.

    Each device does RUNS of them at a time. What becomes of a run depends neither on how many
    there are nor on where it runs, bit for bit where devices are alike. Memory is bounded by the
    runs under way: those of a next call begin before those of the last are handed out. With
    several processes all must call it alike, and all get all tracks, which hold NumPy arrays.

    Args:
        key: Key of the experiment; run i has `run_keys(key, i)`.
        config: Of front end and filter.
        noise: What the filter assumes.
        world: The world.
        robot: The robot, with the noise of its encoders.
        path: (N, 2) way of the robot.
        runs: B.
        steps: Scans of a run.
        first: Number of the first run; those before it were done by another call.
        devices: To be used; all, of all processes, by default.
    """
    devices = jax.devices() if devices is None else devices
    setting = _Setting(jax.random.key_data(key), noise, world, path)
    together = RUNS * len(devices)

    def begin(start: int) -> Callable[[], Track]:
        # What is missing in a last call repeats the last run, so that nothing is compiled again.
        numbers = np.minimum(start + np.arange(together, dtype=np.int32), runs - 1)
        groups = numbers.reshape(-1, RUNS)
        fixed = config, robot, steps, jax.random.key_impl(key)
        return _groups.begin(*fixed, setting, groups, devices=devices)

    def end(start: int, finish: Callable[[], Track]) -> Track:
        fold = lambda x: x.reshape(-1, *x.shape[2:])[max(0, first - start) : runs - start]
        return jax.tree.map(fold, finish())

    waiting = ()
    # Groups begin at multiples of RUNS, wherever the first run is.
    for start in range(first - first % RUNS, runs, together):
        begun = start, begin(start)
        if waiting:
            yield end(*waiting)
        waiting = begun
    if waiting:
        yield end(*waiting)


def evaluate(tracks: Track) -> dict:
    """Errors over all steps whose truth is known, with the keys of `metrics.json`.

    A run has diverged when its position error at the last of them exceeds 1 m or is no number;
    runs with numbers that are none are counted there, and apart, and left out of the means. Each
    is listed with its number, and `run_keys` of the experiment's key and that number is its own
    key: with it `replay` does the run alone.
    """
    tracks = jax.tree.map(np.asarray, tracks)
    good = tracks.finite & np.all(np.isfinite(tracks.estimate), axis=(1, 2))
    error = np.asarray(pose_error(jnp.asarray(tracks.estimate), jnp.asarray(tracks.truth)))
    blind = np.asarray(pose_error(jnp.asarray(tracks.odometry), jnp.asarray(tracks.truth)))
    diverged = np.flatnonzero(~good | _far(error, tracks.judged))
    # Until the first motion the pose is certain, and NEES has no meaning.
    ratio = np.asarray(nees(jnp.asarray(error), jnp.asarray(tracks.cov)))
    certain = np.trace(tracks.cov, axis1=-2, axis2=-1) < 1e-12
    judged = good[:, None] & tracks.judged
    use = judged & ~certain & np.isfinite(ratio)
    return {
        "runs": len(error),
        "scans": int(tracks.length.sum()),
        **errors(error[judged]),
        "nees": float(np.mean(ratio[use]) / 3) if use.any() else None,
        "diverged": len(diverged),
        "diverged_runs": diverged.tolist(),
        "nonfinite": int(np.sum(~good)),
        "nonfinite_runs": np.flatnonzero(~good).tolist(),
        "landmarks": float(np.mean(tracks.landmarks)),
        "matches": float(tracks.matches.sum() / tracks.length.sum()),
        "dead_reckoning": errors(blind[judged])
        | {"diverged": int(_far(blind, tracks.judged).sum())},
    }


def _far(error: np.ndarray, judged: np.ndarray) -> np.ndarray:
    """Runs (B,) bool with an error (B, T, 3) above 1 m at the last step (B, T) that is judged."""
    at = judged.shape[1] - 1 - np.argmax(judged[:, ::-1], axis=1)
    last = error[np.arange(len(error)), at, :2]
    return judged.any(axis=1) & ~(np.linalg.norm(last, axis=-1) <= 1.0)


def errors(error: np.ndarray) -> dict:
    """RMSE of position [m] and heading [deg] over pose errors (..., 3); None of no errors."""
    if error.size == 0:
        return {"position_rmse_m": None, "heading_rmse_deg": None}
    return {
        "position_rmse_m": float(np.sqrt(np.mean(np.sum(error[..., :2] ** 2, axis=-1)))),
        "heading_rmse_deg": float(np.degrees(np.sqrt(np.mean(error[..., 2] ** 2)))),
    }


def collect(parts: Iterable[Track]) -> Track:
    """All groups of runs as one."""
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)
