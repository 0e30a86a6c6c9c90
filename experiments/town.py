"""A town of corridors: a grid of streets with corners on both sides, and a drive along all of them.

There are no walls and no scans: the features of a scan are the nearest corners within range, with
draws of the noise that the filter assumes, so that its model is exactly true. Corners behind others
are seen, too.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

from jaxslam.core import se2_np
from jaxslam.core.batching import on_device
from jaxslam.core.features import Features
from jaxslam.core.measurement import Measurement
from jaxslam.core.types import CORNER
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams, measurement_cov, motion_estimate

BLOCK = 15.0  # [m] from street to street
HALF_WIDTH = 1.5  # [m] of a street
STEP = 0.25  # [m] between scans
RADIUS = 1.25  # [m] of the robot's turns
MAX_SEEN, RANGE_MAX, RANGE_MIN = 8, 5.0, 0.4  # corners in a scan, and their range [m]
GAPS = (0.8, 1.8)  # [m] between corners of one side of a street
DIRECTION_STD = 0.02  # [rad] of the measured direction and angle of a corner
OWN_STD = 0.01  # [m] of a corner's position in a scan


class Town(NamedTuple):
    """Corners of a town, and a drive of T scans.

    Attributes:
        corners: (L, 2) [m].
        directions: (L,) [rad] of their free sides.
        angles: (L,) [rad] of their free sides.
        truth: (T, 3) true poses.
        measurements: [T] of the filter; the first increment is zero.
        corner: (T, M) index of the corner of each feature, -1 for none.
    """

    corners: np.ndarray
    directions: np.ndarray
    angles: np.ndarray
    truth: np.ndarray
    measurements: Measurement
    corner: np.ndarray


def params() -> NoiseParams:
    """The noise that the drive is simulated with, and that the filter assumes."""
    return NoiseParams(
        odometry_coefficients=jnp.array([0.02, 0.01, 0.02, 0.02]),
        range_std=jnp.array(0.01),
        bearing_std=jnp.array(0.005),
        feature_std_scale=jnp.array(1.0),
        wall_angle_std=jnp.array(0.002),
    )


def config(max_landmarks: int) -> FilterConfig:
    """The filter of this sensor, with a capacity of `max_landmarks`."""
    return FilterConfig(landmark_kinds=(CORNER,), max_landmarks=max_landmarks, max_updates=MAX_SEEN)


def corners_of(blocks: int, rng: np.random.Generator) -> np.ndarray:
    """Corners (L, 2) [m] on both sides of all streets of a town of `blocks` squared blocks."""
    found = []
    for along in range(blocks + 1):
        for part in range(blocks):
            for side in (-HALF_WIDTH, HALF_WIDTH):
                for turned in (False, True):
                    gaps = rng.uniform(*GAPS, size=int(BLOCK / GAPS[0]))
                    at = HALF_WIDTH + np.cumsum(np.append(0.0, gaps))
                    at = at[at <= BLOCK - HALF_WIDTH - GAPS[0] / 2] + part * BLOCK
                    across = np.full_like(at, along * BLOCK + side)
                    xy = np.stack([at, across], axis=1)
                    # The corner of a block is one, not one of each street.
                    found.append(xy[1:, ::-1] if turned else xy)
    return np.concatenate(found)


def walk(blocks: int, length: float, rng: np.random.Generator) -> np.ndarray:
    """Crossings (K, 2) int of a drive: at each the street that was driven least, never back."""
    times: dict[tuple, int] = {}
    at, before, path = (0, 0), (-1, 0), [(0, 0)]
    while len(path) * BLOCK < length + 2 * BLOCK:
        options = []
        for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1)):
            to = (at[0] + dx, at[1] + dy)
            if to != before and 0 <= min(to) and max(to) <= blocks:
                street = (min(at, to), max(at, to))
                options.append((times.get(street, 0), rng.random(), to, street))
        _, _, to, street = min(options)
        times[street] = times.get(street, 0) + 1
        before, at = at, to
        path.append(to)
    return np.array(path)


def trajectory(crossings: np.ndarray, num_scans: int) -> np.ndarray:
    """Poses (T, 3) along the streets, every `STEP` metres, with arcs at the crossings."""
    nodes = crossings * BLOCK
    heading = np.arctan2(*np.diff(nodes, axis=0).T[::-1])
    pose, parts = np.append(nodes[0], heading[0]), []
    parts.append(pose[None])
    on_arc = round(RADIUS * np.pi / 2 / STEP)
    for leg in range(len(heading)):
        turn = se2_np.wrap_angle(np.diff(heading[leg : leg + 2]))
        turns = len(turn) and abs(turn[0]) > 0.1
        end = nodes[leg + 1]
        if turns:
            end = end - RADIUS * np.array([np.cos(heading[leg]), np.sin(heading[leg])])
        gap = end - pose[:2]
        count = max(1, round(np.hypot(*gap) / STEP))
        fraction = np.arange(1, count + 1)[:, None] / count
        parts.append(np.column_stack([pose[:2] + fraction * gap, np.full(count, heading[leg])]))
        pose = parts[-1][-1]
        if turns:
            angle = turn[0] * np.arange(1, on_arc + 1) / on_arc
            sign = np.sign(turn[0])
            arc = RADIUS * np.stack([np.sin(np.abs(angle)), sign * (1 - np.cos(angle))], axis=1)
            xy = se2_np.transform(pose, arc)
            parts.append(np.column_stack([xy, se2_np.wrap_angle(pose[2] + angle)]))
            pose = parts[-1][-1]
    return np.concatenate(parts)[:num_scans]


@jax.jit
def _noise_of(
    noise: NoiseParams, odometry: jnp.ndarray, features: Features
) -> tuple[jnp.ndarray, jnp.ndarray]:
    """Q (T, 3, 3) and R (T, M, 2, 2) of exact measurements."""

    def of_scan(odometry: jnp.ndarray, features: Features) -> tuple[jnp.ndarray, jnp.ndarray]:
        measurement = Measurement(odometry, features)
        q = motion_estimate(noise, measurement)[1]
        return q, measurement_cov(noise, features, measurement)

    return jax.vmap(of_scan)(odometry, features)


def _drawn(cov: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A draw (..., n) of each Gaussian of covariance (..., n, n), which may be semi-definite."""
    value, vector = np.linalg.eigh(np.asarray(cov, float))
    root = vector * np.sqrt(np.maximum(value, 0.0))[..., None, :]
    return np.einsum("...ij,...j->...i", root, rng.normal(size=cov.shape[:-1]))


