"""Slow versions of the filter and of data association, plain enough to check by reading."""

import numpy as np

from jaxslam.core.types import WALL


def wrap(angle):
    """The same angle in (-pi, pi]."""
    return np.angle(np.exp(1j * angle))


def wrap_line(angle):
    """The same direction of a line in (-pi/2, pi/2]."""
    return np.angle(np.exp(2j * angle)) / 2


def compose(pose, motion):
    """The pose (3,) after a motion (3,) in its own frame."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    x, y, turn = motion
    return np.array([pose[0] + c * x - s * y, pose[1] + s * x + c * y, wrap(pose[2] + turn)])


def motion_jacobians(pose, motion):
    """Derivatives (3, 3) of `compose` by pose and by motion."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    x, y, _ = motion
    by_pose = np.array([[1, 0, -s * x - c * y], [0, 1, c * x - s * y], [0, 0, 1]])
    by_motion = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return by_pose, by_motion


def observe(state, index, kind):
    """The predicted measurement of landmark `index` of a state, and its dense Jacobian."""
    x, y, heading = state[:3]
    at = 3 + 2 * index
    h = np.zeros((1 if kind == WALL else 2, len(state)))
    if kind == WALL:
        h[0, 2], h[0, at] = -1, 1
        return np.array([wrap_line(state[at] - heading)]), h
    dx, dy = state[at] - x, state[at + 1] - y
    r = np.hypot(dx, dy)
    h[:, :3] = [[-dx / r, -dy / r, 0], [dy / r**2, -dx / r**2, -1]]
    h[:, at : at + 2] = [[dx / r, dy / r], [-dy / r**2, dx / r**2]]
    return np.array([r, wrap(np.arctan2(dy, dx) - heading)]), h


def difference(seen, expected, kind):
    """Innovation of a measurement, angles wrapped."""
    if kind == WALL:
        return wrap_line(seen - expected)
    return np.array([seen[0] - expected[0], wrap(seen[1] - expected[1])])


class DenseSlam:
    """EKF-SLAM with dense matrices and explicit inverses; landmarks in the order they came."""

    def __init__(self, pose):
        self.mean, self.cov = np.array(pose, float), np.zeros((3, 3))

    def predict(self, motion, q):
        by_pose, by_motion = motion_jacobians(self.mean[:3], motion)
        f, g = np.eye(len(self.mean)), np.zeros((len(self.mean), 3))
        f[:3, :3], g[:3] = by_pose, by_motion
        self.mean[:3] = compose(self.mean[:3], motion)
        self.cov = f @ self.cov @ f.T + g @ q @ g.T

    def update(self, measurements):
        """Update by (index, kind, measurement, covariance) of each measurement, all at once."""
        rows = [observe(self.mean, index, kind) for index, kind, _, _ in measurements]
        v = [
            difference(seen, expected, kind)
            for (_, kind, seen, _), (expected, _) in zip(measurements, rows, strict=True)
        ]
        h, v = np.vstack([h for _, h in rows]), np.concatenate(v)
        r, at = np.zeros((len(v), len(v))), 0
        for _, _, seen, noise in measurements:
            r[at : at + len(seen), at : at + len(seen)] = noise
            at += len(seen)
        s = h @ self.cov @ h.T + r
        gain = self.cov @ h.T @ np.linalg.inv(s)
        self.mean = self.mean + gain @ v
        self.mean[2] = wrap(self.mean[2])
        keep = np.eye(len(self.mean)) - gain @ h
        self.cov = keep @ self.cov @ keep.T + gain @ r @ gain.T
        return v @ np.linalg.solve(s, v), np.linalg.slogdet(s)[1]

    def augment(self, kind, seen, noise):
        """Append the landmark that an observation with a covariance implies."""
        x, y, heading = self.mean[:3]
        by_state, by_seen = np.zeros((2, len(self.mean))), np.zeros((2, len(seen)))
        if kind == WALL:
            new = np.array([wrap_line(seen[0] + heading), 0.0])
            by_state[0, 2], by_seen[0, 0] = 1, 1
        else:
            c, s = np.cos(seen[1] + heading), np.sin(seen[1] + heading)
            new = np.array([x + seen[0] * c, y + seen[0] * s])
            by_state[:, :3] = [[1, 0, -seen[0] * s], [0, 1, seen[0] * c]]
            by_seen[:] = [[c, -seen[0] * s], [s, seen[0] * c]]
        cross = by_state @ self.cov
        own = cross @ by_state.T + by_seen @ noise @ by_seen.T
        self.cov = np.block([[self.cov, cross.T], [cross, own]])
        self.mean = np.concatenate([self.mean, new])


def kalman(mean, cov, f, q, control, h, r, seen):
    """One step of the textbook Kalman filter: predict by F and a control, update by H."""
    mean, cov = f @ mean + control, f @ cov @ f.T + q
    gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + r)
    return mean + gain @ (seen - h @ mean), (np.eye(len(mean)) - gain @ h) @ cov


def match(distance, possible, gate, margin):
    """Pairs that are nearest to each other, in the gate, and clearly so for the feature."""
    m, size = distance.shape
    d = np.full((m, size), np.inf)
    for i in range(m):
        for j in range(size):
            if possible[i, j] and np.isfinite(distance[i, j]):
                d[i, j] = distance[i, j]
    result = []
    for i in range(m):
        candidates = [
            j
            for j in range(size)
            if d[i, j] < gate
            and all(d[i, j] < d[k, j] for k in range(m) if k != i)
            and all(d[i, j] + margin < d[i, k] for k in range(size) if k != j)
        ]
        result.append(candidates[0] if candidates else size)
    return np.array(result)
