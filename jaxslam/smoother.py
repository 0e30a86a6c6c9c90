"""Batch smoother: all poses of a run and all its landmarks at once, with the matches held fixed.

The filter keeps the last pose only, and linearises once, where it stood then. Here Gauss-Newton
goes over the same records until nothing moves: that polishes a run of the filter, and tells how
much the filter left on the table.

References:
    Lu, Milios (1997), Globally consistent range scan alignment for environment mapping. Dellaert,
    Kaess (2006), Square root SAM. Nocedal, Wright (2006), Numerical Optimization, section 10.3.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam import arrow, sensor
from jaxslam.arrow import Rows, State, times
from jaxslam.geometry import between, rotation, wrap_angle, wrap_line
from jaxslam.linalg import inverse_root
from jaxslam.nodes import restrict
from jaxslam.noise import Noise, sensor_noise
from jaxslam.slam import Inputs, moved
from jaxslam.types import WALL, Array, expect

FLOOR = 1e-4  # [m], [rad] std that is added to each motion: a robot that stands still has none
HALVINGS = 6  # of a step that raises the cost; after these it is not taken


class Prior(NamedTuple):
    """What is known of the landmarks beforehand."""

    places: Array  # (L, 2)
    information: Array  # (L, 2, 2) inverse covariance; zero where nothing is known


class Records(NamedTuple):
    """What one robot was told, and how well."""

    start: Array  # (3,) known pose before the first motion, world frame
    motion: Array  # (T, 3) odometry since the pose before
    q: Array  # (T, 3, 3) its covariance in the frame of that pose, positive definite
    seen: Array  # (T, M, 2) range [m] and bearing [rad], or direction [rad] of a wall and 0
    r: Array  # (T, M, 2, 2) its covariance
    kind: Array  # (T, M) int32 NODE, CORNER or WALL
    which: Array  # (T, M) int32 landmark 0..L-1 of each feature; L, or -1, for none
    prior: Prior | None = None


class Track(NamedTuple):
    """A smoothed run."""

    poses: Array  # (T, 3) world frame
    places: Array  # (L, 2) [m] world frame, or direction [rad] of a wall and 0
    cost: Array  # (iterations + 1,) squared Mahalanobis norm of all residuals, the guess first


def records(
    noise: Noise,
    start: Array,
    inputs: Inputs,
    which: Array,
    *,
    prior: Prior | None = None,
    doubt: float = 1.0,
) -> Records:
    """What the filter was given, as the smoother takes it.

    Args:
        noise: What is assumed of it; `FLOOR` is added to the odometry's.
        start: (3,) known pose before the first motion.
        inputs: [T] of the filter; `known` is not read.
        which: (T, M) int32 landmark 0..L-1 of each feature; L, or -1, for none.
        prior: Of the landmarks.
        doubt: Factor on the standard deviation of features that are not trusted, as `Config.doubt`.

    Raises:
        ValueError: `which` has another shape or type than the features; while tracing.
    """
    expect("which", which, inputs.nodes.kind.shape, jnp.int32)
    nodes = jax.vmap(restrict)(inputs.nodes, which >= 0)
    motion, q = jax.vmap(moved, in_axes=(None, 0))(noise, inputs)
    return Records(
        start=start,
        motion=motion,
        q=q + (FLOOR**2 * jnp.eye(3, dtype=q.dtype))[None],
        seen=jax.vmap(sensor.observation)(nodes),
        r=jax.vmap(partial(sensor_noise, noise, doubt=doubt))(nodes),
        kind=nodes.kind,
        which=jnp.where(nodes.valid, which, -1),
        prior=prior,
    )


def check(records: Records, poses: Array, places: Array) -> None:
    """Raise ValueError if shapes or types do not fit."""
    expect("poses", poses, ("T", 3), jnp.floating)
    expect("places", places, ("L", 2), jnp.floating)
    expect("records.which", records.which, (len(poses), "M"), jnp.int32)
    steps, scan, size = poses.shape[:1], records.which.shape, places.shape[:1]
    sizes = dict(start=(3,), motion=steps + (3,), q=steps + (3, 3), seen=scan + (2,))
    for name, shape in sizes.items():
        expect(f"records.{name}", getattr(records, name), shape, jnp.floating)
    expect("records.r", records.r, scan + (2, 2), jnp.floating)
    expect("records.kind", records.kind, scan, jnp.int32)
    if records.prior is not None:
        expect("records.prior.places", records.prior.places, size + (2,), jnp.floating)
        expect("records.prior.information", records.prior.information, size + (2, 2), jnp.floating)


def _root(cov: Array) -> Array:
    """W (k, k) with W^T W = cov^-1."""
    return inverse_root(cov)[0]


def prepared(records: Records, size: int) -> Records:
    """Records with a prior, and with roots W of `_root` instead of `r`.

    They are zero where a feature has no landmark or holds nonsense.
    """
    seen, r, which = records.seen, records.r, records.which
    keep = (which >= 0) & (which < size) & jnp.all(jnp.isfinite(seen), axis=-1)
    keep &= (r[..., 0, 0] > 0.0) & (r[..., 0, 0] * r[..., 1, 1] > r[..., 0, 1] ** 2)
    keep &= jnp.all(jnp.isfinite(r), axis=(-2, -1))
    safe = jnp.where(keep[..., None, None], r, jnp.eye(2, dtype=r.dtype))
    none = Prior(jnp.zeros((size, 2), r.dtype), jnp.zeros((size, 2, 2), r.dtype))
    return records._replace(
        seen=jnp.where(keep[..., None], seen, 0.0),
        r=jnp.where(keep[..., None, None], jax.vmap(jax.vmap(_root))(safe), 0.0),
        which=jnp.where(keep, which, 0),
        prior=records.prior or none,
    )


def _residuals(records: Records, state: State) -> tuple[State, Rows]:
    """Whitened residuals of motions (T, 3) and features (T, M, 2), and their rows."""
    poses, places = state
    before = jnp.concatenate([records.start[None], poses[:-1]])
    motion = jax.vmap(between)(before, poses) - records.motion
    motion = motion.at[:, 2].set(wrap_angle(motion[:, 2]))
    x, y = (poses - before).T[:2]
    eye = jnp.zeros_like(records.q) + jnp.eye(3, dtype=x.dtype)[None]
    turn = eye.at[:, :2, :2].set(jax.vmap(rotation)(before[:, 2]))
    root = jax.vmap(_root)(records.q)
    each = jax.vmap(jax.vmap(sensor.expect, in_axes=(None, 0, 0)))
    expected, by_pose, by_place = each(poses, places[records.which], records.kind)
    seen = -sensor.residual(records.seen, expected, records.kind)
    rows = Rows(
        by_motion=root @ turn.swapaxes(1, 2),
        transition=eye.at[:, :2, 2].set(jnp.stack([-y, x], axis=-1)),
        spread=turn @ records.q @ turn.swapaxes(1, 2),
        by_pose=records.r @ by_pose,
        by_place=records.r @ by_place,
        at=records.which,
    )
    return (times(root, motion), times(records.r, seen)), rows


def _with_lines(records: Records, places: Array) -> Array:
    """Wrap the directions of walls that are seen, among `places` (L, 2)."""
    wall = jnp.any(records.r != 0.0, axis=(-2, -1)) & (records.kind == WALL)
    wall = jnp.zeros(places.shape[0], bool).at[records.which].max(wall)
    return places.at[:, 0].set(jnp.where(wall, wrap_line(places[:, 0]), places[:, 0]))


def wrapped(records: Records, state: State) -> State:
    """A state with its headings and directions of walls in their ranges."""
    poses, places = state
    return poses.at[:, 2].set(wrap_angle(poses[:, 2])), _with_lines(records, places)


def evaluate(records: Records, state: State) -> tuple[Array, State, Rows, Array]:
    """Squared Mahalanobis norm () of all residuals, these, their rows, and the prior's pull."""
    residuals, rows = _residuals(records, state)
    off = _with_lines(records, state[1] - records.prior.places)
    pull = times(records.prior.information, off)  # (L, 2) half the gradient of the prior's part
    return sum(jnp.sum(x**2) for x in residuals) + jnp.sum(off * pull), residuals, rows, pull