def make(blocks: int, num_scans: int, seed: int) -> Town:
    """A town of `blocks` squared blocks, and a drive of `num_scans` scans in it."""
    rng = np.random.default_rng(seed)
    corners = corners_of(blocks, rng)
    directions = rng.integers(4, size=len(corners)) * np.pi / 2 - 3 * np.pi / 4
    angles = np.where(rng.random(len(corners)) < 0.5, np.pi / 2, 3 * np.pi / 2)
    truth = trajectory(walk(blocks, 1.1 * num_scans * STEP, rng), num_scans)
    distance, index = cKDTree(corners).query(
        truth[:, :2], k=MAX_SEEN, distance_upper_bound=RANGE_MAX
    )
    valid = (distance > RANGE_MIN) & np.isfinite(distance)
    index = np.where(valid, index, 0)
    exact = se2_np.inverse_transform(truth[:, None], corners[index])
    odometry = se2_np.increments(truth)
    heading = se2_np.wrap_angle(directions[index] - truth[:, None, 2])
    shape = valid.shape

    def features(xy: np.ndarray, direction: np.ndarray, angle: np.ndarray) -> Features:
        cov = OWN_STD**2 * np.broadcast_to(np.eye(2), (*shape, 2, 2))
        fields = Features(
            kind=np.full(shape, CORNER, np.int32),
            xy=np.where(valid[..., None], xy, 0.0),
            cov=np.where(valid[..., None, None], cov, 0.0),
            direction=np.where(valid, direction, 0.0),
            direction_variance=np.zeros(shape),
            descriptor=np.where(valid, angle, 0.0),
            degree=np.zeros(shape, np.int32),
            certified=valid,
            trusted=valid,
            valid=valid,
        )
        return jax.tree.map(lambda x: x if x.dtype.kind != "f" else x.astype(np.float32), fields)

    noise_free = features(exact, heading, angles[index])
    q, r = _noise_of(params(), jnp.asarray(odometry, float), on_device(noise_free))
    polar = np.stack(
        [np.hypot(*np.moveaxis(exact, -1, 0)), np.arctan2(exact[..., 1], exact[..., 0])], -1
    )
    polar = polar + np.where(valid[..., None], _drawn(np.asarray(r), rng), 0.0)
    xy = polar[..., :1] * np.stack([np.cos(polar[..., 1]), np.sin(polar[..., 1])], axis=-1)
    heading = se2_np.wrap_angle(heading + DIRECTION_STD * rng.normal(size=shape))
    angle = angles[index] + DIRECTION_STD * rng.normal(size=shape)
    measured = (odometry + _drawn(np.asarray(q), rng)).astype(np.float32)
    measurements = Measurement(measured, features(xy, heading, angle))
    corner = np.where(valid, index, -1)
    return Town(corners, directions, angles, truth, measurements, corner)
