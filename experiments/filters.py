"""Other libraries' extended Kalman filters on `workload.rings`, as their users would set them up.

Their state is the same, pose and landmarks; what sees nothing has a zero row. dynamax and cuthbert
derive their Jacobians, filterpy is told them. Where the two take the odometry's noise in the world
frame it is the same noise, as it has no direction in the plane.
"""

from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.common import Numbers
from experiments.one_core import least
from experiments.workload import Drive, wrap
from jaxslam.core.se2 import compose, wrap_angle
from jaxslam.core.types import Array

STD = (0.02, 0.02, 0.01, 0.10, 0.03)  # of `workload.rings`: odometry x, y, heading; range, bearing
POSE_STD = 1e-4  # of the first pose [m, rad]; factors of a covariance have no derivative at zero
BATCH = 64  # runs together
PATIENCE = 2.0  # [s] for a call of a peer; it is of fewer runs where that is not enough
Track = Callable[[Array, Drive], Array]  # noise (5,) and a run to positions (T, 2)


def loss(track: Track, std: Array, run: Drive) -> Array:
    """Mean squared position error of a run."""
    return jnp.mean(jnp.sum((track(std, run) - run.truth[:, :2]) ** 2, axis=-1))


def _moved(x: Array, motion: Array) -> Array:
    return jnp.concatenate([compose(x[:3], motion), x[3:]])


def _expected(x: Array, polar: Array, who: Array) -> Array:
    """What is seen of the state, (2 M,), bearings within pi of those in `polar` (M, 2)."""
    offset = x[3:].reshape(-1, 2)[jnp.maximum(who, 0)] - x[None, :2]
    range_ = jnp.sqrt(jnp.sum(offset**2, axis=1))
    bearing = jnp.arctan2(offset[:, 1], offset[:, 0]) - x[2]
    bearing = polar[:, 1] + wrap_angle(bearing - polar[:, 1])
    return jnp.where((who >= 0)[:, None], jnp.stack([range_, bearing], -1), 0.0).reshape(-1)


def _prior(run: Drive) -> tuple[Array, Array]:
    """First mean (D,) and standard deviations (D,)."""
    mean = jnp.concatenate([jnp.zeros(3, run.prior.dtype), run.prior.reshape(-1)])
    spread = jnp.sqrt(jnp.diagonal(run.prior_cov, axis1=1, axis2=2)).reshape(-1)
    return mean, jnp.concatenate([jnp.full(3, POSE_STD, spread.dtype), spread])


def _noise(std: Array, run: Drive) -> tuple[Array, Array]:
    """Standard deviations of the state's noise (D,) and of what is seen (2 M,)."""
    still = jnp.zeros(run.prior.size, std.dtype)
    return jnp.concatenate([std[:3], still]), jnp.tile(std[3:], run.who.shape[1])


def _clean(run: Drive) -> Array:
    """What is seen (T, 2 M), zero where there is nothing."""
    return jnp.where(run.who[..., None] >= 0, run.polar, 0.0).reshape(len(run.who), -1)


def _dynamax() -> Track:
    models = import_module("dynamax.nonlinear_gaussian_ssm")
    seen = lambda u: (u[3:].reshape(-1, 3)[:, :2], u[3:].reshape(-1, 3)[:, 2].astype(jnp.int32))

    def track(std: Array, run: Drive) -> Array:
        mean, spread = _prior(run)
        move, see = _noise(std, run)
        dynamics = lambda x, u: _moved(x, u[:3])
        # Its prior is of the first observation, so the first motion comes before it.
        by_pose = jax.jacfwd(dynamics)(mean, run.motion[0])
        model = models.ParamsNLGSSM(
            initial_mean=dynamics(mean, run.motion[0]),
            initial_covariance=by_pose @ jnp.diag(spread**2) @ by_pose.T + jnp.diag(move**2),
            # The odometry that leads to a step is that of the input there.
            dynamics_function=dynamics,
            dynamics_covariance=jnp.diag(move**2),
            emission_function=lambda x, u: _expected(x, *seen(u)),
            emission_covariance=jnp.diag(see**2),
        )
        marks = jnp.concatenate([run.polar, run.who[..., None].astype(std.dtype)], axis=-1)
        inputs = jnp.concatenate([run.motion, marks.reshape(len(marks), -1)], axis=1)
        done = models.extended_kalman_filter(
            model, _clean(run), inputs, output_fields=["filtered_means"]
        )
        return done.filtered_means[:, :2]

    return track


def _cuthbert() -> Track:
    cuthbert, moments = import_module("cuthbert"), import_module("cuthbert.gaussian.moments")

    def track(std: Array, run: Drive) -> Array:
        mean, spread = _prior(run)
        move, see = (jnp.diag(x) for x in _noise(std, run))
        own = moments.build_filter(
            mean,
            jnp.diag(spread),
            lambda state, now: (lambda x: (_moved(x, now[0]), move), state.mean),
            lambda state, now: (lambda x: (_expected(x, *now[1:3]), see), state.mean, now[3]),
        )
        inputs = run.motion, run.polar, run.who, _clean(run)
        return cuthbert.filter(own, inputs, own.init_prepare()).mean[1:, :2]

    return track


