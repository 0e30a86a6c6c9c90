"""Other libraries' extended Kalman filters on `workload.rings`, as their users would set them up.

Their state is the same, pose and landmarks; a missing measurement has a zero row. dynamax and
cuthbert derive their Jacobians, filterpy is given them. Where they take the odometry's noise in the
world frame it is the same noise, as it is isotropic in the plane.
"""

from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.common import Numbers
from experiments.timing import fastest
from experiments.workload import Drive, wrap
from jaxslam.core.se2 import compose, wrap_angle
from jaxslam.core.types import Array

STD = (0.02, 0.02, 0.01, 0.10, 0.03)  # of `workload.rings`: odometry x, y, heading; range, bearing
POSE_STD = 1e-4  # of the first pose [m, rad]; factors of a covariance have no derivative at zero
BATCH = 64  # trials together
TIME_LIMIT = 2.0  # [s] for a call of a peer; it has fewer trials where that is not enough
Positions = Callable[[Array, Drive], Array]
"""Function of noise (5,) and a trial that returns the estimated positions (T, 2)."""


def loss(positions: Positions, std: Array, trial: Drive) -> Array:
    """Mean squared position error of a trial."""
    return jnp.mean(jnp.sum((positions(std, trial) - trial.truth[:, :2]) ** 2, axis=-1))


def _predict(x: Array, odometry: Array) -> Array:
    return jnp.concatenate([compose(x[:3], odometry), x[3:]])


def _predict_measurement(x: Array, range_bearing: Array, ids: Array) -> Array:
    """Predicted measurement (2 M,), bearings within pi of those in `range_bearing` (M, 2)."""
    offset = x[3:].reshape(-1, 2)[jnp.maximum(ids, 0)] - x[None, :2]
    distance = jnp.sqrt(jnp.sum(offset**2, axis=1))
    bearing = jnp.arctan2(offset[:, 1], offset[:, 0]) - x[2]
    bearing = range_bearing[:, 1] + wrap_angle(bearing - range_bearing[:, 1])
    return jnp.where((ids >= 0)[:, None], jnp.stack([distance, bearing], -1), 0.0).reshape(-1)


def _prior(trial: Drive) -> tuple[Array, Array]:
    """First mean (D,) and standard deviations (D,)."""
    mean = jnp.concatenate([jnp.zeros(3, trial.prior.dtype), trial.prior.reshape(-1)])
    std = jnp.sqrt(jnp.diagonal(trial.prior_cov, axis1=1, axis2=2)).reshape(-1)
    return mean, jnp.concatenate([jnp.full(3, POSE_STD, std.dtype), std])


def _noise(std: Array, trial: Drive) -> tuple[Array, Array]:
    """Standard deviations of the state's noise (D,) and of the measurement's (2 M,)."""
    still = jnp.zeros(trial.prior.size, std.dtype)
    return jnp.concatenate([std[:3], still]), jnp.tile(std[3:], trial.landmark_ids.shape[1])


def _measurements(trial: Drive) -> Array:
    """Measurements (T, 2 M), zero where there is none."""
    valid = trial.landmark_ids[..., None] >= 0
    return jnp.where(valid, trial.range_bearing, 0.0).reshape(len(valid), -1)


