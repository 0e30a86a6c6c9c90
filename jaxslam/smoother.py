"""Batch smoother: Gauss-Newton over all poses and landmarks, with the data association held fixed.

The filter keeps the last pose only, and linearises each measurement once, at the estimate of that
time. Gauss-Newton relinearises all measurements at the smoothed estimate until it converges. This
improves a filter's result, and shows how much accuracy the filter loses.

    repeat:
        linearise all residuals at the state             `evaluate`
        solve the arrowhead normal equations             `arrow.solve`
        halve the step until the cost does not rise      `_step_size`

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

FLOOR = 1e-4  # [m], [rad] std added to each odometry increment: that of a robot at rest is zero
HALVINGS = 6  # of a step that raises the cost, at most; after these it is not taken


class Prior(NamedTuple):
    """Prior of the landmarks.

    Attributes:
        places: (L, 2) mean, as in `Track`.
        information: (L, 2, 2) inverse covariance; zero where nothing is known.
    """

    places: Array
    information: Array


class Records(NamedTuple):
    """The batch problem of one robot: odometry, landmark measurements, and their covariances.

    Attributes:
        start: (3,) known pose before the first increment, world frame.
        motion: (T, 3) odometry increments, in the frame of the pose before.
        q: (T, 3, 3) their covariances in that frame, positive definite.
        seen: (T, M, 2) measured range [m] and bearing [rad], or direction [rad] of a wall and 0;
            robot frame.
        r: (T, M, 2, 2) their covariances.
        kind: (T, M) int32 NODE, CORNER or WALL.
        which: (T, M) int32 landmark 0..L-1 of each feature; L, or -1, for none.
        prior: Of the landmarks; None for none.
    """

    start: Array
    motion: Array
    q: Array
    seen: Array
    r: Array
    kind: Array
    which: Array
    prior: Prior | None = None


class Track(NamedTuple):
    """Smoothed trajectory and landmarks.

    Attributes:
        poses: (T, 3) world frame.
        places: (L, 2) [m] world frame, or direction [rad] of a wall and 0.
        cost: (iterations + 1,) squared Mahalanobis norm of all residuals, the guess's first.
    """

    poses: Array
    places: Array
    cost: Array


def records(
    noise: Noise,
    start: Array,
    inputs: Inputs,
    which: Array,
    *,
    prior: Prior | None = None,
    doubt: float = 1.0,
) -> Records:
    """The batch problem of a filter's measurements.

    Args:
        noise: Noise parameters; `FLOOR` is added to the odometry's.
        start: (3,) known pose before the first increment, world frame.
        inputs: [T] of the filter; `known` is not used.
        which: (T, M) int32 landmark 0..L-1 of each feature; L, or -1, for none.
        prior: Of the landmarks.
        doubt: Factor on the standard deviation of untrusted features, as `Config.doubt`.

    Raises:
        ValueError: `which` has another shape or type than the features; while tracing.
    """
    expect("which", which, inputs.nodes.kind.shape, jnp.int32)
    features = jax.vmap(restrict)(inputs.nodes, which >= 0)
    motion, q = jax.vmap(moved, in_axes=(None, 0))(noise, inputs)
    return Records(
        start=start,
        motion=motion,
        q=q + (FLOOR**2 * jnp.eye(3, dtype=q.dtype))[None],
        seen=jax.vmap(sensor.observation)(features),
        r=jax.vmap(partial(sensor_noise, noise, doubt=doubt))(features),
        kind=features.kind,
        which=jnp.where(features.valid, which, -1),
        prior=prior,
    )


def check(records: Records, poses: Array, places: Array) -> None:
    """Raise ValueError if shapes or types do not fit.

    Args:
        records: The problem.
        poses: (T, 3).
        places: (L, 2).

    Raises:
        ValueError: An array has another shape or type; the message names it.
    """
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
    """The problem with a prior, and with a root W of the information, W^T W = r^-1, instead of `r`.

    W is zero, which masks the feature, where it has no landmark or its numbers are not finite or
    not a covariance.

    Args:
        records: The problem.
        size: Number L of landmarks.
    """
    seen, r, which = records.seen, records.r, records.which
    usable = (which >= 0) & (which < size) & jnp.all(jnp.isfinite(seen), axis=-1)
    usable &= (r[..., 0, 0] > 0.0) & (r[..., 0, 0] * r[..., 1, 1] > r[..., 0, 1] ** 2)
    usable &= jnp.all(jnp.isfinite(r), axis=(-2, -1))
    safe = jnp.where(usable[..., None, None], r, jnp.eye(2, dtype=r.dtype))
    no_prior = Prior(jnp.zeros((size, 2), r.dtype), jnp.zeros((size, 2, 2), r.dtype))
    return records._replace(
        seen=jnp.where(usable[..., None], seen, 0.0),
        r=jnp.where(usable[..., None, None], jax.vmap(jax.vmap(_root))(safe), 0.0),
        which=jnp.where(usable, which, 0),
        prior=records.prior or no_prior,
    )


def _residuals(records: Records, state: State) -> tuple[State, Rows]:
    """Whitened residuals of motions (T, 3) and features (T, M, 2), and their Jacobian.

    For poses x_t = (p_t, heading) and increments u_t, with R_t the rotation by the heading and
    (x, y) = p_t - p_t-1, an error of the motion to pose t is, to first order,

        d(x_t-1^-1 x_t) = R_t-1^T (dx_t - F dx_t-1)    F = [1 0 -y; 0 1 x; 0 0 1]
    """
    poses, landmarks = state
    before = jnp.concatenate([records.start[None], poses[:-1]])
    motion = jax.vmap(between)(before, poses) - records.motion
    motion = motion.at[:, 2].set(wrap_angle(motion[:, 2]))
    x, y = (poses - before).T[:2]
    eye = jnp.zeros_like(records.q) + jnp.eye(3, dtype=x.dtype)[None]
    turn = eye.at[:, :2, :2].set(jax.vmap(rotation)(before[:, 2]))
    root = jax.vmap(_root)(records.q)
    predict = jax.vmap(jax.vmap(sensor.expect, in_axes=(None, 0, 0)))
    predicted, by_pose, by_landmark = predict(poses, landmarks[records.which], records.kind)
    feature = -sensor.residual(records.seen, predicted, records.kind)
    rows = Rows(
        by_motion=root @ turn.swapaxes(1, 2),
        transition=eye.at[:, :2, 2].set(jnp.stack([-y, x], axis=-1)),
        spread=turn @ records.q @ turn.swapaxes(1, 2),
        by_pose=records.r @ by_pose,
        by_place=records.r @ by_landmark,
        at=records.which,
    )
    return (times(root, motion), times(records.r, feature)), rows


def _wrap_walls(records: Records, landmarks: Array) -> Array:
    """Landmarks (L, 2), or differences of them, with the directions of observed walls wrapped."""
    wall = jnp.any(records.r != 0.0, axis=(-2, -1)) & (records.kind == WALL)
    wall = jnp.zeros(landmarks.shape[0], bool).at[records.which].max(wall)
    return landmarks.at[:, 0].set(jnp.where(wall, wrap_line(landmarks[:, 0]), landmarks[:, 0]))


def wrapped(records: Records, state: State) -> State:
    """The state with headings in [-pi, pi) and directions of observed walls in [-pi/2, pi/2).

    Args:
        records: As `prepared` returns them.
        state: Poses (T, 3) and landmarks (L, 2).
    """
    poses, landmarks = state
    return poses.at[:, 2].set(wrap_angle(poses[:, 2])), _wrap_walls(records, landmarks)


def evaluate(records: Records, state: State) -> tuple[Array, State, Rows, Array]:
    """Linearise the problem at a state.

    Args:
        records: As `prepared` returns them.
        state: Poses (T, 3) and landmarks (L, 2).

    Returns:
        Squared Mahalanobis norm () of all residuals and of the prior's; whitened residuals of
        motions (T, 3) and features (T, M, 2); their Jacobian; half the gradient (L, 2) of the
        prior's part.
    """
    residuals, rows = _residuals(records, state)
    error = _wrap_walls(records, state[1] - records.prior.places)
    pull = times(records.prior.information, error)
    return sum(jnp.sum(x**2) for x in residuals) + jnp.sum(error * pull), residuals, rows, pull


def _gauss_newton(records: Records, state: State) -> tuple[Array, State]:
    """Cost () of a state, and the Gauss-Newton step from it."""
    cost, residuals, rows, pull = evaluate(records, state)
    information, size = records.prior.information, state[1].shape[0]
    poses, landmarks = arrow.gradient(rows, residuals, size)
    # A unit diagonal keeps unobserved landmarks where they are; all others are damped by no more
    # than rounding takes.
    diagonal = jnp.einsum("lii->li", arrow.blocks(rows, size) + information)
    diagonal = lax.stop_gradient(diagonal)
    damping = jnp.where(diagonal > 0.0, 4 * jnp.finfo(diagonal.dtype).eps * diagonal, 1.0)
    information += damping[..., None] * jnp.eye(2, dtype=damping.dtype)[None]
    return cost, arrow.solve(rows, information, (-poses, -landmarks - pull))


def _moved(state: State, step: State, size: Array) -> State:
    return jax.tree.map(lambda x, dx: x + size * dx, state, step)


def _step_size(records: Records, state: State, step: State, cost: Array) -> Array:
    """Largest of 1, 1/2, 1/4, ... whose part of a step does not raise the cost; 0 for none.

    A rise within rounding is accepted.
    """
    limit = cost * (1 + 8 * jnp.finfo(cost.dtype).eps)

    def halve(now: tuple[Array, Array]) -> tuple[Array, Array]:
        size = now[0] / 2
        return size, evaluate(records, _moved(state, step, size))[0] <= limit

    def unfinished(now: tuple[Array, Array]) -> Array:
        size, accepted = now
        return ~accepted & (size > 0.5**HALVINGS)

    start = jnp.full((), 2.0, cost.dtype), jnp.zeros((), bool)
    size, accepted = lax.while_loop(unfinished, halve, start)
    return jnp.where(accepted, size, 0.0)


@partial(jax.jit, static_argnames="iterations")
def smooth(records: Records, poses: Array, places: Array, *, iterations: int = 10) -> Track:
    """Maximum a posteriori poses and landmarks by Gauss-Newton, from a guess.

        minimise  sum_t |x_t (-) x_t-1 - u_t|^2_Q + sum_tm |z_tm - h(x_t, l_which)|^2_R + prior

    A step that raises the cost is halved until it does not, so the cost never rises, but for
    rounding. Features without a landmark, or not finite, are ignored; landmarks without features or
    prior stay at the guess. Pad a trajectory at its end, by zero increments without features.
    There is no robust kernel: each correspondence counts fully. In single precision, what the
    measurements hardly constrain, such as the bend of a long path without known landmarks, stays
    near the guess.

    Args:
        records: The problem. If the start is uncertain, `q[0]` includes its covariance.
        poses: (T, 3) guess, world frame.
        places: (L, 2) guess.
        iterations: Number of steps; static.

    Returns:
        The smoothed trajectory and landmarks; the guess, if its cost is not finite. Derivatives are
        those of the iterations that were done.

    Raises:
        ValueError: An argument has another shape or type; while tracing.
    """
    check(records, poses, places)
    records = prepared(records, places.shape[0])

    def iterate(state: State, _: None) -> tuple[State, Array]:
        cost, step = _gauss_newton(records, state)
        size = _step_size(*lax.stop_gradient((records, state, step, cost)))
        new = _moved(state, step, size)
        return jax.tree.map(lambda x, y: jnp.where(size > 0.0, x, y), new, state), cost

    state, costs = lax.scan(iterate, (poses, places), None, length=iterations)
    cost = jnp.append(costs, evaluate(records, state)[0])
    poses, places = wrapped(records, state)
    return Track(poses, places, cost)
