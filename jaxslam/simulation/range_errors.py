"""What a scanner measures of the ranges to what its beams meet: noise, edges, missing returns."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.types import Array, Key
from jaxslam.frontend.lidar import to_scan
from jaxslam.simulation import scanners
from jaxslam.simulation.scanners import Scanner

SHARED = 3  # number of the key of the error that neighbours share


class RangeErrors(NamedTuple):
    """Errors of ranges beside those of the scanner; numbers, traced under jit, none by default.

    Attributes:
        std_scale: [-] factor on the standard deviation of the scanner.
        std_per_range: [-] further part of it that grows in proportion to the range.
        std_by_incidence: [1 / rad] by which the logarithm of the standard deviation grows with the
            angle between a beam and the normal of the wall.
        shared_std: [m] standard deviation of an error that beams share with their neighbours: of
            walls that are not flat or not upright, of materials, of the scanner itself.
        shared_angle: [rad] between beams over which their correlation falls to 1 / e, above 0.
        resolution: [m] step to which ranges are rounded, 0 for none.
        spot: [rad] angle that the spot of a beam covers: where it covers an edge the range is the
            mean over what it meets, weighted by the angle.
        missing: [-] probability that a beam does not return, whatever it meets.
        black: [-] share of the walls that are black.
        black_range: [m] from which a black wall that faces the scanner returns; from another
            incidence only from its cosine times as far.
        glass: [-] share of the walls that are of glass: a beam passes through them.
        glass_angle: [rad] incidence below which glass returns a beam.
    """

    std_scale: Any = 1.0
    std_per_range: Any = 0.0
    std_by_incidence: Any = 0.0
    shared_std: Any = 0.0
    shared_angle: Any = 0.07
    resolution: Any = 0.0
    spot: Any = 0.0
    missing: Any = 0.0
    black: Any = 0.0
    black_range: Any = 2.0
    glass: Any = 0.0
    glass_angle: Any = 0.1


class Returns(NamedTuple):
    """What the beams of a scan meet.

    Attributes:
        distance: (R,) [m] to it, infinite where a beam meets nothing.
        incidence: (R,) [rad] between beam and normal.
        surface: (R,) int32 number of the surface; between two different ones there is an edge.
        is_black: (R,) bool, whether it is black.
    """

    distance: Array
    incidence: Array
    surface: Array
    is_black: Array


def measure(
    key: Key,
    lidar: Lidar,
    errors: RangeErrors,
    returns: Returns,
    *,
    scanner: Scanner | None = None,
    draws: Array | None = None,
) -> Scan:
    """Scan of what the beams meet.

    Gradients with respect to the noise are those of its reparametrisation; rounding counts as the
    identity, and what returns as given.

    Args:
        key: Of all that is random.
        lidar: The scanner as the front end knows it.
        errors: Of its ranges.
        returns: What its beams meet.
        scanner: The scanner with its own noise, resolution and least range; None: those of `lidar`.
        draws: (R,) standard normals of the noise, instead of those of the key.
    """
    of_noise, of_edges, of_missing = jax.random.split(key, 3)
    ranges = mix_edges(of_edges, lidar, errors.spot, returns)
    has_return = jnp.isfinite(ranges)
    safe = jnp.where(has_return, ranges, lidar.range_max)
    own = lidar.range_std if scanner is None else scanner.range_std(safe)
    own = errors.std_scale * jnp.asarray(own, safe.dtype)
    std = jnp.hypot(own, errors.std_per_range * safe)
    std = std * jnp.exp(errors.std_by_incidence * returns.incidence)
    if draws is None:
        draws = jax.random.normal(of_noise, safe.shape, safe.dtype)
    shared = shared_error(jax.random.fold_in(key, SHARED), lidar, errors, safe.dtype)
    safe = round_to(safe + std * draws + shared, errors)
    is_seen = jax.random.uniform(of_missing, safe.shape, safe.dtype) >= errors.missing
    black_range = errors.black_range * jnp.cos(returns.incidence)
    is_seen &= ~returns.is_black | (returns.distance < black_range)
    scan = to_scan(lidar, jnp.where(has_return & is_seen, safe, jnp.inf))
    return scan if scanner is None else scanners.digitise(scanner, scan)


def shared_error(key: Key, lidar: Lidar, errors: RangeErrors, dtype: Any) -> Array:
    """Error (R,) [m] that neighbouring beams share: a Gauss-Markov process along the beams.

    With r = exp(-increment / angle) and standard normals n, s_i = r s_(i-1) + sqrt(1 - r^2) n_i.
    """
    draws = jax.random.normal(key, (lidar.num_beams,), dtype)
    decay = jnp.exp(-lidar.angle_increment / jnp.asarray(errors.shared_angle, dtype))
    fresh = jnp.sqrt(1.0 - decay**2) * draws
    fresh = fresh.at[0].set(draws[0])

    def join(first: tuple[Array, Array], then: tuple[Array, Array]) -> tuple[Array, Array]:
        return first[0] * then[0], first[1] * then[0] + then[1]

    decays = jnp.full_like(draws, decay)
    return errors.shared_std * lax.associative_scan(join, (decays, fresh))[1]


def round_to(ranges: Array, errors: RangeErrors) -> Array:
    """Ranges (R,) rounded to the resolution, if there is one; the derivative is 1."""
    step = jnp.asarray(errors.resolution, ranges.dtype)
    safe = jnp.where(step > 0.0, step, 1.0)
    rounded = jnp.where(step > 0.0, safe * jnp.round(ranges / safe), ranges)
    return ranges + lax.stop_gradient(rounded - ranges)


def mix_edges(key: Key, lidar: Lidar, spot: Array, returns: Returns) -> Array:
    """Ranges (R,) [m] where the spots of beams cover edges.

    Between two beams that meet different surfaces there is an edge, at an angle e from the first,
    uniform over the increment. The share 1/2 - e / spot of the spot of the first beam is behind it:

        range of beam i = d_i + (1/2 - e / spot) (d_(i+1) - d_i),      if e < spot / 2

    and likewise for the second.

    Args:
        key: Of the edges.
        lidar: The scanner.
        spot: [rad] angle that the spot of a beam covers.
        returns: What the beams meet.
    """
    distance = returns.distance
    step = jnp.diff(jnp.where(jnp.isfinite(distance), distance, 0.0))
    is_edge = returns.surface[1:] != returns.surface[:-1]
    is_edge &= jnp.isfinite(distance[1:]) & jnp.isfinite(distance[:-1])
    step = jnp.where(is_edge, step, 0.0)
    edge = lidar.angle_increment * jax.random.uniform(key, step.shape, step.dtype)
    spot = jnp.asarray(spot, step.dtype)
    safe = jnp.where(spot > 0.0, spot, 1.0)

    def behind(angle: Array) -> Array:
        return jnp.where(spot > 0.0, jnp.maximum(0.5 - angle / safe, 0.0), 0.0) * step

    ahead = jnp.pad(behind(edge), (0, 1))
    before = jnp.pad(behind(lidar.angle_increment - edge), (1, 0))
    return distance + (ahead - before)