def _dynamax() -> Positions:
    models = import_module("dynamax.nonlinear_gaussian_ssm")

    def dynamics(x: Array, u: Array) -> Array:
        return _predict(x, u[:3])

    def emission(x: Array, u: Array) -> Array:
        columns = u[3:].reshape(-1, 3)
        return _predict_measurement(x, columns[:, :2], columns[:, 2].astype(jnp.int32))

    def positions(std: Array, trial: Drive) -> Array:
        mean, prior_std = _prior(trial)
        state_std, measurement_std = _noise(std, trial)
        # Its prior is that of the first observation, so the first increment comes before it.
        F = jax.jacfwd(dynamics)(mean, trial.odometry[0])
        model = models.ParamsNLGSSM(
            initial_mean=dynamics(mean, trial.odometry[0]),
            initial_covariance=F @ jnp.diag(prior_std**2) @ F.T + jnp.diag(state_std**2),
            # The increment that leads to a step is part of the input of that step.
            dynamics_function=dynamics,
            dynamics_covariance=jnp.diag(state_std**2),
            emission_function=emission,
            emission_covariance=jnp.diag(measurement_std**2),
        )
        ids = trial.landmark_ids[..., None].astype(std.dtype)
        columns = jnp.concatenate([trial.range_bearing, ids], axis=-1)
        inputs = jnp.concatenate([trial.odometry, columns.reshape(len(columns), -1)], axis=1)
        result = models.extended_kalman_filter(
            model, _measurements(trial), inputs, output_fields=["filtered_means"]
        )
        return result.filtered_means[:, :2]

    return positions


def _cuthbert() -> Positions:
    cuthbert, moments = import_module("cuthbert"), import_module("cuthbert.gaussian.moments")

    def positions(std: Array, trial: Drive) -> Array:
        mean, prior_std = _prior(trial)
        state_std, measurement_std = (jnp.diag(x) for x in _noise(std, trial))
        own = moments.build_filter(
            mean,
            jnp.diag(prior_std),
            lambda state, now: (lambda x: (_predict(x, now[0]), state_std), state.mean),
            lambda state, now: (
                lambda x: (_predict_measurement(x, *now[1:3]), measurement_std),
                state.mean,
                now[3],
            ),
        )
        inputs = trial.odometry, trial.range_bearing, trial.landmark_ids, _measurements(trial)
        return cuthbert.filter(own, inputs, own.init_prepare()).mean[1:, :2]

    return positions


