"""Simulated drives through offices and random floor plans, and trajectories with one thing wrong.

A drive visits random places on the shortest paths between them, with one of several scanners.
Furniture is moved in mid-drive, in half of the drives people walk about, and in some there is
glass. In NumPy alone.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from scipy import sparse

from experiments import ground_truth
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import compose, dead_reckoning, increments, relative, wrap_angle
from jaxslam.evaluation.trajectory import align_trajectory
from jaxslam.simulation import floor_plans, worlds

CELL = 0.15  # [m] of the grid on which paths are found
CLEARANCE = 0.35  # [m] of the robot from the walls
LIDARS = (
    Lidar(num_beams=181, angle_min=-np.pi / 2, angle_increment=np.pi / 180, range_max=8.0),
    Lidar(num_beams=361, angle_min=-np.pi / 2, angle_increment=np.pi / 360, range_max=80.0),
    Lidar(num_beams=360, angle_min=-np.pi, angle_increment=np.pi / 180, range_max=12.0),
    Lidar(num_beams=271, angle_min=-0.75 * np.pi, angle_increment=np.pi / 180, range_max=30.0),
)
STEPS = (0.25, 0.7)  # [m] between scans: all of them, or keyframes
REVERSALS = 3  # places where a robot that reverses backs up
CARRIED_SCANS = 39  # left out while the robot is carried


class Drive(NamedTuple):
    """A drive of T scans whose trajectory is known.

    Attributes:
        lidar: The scanner.
        scans: [T].
        poses: (T, 3) [m, m, rad] the true ones.
    """

    lidar: Lidar
    scans: Scan
    poses: np.ndarray


def simulate(seed: int, *, reversing: bool = False) -> Drive:
    """A drive in the office, or in a random floor plan.

    Args:
        seed: Of all that is random.
        reversing: Whether the robot drives backwards on a fifth of its path.
    """
    rng = np.random.default_rng([seed, 1])
    if rng.random() < 0.3:
        walls = worlds.office()
    else:
        size = rng.choice([(13.0, 10.0), (18.0, 7.0), (11.0, 11.0)])
        walls = np.asarray(floor_plans.floor_plan(jax.random.key(seed), size=tuple(size)).walls)
    walls = ground_truth.without_padding(walls)
    poses = _drive_along(_route(rng, walls), rng.choice(STEPS, p=[0.7, 0.3]))
    if reversing:
        poses = with_reversing(rng, poses)
    lidar = LIDARS[rng.integers(len(LIDARS))]
    glass = rng.random(len(walls)) < rng.choice([0.0, 0.1], p=[0.7, 0.3])
    halves = [
        _ranges(rng, lidar, part, np.vstack([walls[~glass], *_boxes(rng, poses)]), walls[glass])
        for part in np.array_split(poses, 2)
    ]
    ranges = np.concatenate(halves)
    if rng.random() < 0.5:
        ranges = with_people(rng, lidar, ranges)
    ranges = ranges + rng.normal(0.0, 0.01, ranges.shape)
    hit = (ranges > 0.05) & (ranges < lidar.range_max)
    return Drive(lidar, Scan(np.where(hit, ranges, lidar.range_max), hit), poses)


def _route(rng: np.random.Generator, walls: np.ndarray) -> np.ndarray:
    """Points (N, 2) [m] of a path that visits random places."""
    low, high = walls.reshape(-1, 2).min(axis=0), walls.reshape(-1, 2).max(axis=0)
    axes = [np.arange(a, b, CELL) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    flat = points.reshape(-1, 2)
    distance = ground_truth.clearance(flat, walls).reshape(points.shape[:2])
    distance *= ground_truth.FreeSpace(walls).contains(flat).reshape(distance.shape)
    index = np.arange(distance.size).reshape(distance.shape)
    starts, ends, costs = [], [], []
    for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = (slice(0, -di or None), slice(max(0, -dj), -dj if dj > 0 else None))
        b = (slice(di, None), slice(max(0, dj), dj if dj < 0 else None))
        room = np.minimum(distance[a], distance[b])
        open_ = room > CLEARANCE
        starts.append(index[a][open_])
        ends.append(index[b][open_])
        costs.append(np.hypot(di, dj) * (1.0 + 0.2 / room[open_]))
    graph = sparse.coo_matrix(
        (np.concatenate(costs), (np.concatenate(starts), np.concatenate(ends))),
        shape=(distance.size, distance.size),
    ).tocsr()
    _, labels = sparse.csgraph.connected_components(graph, directed=False)
    largest = np.flatnonzero(labels == np.argmax(np.bincount(labels)))
    goals = rng.choice(largest, rng.integers(6, 12), replace=False)
    _, before = sparse.csgraph.dijkstra(
        graph, directed=False, indices=goals[1:], return_predecessors=True
    )
    path = [goals[0]]
    for goal, previous in zip(goals[1:], before, strict=True):
        while path[-1] != goal:
            path.append(previous[path[-1]])
    return flat[path]


def _drive_along(path: np.ndarray, step: float) -> np.ndarray:
    """Poses (T, 3) on a smoothed path (N, 2), `step` [m] and at most 0.4 rad apart."""
    kernel = np.ones(5) / 5
    smooth = np.stack([np.convolve(np.pad(x, 2, "edge"), kernel, "valid") for x in path.T], axis=1)
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(smooth, axis=0).T)))
    kept = np.append(True, np.diff(along) > 1e-9)
    wanted = np.arange(0.0, along[-1], step)
    at = np.stack([np.interp(wanted, along[kept], x[kept]) for x in smooth.T], axis=1)
    moves = np.diff(at, axis=0)
    heading = np.arctan2(moves[:, 1], moves[:, 0])
    poses = [(*at[0], heading[0])]
    for (x, y), course in zip(at[1:-1], heading[1:], strict=True):
        turn = wrap_angle(course - poses[-1][2])
        count = max(1, int(np.ceil(abs(turn) / 0.4)))
        start = poses[-1][2]
        poses += [(x, y, start + turn * k / count) for k in range(1, count + 1)]
    return np.array(poses)


def with_reversing(rng: np.random.Generator, poses: np.ndarray) -> np.ndarray:
    """Poses (T, 3) with `REVERSALS` places from where the robot backs up and drives on again.

    Of the new path, a fifth is driven backwards: with n steps there were, and n / 3 backwards and
    n / 3 forwards again, n / 3 of 5 n / 3.
    """
    back = max(1, round((len(poses) - 1) / 3 / REVERSALS))
    turning = np.sort(rng.choice(np.arange(back, len(poses)), REVERSALS, replace=False))
    parts, start = [], 0
    for k in turning.tolist():
        parts += [np.arange(start, k + 1), np.arange(k - 1, k - back, -1)]
        start = k - back
    return poses[np.concatenate([*parts, np.arange(start, len(poses))])]


def _ranges(
    rng: np.random.Generator, lidar: Lidar, poses: np.ndarray, walls: np.ndarray, glass: np.ndarray
) -> np.ndarray:
    """Ranges (T, R) [m] of noise-free scans; inf where there is no wall.

    Args:
        rng: Decides for each beam whether it passes glass.
        lidar: The scanner.
        poses: (T, 3) [m, m, rad].
        walls: (S, 4) [m].
        glass: (G, 4) [m] walls that half of the beams pass.
    """
    angles = lidar.angle_min + lidar.angle_increment * np.arange(lidar.num_beams)

    def ranges_to(walls: np.ndarray) -> np.ndarray:
        ends = np.stack([ground_truth.hits(p[:2], p[2] + angles, walls) for p in poses])
        return np.hypot(*np.moveaxis(ends - poses[:, None, :2], -1, 0))

    through = ranges_to(walls)
    if not len(glass):
        return through
    passes = rng.random(through.shape) < 0.5
    return np.where(passes, through, ranges_to(np.vstack([walls, glass])))


def _boxes(rng: np.random.Generator, poses: np.ndarray) -> list[np.ndarray]:
    """Up to four boxes of furniture beside a trajectory, none on it or near its middle."""
    boxes, middle = [], poses[len(poses) // 2, :2]
    for _ in range(rng.integers(5)):
        centre = poses[rng.integers(len(poses)), :2] + rng.uniform(-1.5, 1.5, 2)
        clear = np.hypot(*(poses[:, :2] - centre).T).min() > 0.6
        if clear and np.hypot(*(middle - centre)) > 5.0:
            boxes.append(worlds.outline([(*(centre - 0.25), *(centre + 0.25))]))
    return boxes


def with_people(rng: np.random.Generator, lidar: Lidar, ranges: np.ndarray) -> np.ndarray:
    """Ranges (T, R) [m] with three people of radius 0.25 m, within 4 m of the robot."""
    angles = lidar.angle_min + lidar.angle_increment * np.arange(lidar.num_beams)
    people, ranges = rng.uniform(-3.0, 3.0, (3, 2)), ranges.copy()
    for scan in ranges:
        people = np.clip(people + rng.normal(0.0, 0.15, people.shape), -4.0, 4.0)
        for x, y in people:
            distance, off = np.hypot(x, y), wrap_angle(angles - np.arctan2(y, x))
            if distance > 0.5:
                across = 0.25**2 - (distance * np.sin(off)) ** 2
                met = (across > 0.0) & (np.abs(off) < np.pi / 2)
                near = distance * np.cos(off) - np.sqrt(np.maximum(across, 0.0))
                scan[met] = np.minimum(scan[met], near[met])
    return ranges


class Damaged(NamedTuple):
    """A trajectory with something wrong.

    Attributes:
        kept: (N,) int numbers of the scans that there are.
        poses: (N, 3) [m, m, rad] the wrong trajectory.
    """

    kept: np.ndarray
    poses: np.ndarray


Damage = Callable[[np.random.Generator, np.ndarray], Damaged]


def _somewhere(rng: np.random.Generator, poses: np.ndarray) -> int:
    """Number of a scan in the middle three fifths of a trajectory."""
    return int(rng.integers(len(poses) // 5, len(poses) - len(poses) // 5))


def _rebuilt(poses: np.ndarray, steps: np.ndarray) -> Damaged:
    return Damaged(np.arange(len(poses)), dead_reckoning(poses[0], steps))


def heading(rng: np.random.Generator, poses: np.ndarray) -> Damaged:
    """The heading jumps by 0.2 to 1 rad."""
    steps = increments(poses)
    steps[_somewhere(rng, poses), 2] += rng.choice([-1, 1]) * rng.uniform(0.2, 1.0)
    return _rebuilt(poses, steps)


def leap(rng: np.random.Generator, poses: np.ndarray) -> Damaged:
    """The position leaps by 1 to 5 m."""
    steps, angle = increments(poses), rng.uniform(-np.pi, np.pi)
    leap = rng.uniform(1.0, 5.0) * np.array([np.cos(angle), np.sin(angle)])
    steps[_somewhere(rng, poses), :2] += leap
    return _rebuilt(poses, steps)


def wheels(rng: np.random.Generator, poses: np.ndarray) -> Damaged:
    """Dead reckoning by wheels that measure distances and turns wrongly, and drift."""
    steps = increments(poses)
    distance = np.hypot(*steps[:, :2].T)
    steps[:, :2] *= 1.0 + rng.normal(0.0, 0.02)
    steps[:, 2] *= 1.0 + rng.normal(0.0, 0.03)
    steps[:, 2] += rng.normal(0.0, 0.005) * distance
    steps[:, 2] += rng.normal(0.0, 0.02, len(steps)) * np.sqrt(distance)
    return _rebuilt(poses, steps)


def carried(rng: np.random.Generator, poses: np.ndarray) -> Damaged:
    """The robot was carried: scans are left out, and no motion is known between them."""
    at = _somewhere(rng, poses)
    gone = min(CARRIED_SCANS, len(poses) // 5)
    kept = np.delete(np.arange(len(poses)), slice(at, at + gone))
    steps = increments(poses)[kept]
    steps[at] = 0.0
    return Damaged(kept, dead_reckoning(poses[0], steps))


def turn_missed(rng: np.random.Generator, poses: np.ndarray) -> Damaged:
    """Nothing is known of a turn of half a radian or more within three scans."""
    steps = increments(poses)
    turned = np.abs(np.convolve(steps[:, 2], np.ones(3), "valid"))
    at = rng.choice(np.flatnonzero(turned > min(0.5, turned.max() - 1e-9)))
    steps[at : at + 3] = 0.0
    return _rebuilt(poses, steps)


def bent(rng: np.random.Generator, poses: np.ndarray) -> Damaged:
    """The heading is lost little by little, by 0.2 to 0.6 rad over 20 scans."""
    steps, at = increments(poses), _somewhere(rng, poses)
    steps[at : at + 20, 2] += rng.choice([-1, 1]) * rng.uniform(0.2, 0.6) / 20
    return _rebuilt(poses, steps)


def slipping(rng: np.random.Generator, poses: np.ndarray) -> Damaged:
    """The wheels report a third of what is driven in 15 scans."""
    steps, at = increments(poses), _somewhere(rng, poses)
    steps[at : at + 15] /= 3.0
    return _rebuilt(poses, steps)


def unhurt(rng: np.random.Generator, poses: np.ndarray) -> Damaged:
    """The trajectory as it is."""
    return Damaged(np.arange(len(poses)), poses)


def noisy(rng: np.random.Generator, poses: np.ndarray) -> Damaged:
    """Each pose is off by some centimetres and by a third of a degree."""
    noise = rng.normal(0.0, [0.02, 0.02, 0.005], poses.shape)
    return Damaged(np.arange(len(poses)), compose(poses, noise))


def drifting(rng: np.random.Generator, poses: np.ndarray) -> Damaged:
    """Poses are off by smooth errors of up to about 15 cm and one degree."""
    part = np.linspace(0.0, 1.0, len(poses))[:, None]
    wave = np.sin(2 * np.pi * (rng.uniform(0.3, 1.5, 3) * part + rng.uniform(0, 1, 3)))
    return Damaged(np.arange(len(poses)), poses + rng.uniform(0.0, [0.1, 0.1, 0.01]) * wave)


LOST: dict[str, Damage] = {
    f.__name__: f for f in (heading, leap, wheels, carried, turn_missed, bent, slipping)
}
FINE: dict[str, Damage] = {f.__name__: f for f in (unhurt, noisy, drifting)}


def position_error(poses: np.ndarray, truth: np.ndarray) -> float:
    """RMSE [m] of the positions of poses (N, 3), after rigid alignment with the truth."""
    aligned = relative(align_trajectory(poses[:, :2], truth[:, :2]), truth)
    return float(np.sqrt(np.mean(np.sum((aligned - poses)[:, :2] ** 2, axis=1))))
