"""Monte-Carlo evaluation: simulate many trials, run the filter on each, summarise the errors.

The only module, beside `fit`, in which arrays lead with B, the number of trials.
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

SUBSTEPS = 4  # parts of the motion between two scans with encoder noise of their own
RUNS = 4  # trials that a device filters together


class Log(NamedTuple):
    """Data of one drive, simulated or recorded: what the filter is given, and the ground truth.

    Attributes:
        truth: (T, 3) [m, m, rad] pose at each scan, world frame; the filter starts at the first.
        motion: (T, 3) [m, m, rad] odometry increment since the scan before, zero at the first.
        nodes: [T] features of each scan, robot frame.
        known: (T, M) int32 landmark of each feature, -1 unknown; None: data association is run.
        judged: (T,) bool True where `truth` is known and errors count; None: everywhere.
        length: () int32 number of scans, those after it are padding; None: T.
        aligned: [T] odometry increments by scan matching, fused with `motion`; None: not used.
    """

    truth: Array
    motion: Array
    nodes: Nodes
    known: Array | None = None
    judged: Array | None = None
    length: Array | None = None
    aligned: Aligned | None = None


def inputs_of(log: Log) -> Inputs:
    """Measurements and controls [T] of a drive, as the filter takes them."""
    return Inputs(log.motion, log.nodes, log.known, log.aligned)


class Track(NamedTuple):
    """Result of the filter on one drive, for evaluation.

    Attributes:
        truth: (T, 3) [m, m, rad] true pose at each scan, world frame.
        estimate: (T, 3) [m, m, rad] online estimate of it.
        cov: (T, 3, 3) covariance of the estimate.
        odometry: (T, 3) [m, m, rad] dead reckoning.
        matches: (T,) int32 number of features that updated the state.
        landmarks: () int32 number of confirmed landmarks at the end.
        finite: () bool False if an update was left out because it was not finite.
        judged: (T,) bool True where `truth` is known and errors count.
        length: () int32 number of scans, those after it are padding.
    """

    truth: Array
    estimate: Array
    cov: Array
    odometry: Array
    matches: Array
    landmarks: Array
    finite: Array
    judged: Array
    length: Array


def start(path: Array) -> Array:
    """Pose (3,) at the beginning of a path (N, 2) [m, world], heading along it."""
    along = path[5] - path[0]
    return jnp.append(path[0], jnp.arctan2(along[1], along[0]))


def drive(key: Key, robot: Robot, path: Array, *, steps: int) -> tuple[Array, Array]:
    """Drive along a path by pure pursuit, steered by the true pose.

    Args:
        key: Of the encoder noise.
        robot: With its encoder noise.
        path: (N, 2) [m, world].
        steps: T, number of scans.

    Returns:
        True poses (T, 3) [m, m, rad] in the world and odometry increments (T, 3), zero at the
        first.
    """
    first = start(path)
    draws = jax.random.normal(key, (steps - 1, SUBSTEPS, 2), path.dtype)

    def body(carry, draw):
        pose, path_index = carry
        odometry, path_index = plan.follow(path, path_index, pose)
        pose = compose(pose, motion.roll(robot, draw, odometry))
        return (pose, path_index), (pose, odometry)

    _, (poses, odometry) = lax.scan(body, (first, jnp.int32(0)), draws)
    return jnp.concatenate([first[None], poses]), jnp.pad(odometry, ((1, 0), (0, 0)))


def drive_steps(robot: Robot, path: Array) -> int:
    """Number of scans on a noise-free drive to the end of a path (N, 2)."""
    upper_bound = 40 + int(4 * np.sum(np.linalg.norm(np.diff(path, axis=0), axis=1)) / 0.3)
    noise_free = robot._replace(wheel_noise=0.0)
    simulated = jax.jit(partial(drive, steps=upper_bound), static_argnums=1)
    _, odometry = simulated(jax.random.key(0), noise_free, path)
    moving = np.abs(np.asarray(odometry)[1:]).sum(axis=1) > 0
    return 1 + int(moving.sum())


def simulate_one(
    key: Key, config: Config, world: World, robot: Robot, path: Array, *, steps: int
) -> Log:
    """One trial: drive along `path` (N, 2), scan the world `steps` times, extract features."""
    truth, odometry, scan_keys = _drive(key, robot, path, steps=steps)

    def features(item: tuple[Array, Key]) -> Nodes:
        return slam.front_end(config, _scan(config, world, *item))

    extracted = map_batches(features, (truth, scan_keys), size=slam.BATCH)
    return Log(truth=truth, motion=odometry, nodes=extracted)


def simulate_scans(
    key: Key, config: Config, world: World, robot: Robot, path: Array, *, steps: int
) -> tuple[Array, Array, Scan]:
    """True poses (T, 3), odometry increments (T, 3) and scans [T] of `simulate_one`."""
    truth, odometry, scan_keys = _drive(key, robot, path, steps=steps)
    return truth, odometry, lax.map(lambda x: _scan(config, world, *x), (truth, scan_keys))


def _drive(key: Key, robot: Robot, path: Array, *, steps: int) -> tuple[Array, Array, Key]:
    """True poses (T, 3), odometry increments (T, 3), and a key (T,) for each scan."""
    drive_key, scan_key = jax.random.split(key)
    truth, odometry = drive(drive_key, robot, path, steps=steps)
    return truth, odometry, jax.random.split(scan_key, steps)


def _scan(config: Config, world: World, pose: Array, key: Key) -> Scan:
    """Noisy scan of the world from a pose (3,)."""
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
    """Simulate one trial of an experiment again and run SLAM on it.

    Args:
        key: Key of the experiment; the other arguments, too, are those of `experiment`.
        config: Of front end and filter.
        noise: Q and R that the filter assumes.
        world: The world.
        robot: The robot, with its encoder noise.
        path: (N, 2) [m, world] to drive along.
        run: Number of the trial.
        steps: T, number of scans.

    Returns:
        True poses (T, 3), and the result of `online.survey`.
    """
    trial_key = run_keys(key, jnp.array([run]))[0]

    def scans_of(own: Key) -> tuple[Array, Array, Scan]:
        return simulate_scans(own, config, world, robot, path, steps=steps)

    truth, odometry, scans = jax.jit(scans_of)(trial_key)
    return truth, online.survey(config, noise, truth[0], odometry, scans)


@partial(jax.jit, static_argnames=("config", "robot", "steps"))
def simulate_keys(
    keys: Key, config: Config, world: World, robot: Robot, path: Array, *, steps: int
) -> Log:
    """Simulate one trial of `steps` scans for each of the keys (B,)."""
    return lax.map(lambda key: simulate_one(key, config, world, robot, path, steps=steps), keys)


def run_keys(key: Key, runs: Array) -> Key:
    """Keys (B,) of the trials with numbers (B,): each can be repeated without the others."""
    return jax.vmap(partial(jax.random.fold_in, key))(runs)


def simulate(
    key: Key, config: Config, world: World, robot: Robot, path: Array, *, runs: int, steps: int
) -> Log:
    """Simulate trials 0 to B - 1, each of `steps` scans along `path` (N, 2)."""
    keys = run_keys(key, jnp.arange(runs))
    return simulate_keys(keys, config, world, robot, path, steps=steps)


def dead_reckoning(first: Array, told: Array) -> Array:
    """Poses (T, 3) by composing odometry increments (T, 3) from the pose `first` (3,)."""

    def body(pose, increment):
        pose = compose(pose, increment)
        return pose, pose

    return lax.scan(body, first, told)[1]


def track(config: Config, noise: Noise, log: Log) -> Track:
    """Run the filter on one drive, from its true start."""
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
    """Run the filter on B drives with the same noise; RUNS at a time, which fits the cache."""
    return map_batches(partial(track, config, noise), logs, size=RUNS)


class _Common(NamedTuple):
    """What all trials of an experiment have in common.

    Attributes:
        key: Data of the experiment's key, which NumPy can hold.
        noise: Q and R that the filter assumes.
        world: The world.
        path: (N, 2) [m, world].
    """

    key: Array
    noise: Noise
    world: World
    path: Array


def _group_tracks(
    config: Config, robot: Robot, steps: int, key_type: Any, common: _Common, numbers: Array
) -> Track:
    """Simulate the trials with the numbers (RUNS,) in turn, and filter them together."""
    keys = run_keys(jax.random.wrap_key_data(common.key, impl=key_type), numbers)
    logs = simulate_keys(keys, config, common.world, robot, common.path, steps=steps)
    return tracks(config, common.noise, logs)


_spread_groups = Spread(_group_tracks, size=1, static=4)


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
    """Simulate and filter trials `first` to B - 1; yield their tracks in order, some at a time.

    A round gives each of D devices one group of RUNS trials. Round i + 1 is queued before round i
    is waited for, so devices work while the caller has the results of round i:

        host      queue 0, 1 | wait 0 | yield 0 | queue 2 | wait 1 | yield 1 | wait 2 | yield 2
        devices     | round 0         | round 1           | round 2          |

    Memory is bounded by two rounds. The result of a trial depends neither on how many there are
    nor on where it runs, bit for bit where devices are alike. With several processes all must
    call it with the same arguments, and all get all tracks, which hold NumPy arrays.

    Args:
        key: Key of the experiment; trial i has `run_keys(key, i)`.
        config: Of front end and filter.
        noise: Q and R that the filter assumes.
        world: The world.
        robot: The robot, with its encoder noise.
        path: (N, 2) [m, world] to drive along.
        runs: B, number of trials.
        steps: T, scans of a trial.
        first: Number of the first trial; those before it were done by another call.
        devices: To be used; all, of all processes, by default.
    """
    devices = jax.devices() if devices is None else devices
    common = _Common(jax.random.key_data(key), noise, world, path)
    per_round = RUNS * len(devices)
    key_type = jax.random.key_impl(key)

    def begin(start: int) -> Callable[[], Track]:
        # The last round is filled up with its last trial, so that nothing is compiled again.
        numbers = np.minimum(start + np.arange(per_round, dtype=np.int32), runs - 1)
        groups = numbers.reshape(-1, RUNS)
        return _spread_groups.begin(config, robot, steps, key_type, common, groups, devices=devices)

    def end(start: int, finish: Callable[[], Track]) -> Track:
        wanted = slice(max(0, first - start), runs - start)
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[wanted], finish())

    pending = None
    # Groups begin at multiples of RUNS, whatever `first` is.
    for start in range(first - first % RUNS, runs, per_round):
        following = start, begin(start)
        if pending is not None:
            yield end(*pending)
        pending = following
    if pending is not None:
        yield end(*pending)


def evaluate(tracks: Track) -> dict:
    """Errors over all scans with ground truth, with the keys of `metrics.json`.

    `nees` is NEES per degree of freedom (divided by 3), 1 for a consistent filter. A trial has
    diverged when its position error at the last such scan exceeds 1 m or is not finite. Trials
    with values that are not finite count as diverged, are also counted separately, and are left
    out of the means. Both kinds are listed by number; `replay` repeats a trial by its number.
    """
    tracks = jax.tree.map(np.asarray, tracks)
    good = tracks.finite & np.all(np.isfinite(tracks.estimate), axis=(1, 2))
    error = np.asarray(pose_error(jnp.asarray(tracks.estimate), jnp.asarray(tracks.truth)))
    drift = np.asarray(pose_error(jnp.asarray(tracks.odometry), jnp.asarray(tracks.truth)))
    diverged = np.flatnonzero(~good | _far(error, tracks.judged))
    # Until the first motion the pose is certain, and NEES is not defined.
    ratio = np.asarray(nees(jnp.asarray(error), jnp.asarray(tracks.cov)))
    certain = np.trace(tracks.cov, axis1=-2, axis2=-1) < 1e-12
    evaluated = good[:, None] & tracks.judged
    has_nees = evaluated & ~certain & np.isfinite(ratio)
    return {
        "runs": len(error),
        "scans": int(tracks.length.sum()),
        **errors(error[evaluated]),
        "nees": float(np.mean(ratio[has_nees]) / 3) if has_nees.any() else None,
        "diverged": len(diverged),
        "diverged_runs": diverged.tolist(),
        "nonfinite": int(np.sum(~good)),
        "nonfinite_runs": np.flatnonzero(~good).tolist(),
        "landmarks": float(np.mean(tracks.landmarks)),
        "matches": float(tracks.matches.sum() / tracks.length.sum()),
        "dead_reckoning": errors(drift[evaluated])
        | {"diverged": int(_far(drift, tracks.judged).sum())},
    }


def _far(error: np.ndarray, evaluated: np.ndarray) -> np.ndarray:
    """Trials (B,) bool with a position error above 1 m, or none, at the last evaluated scan.

    Args:
        error: (B, T, 3) [m, m, rad] pose errors.
        evaluated: (B, T) bool scans with ground truth; trials without any are False.
    """
    last = evaluated.shape[1] - 1 - np.argmax(evaluated[:, ::-1], axis=1)
    distance = np.linalg.norm(error[np.arange(len(error)), last, :2], axis=-1)
    return evaluated.any(axis=1) & ~(distance <= 1.0)


def errors(error: np.ndarray) -> dict:
    """RMSE of position [m] and heading [deg] over pose errors (..., 3); None if there are none."""
    if error.size == 0:
        return {"position_rmse_m": None, "heading_rmse_deg": None}
    return {
        "position_rmse_m": float(np.sqrt(np.mean(np.sum(error[..., :2] ** 2, axis=-1)))),
        "heading_rmse_deg": float(np.degrees(np.sqrt(np.mean(error[..., 2] ** 2)))),
    }


def collect(parts: Iterable[Track]) -> Track:
    """Join groups of trials, as `experiment` yields them."""
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)