def filterpy_positions(std: np.ndarray, trial: Drive, pose_std: float = 0.0) -> np.ndarray:
    """Positions (T, 2) of one trial by filterpy, in float64.

    Args:
        std: (5,) noise.
        trial: NumPy arrays; every landmark has a prior.
        pose_std: Of the first pose.

    Raises:
        ImportError: filterpy is not installed.
    """
    size = 3 + trial.prior.size
    ekf = import_module("filterpy.kalman").ExtendedKalmanFilter(dim_x=size, dim_z=2)
    ekf.x = np.concatenate([np.zeros(3), trial.prior.ravel()])
    ekf.P = np.diag(np.concatenate([np.full(3, pose_std**2), np.zeros(trial.prior.size)]))
    for k, cov in enumerate(trial.prior_cov):
        ekf.P[3 + 2 * k : 5 + 2 * k, 3 + 2 * k : 5 + 2 * k] = cov
    ekf.F, ekf.Q = np.eye(size), np.zeros((size, size))

    def predict(odometry: np.ndarray) -> None:
        c, s = np.cos(ekf.x[2]), np.sin(ekf.x[2])
        rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        step = rotation @ odometry
        ekf.F[:2, 2] = -step[1], step[0]
        ekf.Q[:3, :3] = rotation @ np.diag(std[:3] ** 2) @ rotation.T
        ekf.x = np.concatenate([ekf.x[:3] + step, ekf.x[3:]])

    # Its own prediction of the mean is linear; this one replaces it.
    ekf.predict_x = predict

    def measure(x: np.ndarray, ids: np.ndarray) -> np.ndarray:
        dx, dy = (x[3:].reshape(-1, 2)[ids] - x[:2]).T
        return np.stack([np.hypot(dx, dy), np.arctan2(dy, dx) - x[2]], axis=-1).ravel()

    def jacobian(x: np.ndarray, ids: np.ndarray) -> np.ndarray:
        H, row = np.zeros((len(ids), 2, size)), np.arange(len(ids))
        dx, dy = (x[3:].reshape(-1, 2)[ids] - x[:2]).T
        r = np.hypot(dx, dy)
        H_landmark = np.array([[dx / r, dy / r], [-dy / r**2, dx / r**2]]).transpose(2, 0, 1)
        H[:, :, :2], H[:, 1, 2] = -H_landmark, -1.0
        for axis in range(2):
            H[row, :, 3 + 2 * ids + axis] = H_landmark[:, :, axis]
        return H.reshape(-1, size)

    def residual(measured: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        difference = (measured - predicted).reshape(-1, 2)
        return np.stack([difference[:, 0], wrap(difference[:, 1])], axis=-1).ravel()

    track = []
    steps = zip(trial.odometry, trial.range_bearing, trial.landmark_ids, strict=True)
    for odometry, range_bearing, ids in steps:
        ekf.predict(odometry)
        valid = ids >= 0
        if valid.any():
            R = np.kron(np.eye(valid.sum()), np.diag(std[3:] ** 2))
            own = (ids[valid],)
            ekf.update(range_bearing[valid].ravel(), jacobian, measure, R, own, own, residual)
        track.append(ekf.x[:2])
    return np.array(track)


def _filterpy() -> Positions:
    import_module("filterpy.kalman")
    return filterpy_positions


PEERS = {"dynamax": _dynamax, "cuthbert": _cuthbert, "filterpy": _filterpy}


def _batched(positions: Positions, gradient: bool) -> Callable[[Array, Drive], Any]:
    """What users of a peer would write for a batch."""
    if positions is filterpy_positions:
        return lambda std, drive: [
            positions(std, Drive(*(x[k] for x in drive))) for k in range(len(drive.landmark_ids))
        ]
    single = jax.value_and_grad(partial(loss, positions)) if gradient else positions
    return jax.jit(jax.vmap(single, in_axes=(None, 0)))


def _figures(positions: Positions, gradient: bool, drive: Drive) -> Numbers:
    """Microseconds for a step of a trial, alone and in a batch that fits the time limit."""
    std = jnp.asarray(STD, drive.odometry.dtype)
    if positions is filterpy_positions:
        std, drive = jax.tree.map(lambda x: np.asarray(x, float), (std, drive))
        drive = drive._replace(landmark_ids=drive.landmark_ids.astype(int))
    call, steps, found = _batched(positions, gradient), drive.landmark_ids.shape[1], {}
    count = 1
    for name in ("us_1_run", "us_in_batch"):
        batch = Drive(*(x[:count] for x in drive))
        taken = fastest({"": (call, std, batch)}, repeats=1)[""]
        found[name] = 1e6 * taken / (count * steps)
        found["batch"] = count
        count = max(1, min(len(drive.landmark_ids), int(TIME_LIMIT / taken)))
    return found


def table(drive: Drive) -> Numbers:
    """Time of filter and gradient of each peer, in float32 except filterpy, which is NumPy.

    Args:
        drive: On the device; at most `BATCH` trials, and few steps, as each takes the same time.
    """
    rows: Numbers = {"steps": drive.landmark_ids.shape[1]}
    for name, find in PEERS.items():
        try:
            positions = find()
            kinds = ("filter",) if positions is filterpy_positions else ("filter", "gradient")
            rows[name] = {kind: _figures(positions, kind == "gradient", drive) for kind in kinds}
        except ImportError:
            rows[name] = None
        except Exception as error:  # a peer made for another version of JAX can fail with any error
            rows[name] = {"filter": None, "note": f"{type(error).__name__}: {error}"[:200]}
    return rows


def per_step(numbers: Numbers, kind: str) -> dict[str, float]:
    """Microseconds of `filter` or `gradient` in a batch: jaxslam, C, and each peer that has it.

    The fastest comes first.
    """
    found = {"jaxslam": numbers[f"{kind}_us"], "C": numbers["c_us"] if kind == "filter" else None}
    for name, row in numbers["peers"].items():
        if isinstance(row, dict) and row.get(kind):
            found[name] = row[kind]["us_in_batch"]
    return dict(sorted(((k, us) for k, us in found.items() if us), key=lambda item: item[1]))
