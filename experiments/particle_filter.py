"""Monte Carlo localisation, the usual method, as a peer of `jaxslam.localisation`.

N particles, each a pose. For each scan, after the odometry u:

    x_i ~ p(x | x_i, u)                                           motion
    p   = z_hit exp(-d^2 / (2 sigma_hit^2)) + z_rand / range_max  of a beam that ends d off a wall
    w_i = (product of p over M beams) ^ tempering                 weight
    slow += a_slow (mean w - slow),  fast += a_fast (mean w - fast)
    new particles: uniform ones with probability max(0, 1 - fast / slow), else by low variance

The tempering is there because neighbouring beams are not independent; AMCL of ROS has a sum of
cubes in its place. The free positions of the map are those of its place index. The estimate is the
mean of the heaviest cluster; it is sure where nearly all weight is in that cluster, and the
standard deviations of that are small.

References:
    Thrun, Burgard, Fox (2005), Probabilistic Robotics: table 6.3 (likelihood field), 8.3 (augmented
    Monte Carlo localisation), 4.4 (low variance sampler). nav2's AMCL: 500 to 2,000 particles, 60
    beams, sigma_hit, z_hit and z_rand.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import compose, transform, wrap_angle
from jaxslam.core.types import Array, Key
from jaxslam.localisation import PlaceMap
from jaxslam.matching.place_fit import distance_at
from jaxslam.matching.place_index import PlaceSpec


class ParticleSpec(NamedTuple):
    """Options of the particle filter; static under jit.

    Attributes:
        num_particles: N.
        num_beams: M, evenly spaced.
        sigma_hit: [m] std of the distance of a beam's end from a wall.
        z_hit: Share of the beams that end at a wall,
        z_rand: and that end anywhere.
        tempering: Exponent of the product over the beams.
        odometry_std_floor: [m], [rad] least std of the odometry from scan to scan.
        odometry_slip: Its std as fractions of distance and of turn.
        recovery: a_slow, a_fast; for scans about half a metre apart.
        cluster: [m], [rad] from its mean up to which particles belong to a cluster.
        num_candidates: Particles that clusters are looked for around.
        sure_share: Least share of the weight in the cluster,
        sure_std: [m], [rad] and largest std, where the estimate is sure.
    """

    num_particles: int = 2000
    num_beams: int = 60
    sigma_hit: float = 0.2
    z_hit: float = 0.5
    z_rand: float = 0.5
    tempering: float = 0.1
    odometry_std_floor: tuple[float, float] = (0.03, 0.015)
    odometry_slip: tuple[float, float] = (0.1, 0.1)
    recovery: tuple[float, float] = (0.05, 0.5)
    cluster: tuple[float, float] = (0.75, 0.35)
    num_candidates: int = 64
    sure_share: float = 0.9
    sure_std: tuple[float, float] = (0.25, float(np.radians(5.0)))


class Particles(NamedTuple):
    """State: poses (N, 3), and running means of the weight, both -1 before the first scan."""

    poses: Array
    slow: Array
    fast: Array


class Estimate(NamedTuple):
    """Of one scan: pose (3,), and whether it is sure ()."""

    pose: Array
    sure: Array


def init(spec: ParticleSpec, place_map: PlaceMap, key: Key) -> Particles:
    """Particles anywhere in the map."""
    none = -jnp.ones(())
    return Particles(uniform(place_map, key, spec.num_particles), none, none)


def uniform(place_map: PlaceMap, key: Key, count: int) -> Array:
    """Poses (count, 3) at free positions of the map, with any heading."""
    index, half = place_map.places, PlaceSpec().position_spacing / 2
    of_position, of_offset, of_heading = jax.random.split(key, 3)
    last = jnp.sum(index.valid, dtype=jnp.int32)  # the valid ones come first
    chosen = jax.random.randint(of_position, (count,), 0, last)
    offset = jax.random.uniform(of_offset, (count, 2), minval=-half, maxval=half)
    heading = jax.random.uniform(of_heading, (count, 1), minval=-jnp.pi, maxval=jnp.pi)
    return jnp.concatenate([index.positions[chosen] + offset, heading], axis=1)


def step(
    spec: ParticleSpec,
    lidar: Lidar,
    place_map: PlaceMap,
    state: Particles,
    scan: Scan,
    odometry: Array,
    key: Key,
) -> tuple[Particles, Estimate]:
    """Particles after one scan, and where the robot is."""
    of_motion, of_sampling, of_anywhere, of_choice = jax.random.split(key, 4)
    poses = _move(spec, of_motion, state.poses, odometry)
    weights = _weights(spec, lidar, place_map, poses, scan)
    mean = jnp.mean(weights)

    def running(old: Array, share: float) -> Array:
        return jnp.where(old < 0.0, mean, old + share * (mean - old))

    slow, fast = running(state.slow, spec.recovery[0]), running(state.fast, spec.recovery[1])
    weights = weights / jnp.maximum(jnp.sum(weights), jnp.finfo(weights.dtype).tiny)
    estimate = _estimate(spec, poses, weights, of_sampling)
    chosen = poses[resample(weights, jax.random.uniform(of_sampling), spec.num_particles)]
    anywhere = uniform(place_map, of_anywhere, spec.num_particles)
    share = jnp.maximum(1.0 - fast / jnp.maximum(slow, jnp.finfo(slow.dtype).tiny), 0.0)
    is_new = jax.random.uniform(of_choice, (spec.num_particles, 1)) < share
    return Particles(jnp.where(is_new, anywhere, chosen), slow, fast), estimate


def run_drive(
    spec: ParticleSpec, lidar: Lidar, place_map: PlaceMap, scans: Scan, odometry: Array, key: Key
) -> Estimate:
    """Estimates [T] over scans [T] and odometry (T, 3) of a robot that may start anywhere."""
    start, *keys = jax.random.split(key, 1 + len(odometry))

    def body(state: Particles, now: tuple[Scan, Array, Key]) -> tuple[Particles, Estimate]:
        return step(spec, lidar, place_map, state, *now)

    first = init(spec, place_map, start)
    return lax.scan(body, first, (scans, odometry, jnp.stack(keys)))[1]


def resample(weights: Array, start: Array, count: int) -> Array:
    """Indices (count,) by low variance: index i comes floor or ceil of count w_i times.

    Args:
        weights: (N,) they add up to one.
        start: () uniform in 0 .. 1.
        count: Of indices.
    """
    pointers = (start + jnp.arange(count, dtype=weights.dtype)) / count
    found = jnp.searchsorted(jnp.cumsum(weights), pointers).astype(jnp.int32)
    return jnp.minimum(found, len(weights) - 1)


def _move(spec: ParticleSpec, key: Key, poses: Array, odometry: Array) -> Array:
    (floor, turn_floor), (slip, turn_slip) = spec.odometry_std_floor, spec.odometry_slip
    along = floor + slip * jnp.hypot(odometry[0], odometry[1])
    std = jnp.stack([along, along, turn_floor + turn_slip * jnp.abs(odometry[2])])
    noise = jax.random.normal(key, poses.shape) * std[None]
    return jax.vmap(compose)(poses, odometry[None] + noise)


def _weights(
    spec: ParticleSpec, lidar: Lidar, place_map: PlaceMap, poses: Array, scan: Scan
) -> Array:
    """Weights (N,) of poses (N, 3) by a scan, 1 where all beams would end at walls."""
    count = min(spec.num_beams, lidar.num_beams)
    beams = np.linspace(0, lidar.num_beams - 1, count).round().astype(np.int32)
    angles = jnp.asarray(lidar.angle_min + lidar.angle_increment * beams, poses.dtype)
    ranges = scan.ranges[beams]
    valid = scan.hit[beams] & (ranges < place_map.range_max)
    points = ranges[:, None] * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
    look_up = partial(distance_at, PlaceSpec(), place_map.places)
    distance = jax.vmap(lambda pose: look_up(transform(pose, points)))(poses)
    hit = spec.z_hit * jnp.exp(-0.5 * (distance / spec.sigma_hit) ** 2)
    random = spec.z_rand / place_map.range_max
    share = (hit + random) / (spec.z_hit + random)
    return jnp.exp(spec.tempering * jnp.sum(jnp.where(valid[None], jnp.log(share), 0.0), axis=1))


def _estimate(spec: ParticleSpec, poses: Array, weights: Array, key: Key) -> Estimate:
    """Mean of the heaviest cluster."""
    chosen = resample(weights, jax.random.uniform(key), spec.num_candidates)

    def members(centre: Array) -> Array:
        off = poses - centre[None]
        near = jnp.hypot(off[:, 0], off[:, 1]) < spec.cluster[0]
        return jnp.where(near & (jnp.abs(wrap_angle(off[:, 2])) < spec.cluster[1]), weights, 0.0)

    heavy = jnp.argmax(jax.vmap(lambda centre: jnp.sum(members(centre)))(poses[chosen]))
    centre = poses[chosen[heavy]]
    own = members(centre)
    share = jnp.sum(own)
    off = poses - centre[None]
    off = off.at[:, 2].set(wrap_angle(off[:, 2]))
    own = own / jnp.maximum(share, jnp.finfo(own.dtype).tiny)
    mean = own @ off
    variance = own @ (off - mean[None]) ** 2
    position, heading = jnp.sqrt(jnp.max(variance[:2])), jnp.sqrt(variance[2])
    sure = (position < spec.sure_std[0]) & (heading < spec.sure_std[1])
    pose = centre + mean
    pose = pose.at[2].set(wrap_angle(pose[2]))
    return Estimate(pose, sure & (share > spec.sure_share))