def filterpy_track(std: np.ndarray, run: Drive, pose_std: float = 0.0) -> np.ndarray:
    """Positions (T, 2) of one run by filterpy, in float64.

    Args:
        std: (5,) noise.
        run: NumPy arrays, of which every landmark is known beforehand.
        pose_std: Of the first pose.

    Raises:
        ImportError: filterpy is not installed.
    """
    size = 3 + run.prior.size
    own = import_module("filterpy.kalman").ExtendedKalmanFilter(dim_x=size, dim_z=2)
    own.x = np.concatenate([np.zeros(3), run.prior.ravel()])
    own.P = np.diag(np.concatenate([np.full(3, pose_std**2), np.zeros(run.prior.size)]))
    for k, cov in enumerate(run.prior_cov):
        own.P[3 + 2 * k : 5 + 2 * k, 3 + 2 * k : 5 + 2 * k] = cov
    own.F, own.Q = np.eye(size), np.zeros((size, size))

    def moved(motion: np.ndarray) -> None:
        c, s = np.cos(own.x[2]), np.sin(own.x[2])
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        step = turn @ motion
        own.F[:2, 2] = -step[1], step[0]
        own.Q[:3, :3] = turn @ np.diag(std[:3] ** 2) @ turn.T
        own.x = np.concatenate([own.x[:3] + step, own.x[3:]])

    # Its own prediction of the mean is linear; ours takes its place.
    own.predict_x = moved

    def expected(x: np.ndarray, who: np.ndarray) -> np.ndarray:
        dx, dy = (x[3:].reshape(-1, 2)[who] - x[:2]).T
        return np.stack([np.hypot(dx, dy), np.arctan2(dy, dx) - x[2]], axis=-1).ravel()

    def derived(x: np.ndarray, who: np.ndarray) -> np.ndarray:
        h, row = np.zeros((len(who), 2, size)), np.arange(len(who))
        dx, dy = (x[3:].reshape(-1, 2)[who] - x[:2]).T
        r = np.hypot(dx, dy)
        by_place = np.array([[dx / r, dy / r], [-dy / r**2, dx / r**2]]).transpose(2, 0, 1)
        h[:, :, :2], h[:, 1, 2] = -by_place, -1.0
        for axis in range(2):
            h[row, :, 3 + 2 * who + axis] = by_place[:, :, axis]
        return h.reshape(-1, size)

    def error(seen: np.ndarray, told: np.ndarray) -> np.ndarray:
        off = (seen - told).reshape(-1, 2)
        return np.stack([off[:, 0], wrap(off[:, 1])], axis=-1).ravel()

    track = []
    for motion, polar, who in zip(run.motion, run.polar, run.who, strict=True):
        own.predict(motion)
        there = who >= 0
        if there.any():
            noise = np.kron(np.eye(there.sum()), np.diag(std[3:] ** 2))
            about = (who[there],)
            own.update(polar[there].ravel(), derived, expected, noise, about, about, error)
        track.append(own.x[:2])
    return np.array(track)


def _filterpy() -> Track:
    import_module("filterpy.kalman")
    return filterpy_track


PEERS = {"dynamax": _dynamax, "cuthbert": _cuthbert, "filterpy": _filterpy}


def _batched(track: Track, gradient: bool) -> Callable[[Array, Drive], Any]:
    """What a peer's users would write for a batch."""
    if track is filterpy_track:
        return lambda std, drive: [
            track(std, Drive(*(x[k] for x in drive))) for k in range(len(drive.who))
        ]
    one = jax.value_and_grad(partial(loss, track)) if gradient else track
    return jax.jit(jax.vmap(one, in_axes=(None, 0)))


def _figures(track: Track, gradient: bool, drive: Drive) -> Numbers:
    """Microseconds a robot-step, for one run and for as many as patience allows."""
    std = jnp.asarray(STD, drive.motion.dtype)
    if track is filterpy_track:
        std, drive = jax.tree.map(lambda x: np.asarray(x, float), (std, drive))
        drive = drive._replace(who=drive.who.astype(int))
    call, steps, told = _batched(track, gradient), drive.who.shape[1], {}
    count = 1
    for name in ("us_1_run", "us_in_batch"):
        some = Drive(*(x[:count] for x in drive))
        taken = least({"": (call, std, some)}, repeats=1)[""]
        told[name] = 1e6 * taken / (count * steps)
        told["batch"] = count
        count = max(1, min(len(drive.who), int(PATIENCE / taken)))
    return told


def table(drive: Drive) -> Numbers:
    """What each peer takes for filter and gradient, in float32 but for filterpy's NumPy.

    Args:
        drive: On the device; at most `BATCH` runs, and few steps, as the time of each is the same.
    """
    rows: Numbers = {"steps": drive.who.shape[1]}
    for name, find in PEERS.items():
        try:
            track = find()
            kinds = ("filter",) if track is filterpy_track else ("filter", "gradient")
            rows[name] = {kind: _figures(track, kind == "gradient", drive) for kind in kinds}
        except ImportError:
            rows[name] = None
        except Exception as error:  # a peer made for another version of JAX fails in many ways
            rows[name] = {"filter": None, "note": f"{type(error).__name__}: {error}"[:200]}
    return rows


def per_step(numbers: Numbers, kind: str) -> dict[str, float]:
    """Microseconds of `filter` or `gradient` in a batch: ours, in C, and of each peer that has it.

    The fastest comes first.
    """
    of = {"jaxslam": numbers[f"{kind}_us"], "C": numbers["c_us"] if kind == "filter" else None}
    for name, row in numbers["peers"].items():
        if isinstance(row, dict) and row.get(kind):
            of[name] = row[kind]["us_in_batch"]
    return dict(sorted(((k, us) for k, us in of.items() if us), key=lambda item: item[1]))