def _step(records: Records, state: State) -> tuple[Array, State]:
    """Cost () of a state, and the Gauss-Newton step from it."""
    cost, residuals, rows, pull = evaluate(records, state)
    extra, size = records.prior.information, state[1].shape[0]
    poses, places = arrow.gradient(rows, residuals, size)
    # Places of which nothing is known stay; the others are held by no more than rounding takes.
    known = lax.stop_gradient(jnp.einsum("lii->li", arrow.blocks(rows, size) + extra))
    held = jnp.where(known > 0.0, 4 * jnp.finfo(known.dtype).eps * known, 1.0)
    extra += held[..., None] * jnp.eye(2, dtype=held.dtype)[None]
    return cost, arrow.solve(rows, extra, (-poses, -places - pull))


def _moved(state: State, step: State, part: Array) -> State:
    return jax.tree.map(lambda x, dx: x + part * dx, state, step)


def _allowed(records: Records, state: State, step: State, cost: Array) -> Array:
    """Largest part () of a step that but for rounding does not raise the cost, 0 for none."""
    most = cost * (1 + 8 * jnp.finfo(cost.dtype).eps)

    def halve(now: tuple[Array, Array]) -> tuple[Array, Array]:
        return now[0] / 2, evaluate(records, _moved(state, step, now[0] / 2))[0] <= most

    first = jnp.full((), 2.0, cost.dtype), jnp.zeros((), bool)
    more = lambda now: ~now[1] & (now[0] > 0.5**HALVINGS)
    part, fits = lax.while_loop(more, halve, first)
    return jnp.where(fits, part, 0.0)


@partial(jax.jit, static_argnames="iterations")
def smooth(records: Records, poses: Array, places: Array, *, iterations: int = 10) -> Track:
    """Most likely poses and places by Gauss-Newton, from a guess.

        minimise  sum_t |x_t (-) x_t-1 - u_t|^2_Q + sum_tm |z_tm - h(x_t, l_which)|^2_R + prior

    A step that raises the cost is halved until it does not, so that but for rounding the cost never
    rises. Features without a landmark, or not finite, are invisible; landmarks without features or
    prior stay at the guess. Pad a run at its end, by steps that stand still and see nothing.
    Matches are not doubted. In single precision, what the records hardly tell, such as how a long
    way without known landmarks bends, stays near the guess.

    Args:
        records: What the robot was told. If the start is not certain, `q[0]` covers that too.
        poses: (T, 3) guess, world frame.
        places: (L, 2) guess.
        iterations: How many; static.

    Returns:
        The smoothed run; the guess, if the cost of that is not finite. Gradients are those of the
        iterations as they were run.

    Raises:
        ValueError: An argument has another shape or type; while tracing.
    """
    check(records, poses, places)
    records = prepared(records, places.shape[0])

    def body(state: State, _: None) -> tuple[State, Array]:
        cost, step = _step(records, state)
        part = _allowed(*lax.stop_gradient((records, state, step, cost)))
        new = _moved(state, step, part)
        return jax.tree.map(lambda x, y: jnp.where(part > 0.0, x, y), new, state), cost

    state, costs = lax.scan(body, (poses, places), None, length=iterations)
    cost = jnp.append(costs, evaluate(records, state)[0])
    return Track(*wrapped(records, state), cost)
