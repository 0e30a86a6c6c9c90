"""A small batch problem of all kinds of landmarks, and its residuals written out in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import reference_filter

from jaxslam.core.types import CORNER, JUNCTION, WALL
from jaxslam.smoothing.problem import LandmarkPrior, SmoothingProblem

T, M = 12, 5
KINDS = np.array([JUNCTION, WALL, CORNER, JUNCTION, WALL, CORNER])
POSITIONS = np.array([[4.0, 1.0], [0.3, 0.0], [-2.0, 3.0], [1.0, -4.0], [-1.57, 0.0], [6.0, 5.0]])
L = len(KINDS)
START = np.array([0.5, -0.3, 2.9])  # the heading passes pi
POINT_COV, WALL_COV = np.array([[0.01, 0.001], [0.001, 4e-4]]), np.diag([1e-4, 1.0])


def drive(seed):
    """The problem of a robot that turns to the left, stands still, turns about; and a guess."""
    rng = np.random.default_rng(seed)
    root = 0.05 * rng.normal(size=(T, 3, 3))
    q = root @ root.swapaxes(1, 2) + 1e-3 * np.eye(3)
    odometry = np.tile([0.4, 0.05, 0.2], (T, 1))
    odometry[4], q[4], odometry[7] = 0.0, 1e-8 * np.eye(3), [0.1, 0.0, np.pi - 1e-4]
    index = np.stack([rng.permutation(L)[:M] for _ in range(T)]).astype(np.int32)
    index[rng.random((T, M)) < 0.2] = -1
    pose, poses, state = START, [], np.concatenate([START, POSITIONS.ravel()])
    measured = np.zeros((T, M, 2))
    for t in range(T):
        pose = reference_filter.compose(pose, rng.multivariate_normal(odometry[t], q[t]))
        poses.append(pose)
        state[:3] = pose
        for m in np.flatnonzero(index[t] >= 0):
            kind = KINDS[index[t, m]]
            r = WALL_COV[:1, :1] if kind == WALL else POINT_COV
            z, _ = reference_filter.observe(state, index[t, m], kind)
            measured[t, m, : len(z)] = z + rng.multivariate_normal(np.zeros(len(z)), r)
    kind = KINDS[index].astype(np.int32)
    r = np.where((kind == WALL)[..., None, None], WALL_COV, POINT_COV)
    rough = POSITIONS + rng.normal(size=(L, 2)) * np.where(KINDS == WALL, 0.1, 0.4)[:, None]
    information = np.zeros((L, 2, 2))
    information[0], information[4, 0, 0] = [[30.0, 5.0], [5.0, 20.0]], 900.0
    mean = POSITIONS - 0.05
    mean[4, 0] += np.pi  # the same line
    prior = LandmarkPrior(mean, information)
    problem = SmoothingProblem(START, odometry, q, measured, r, kind, index, prior)
    rough[KINDS == WALL, 1] = 0.0
    poses = np.stack(poses) + rng.normal(size=(T, 3)) * 0.1
    poses[5, 2] += 2 * np.pi
    return jax.tree.map(jnp.asarray, (problem, poses, rough))


def residuals(problem, poses, positions):
    """All whitened residuals, one loop for each kind of measurement."""
    start, odometry, q, measured, r, kind, index, prior = jax.tree.map(np.asarray, problem)
    white, before = [], start
    for t, pose in enumerate(poses):
        c, s = np.cos(before[2]), np.sin(before[2])
        x, y = (pose - before)[:2]
        error = np.array([c * x + s * y, c * y - s * x, pose[2] - before[2]]) - odometry[t]
        error[2] = reference_filter.wrap(error[2])
        white.append(np.linalg.solve(np.linalg.cholesky(q[t]), error))
        state = np.concatenate([pose, positions.ravel()])
        for m in np.flatnonzero(index[t] >= 0):
            expected, _ = reference_filter.observe(state, index[t, m], kind[t, m])
            n = len(expected)
            error = reference_filter.difference(measured[t, m, :n], expected, kind[t, m])
            white.append(np.linalg.solve(np.linalg.cholesky(r[t, m, :n, :n]), error))
        before = pose
    errors = positions - prior.positions
    errors[KINDS == WALL, 0] = reference_filter.wrap_line(errors[KINDS == WALL, 0])
    for error, information in zip(errors, prior.information, strict=True):
        values, vectors = np.linalg.eigh(information)
        white.append(np.sqrt(np.maximum(values, 0.0)) * (vectors.T @ error))
    return np.concatenate(white)


def unpack(x):
    """Poses and landmark positions of SciPy's unknowns (3 T + 10,)."""
    positions = np.zeros((L, 2))
    positions[KINDS != WALL] = x[3 * T : 3 * T + 8].reshape(4, 2)
    positions[KINDS == WALL, 0] = x[3 * T + 8 :]
    return x[: 3 * T].reshape(T, 3), positions


def pack(poses, positions):
    """The inverse of `unpack`."""
    walls = KINDS == WALL
    return np.concatenate([np.ravel(poses), np.ravel(positions[~walls]), positions[walls, 0]])


def assert_same(found, expected, atol):
    """Compare two results; headings, and directions of walls, up to whole turns."""

    def turn(angle):
        return np.exp(1j * np.asarray(angle))

    walls, (poses, positions) = KINDS == WALL, expected[:2]
    np.testing.assert_allclose(found.poses[:, :2], poses[:, :2], atol=atol)
    np.testing.assert_allclose(turn(found.poses[:, 2]), turn(poses[:, 2]), atol=atol)
    points = found.landmark_positions[~walls], positions[~walls]
    np.testing.assert_allclose(*points, atol=atol)
    directions = turn(2 * found.landmark_positions[walls, 0]), turn(2 * positions[walls, 0])
    np.testing.assert_allclose(*directions, atol=atol)
