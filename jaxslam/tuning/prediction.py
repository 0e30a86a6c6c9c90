"""Losses that need no ground truth and look further ahead than one step.

The likelihood of the innovations (`losses.innovation_nll`) asks how well the next measurement is
predicted. An error of the sensor that lasts for seconds is predicted well by the measurements just
before, so it looks like small noise, and the filter counts n measurements with one error as n
independent ones. The losses here leave out what measurements near in time say about each other:

    -log p(y) + log p'(y)

with p the density of the measurements y by the filter, and p' that by the same filter with less
memory, for which a landmark that it has forgotten is a new one. For a linear model the measurements
are, in other coordinates, what p' predicts (how y differs from the first measurement of each such
landmark), and how the copies of one landmark lie to each other. The difference is hence

    -log p(places of the copies | how y differs within each copy)

a conditional density of fixed functions of the data, and as such a proper score: least, in the
mean, for the true parameters. Errors may be correlated as they like within the memory of p'.

`PredictionNll` forgets the whole map every so many steps: the map of each part of the drive, made
of that part alone, is predicted from all that came before. `ClosureNll` forgets a landmark that was
not seen for so many steps: two visits must meet.

Where the filter fails, as where one landmark is taken for another, must not decide alone. With NIS
and log-determinants S summed over windows of steps, each less that of p', a window counts

    (rho(NIS) + log det S + n log 2 pi) / 2,      rho(x) = x up to c,  c + c log(x / c) beyond,

c being the quantile of 99.9 % of chi-square with the n degrees of freedom of the window.

References:
    Barratt, Boyd (2020), Fitting a Kalman smoother to data: prediction of what is held out. Cox
    (1975), Partial likelihood. Huber (1964), Robust estimation of a location parameter. Mehra
    (1970), On the identification of variances and adaptive Kalman filtering.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import digamma

from jaxslam.core.episode import Episode
from jaxslam.core.types import Array, as_count
from jaxslam.filtering.belief import Belief, prune
from jaxslam.tuning.ekf_data import EkfSequence
from jaxslam.tuning.model import Model

NORMAL_QUANTILE = 3.0902  # 99.9 %


# Losses are static under jit, and two records of one number would be equal: dataclasses are not.


class Memories(NamedTuple):
    """What the steps [T] of a model returned.

    Attributes:
        whole: With all of its memory, as `Model.step` returns it.
        part: With less of it.
    """

    whole: Any
    part: Any


@dataclass(frozen=True)
class PredictionNll:
    """Negative log-density [nats], per scalar, of the map of each part of a drive: a loss.

    The model starts anew, by `Model.init`, at each part, to be compared with the one that goes on.
    So a model of a user's own must have an initial state that holds at any time. Its infos must
    have the fields `log_likelihood`, `nis` and `dof` of `StepInfo`, of a Gaussian, or `logdet`,
    too.

    Attributes:
        steps: Number of steps of a part: longer than errors of the sensor last.
    """

    steps: int = 64

    def forget(self, first: Any, state: Any, step: Array) -> Any:
        """The state with less memory before a step: the first one at the start of each part."""
        starts = step % self.steps == 0
        return jax.tree.map(lambda new, old: jnp.where(starts, new, old), first, state)

    def __call__(self, info: Memories, sequence: Any) -> Array:
        """The loss ()."""
        del sequence
        return _difference_nll(info, self.steps)

    def check(self, data: Any, name: str) -> None:
        """Raise ValueError where there is nothing to predict."""
        _check_steps(self, data, name)
        if isinstance(data, EkfSequence):
            raise ValueError(
                "prediction is of maps, which grow with what is seen: the states of ekf_model do "
                "not; use losses.innovation_nll"
            )
        if isinstance(data, Episode) and data.landmark_ids is not None:
            for number, ids in enumerate(np.asarray(data.landmark_ids)):
                parts = [np.unique(ids[i : i + self.steps]) for i in range(0, len(ids), self.steps)]
                known, count = np.unique(np.concatenate(parts), return_counts=True)
                if not np.any(count[known >= 0] > 1):
                    raise ValueError(
                        f"{name}: no landmark of episode {number} is seen in two parts of "
                        f"{self.steps} steps, which this loss compares; give fewer steps, "
                        "or use losses.innovation_nll"
                    )


@dataclass(frozen=True)
class ClosureNll:
    """Negative log-density [nats], per scalar, of landmarks seen again after some time: a loss.

    It is of the SLAM filter only. What does not return to a landmark has no part in it.

    Attributes:
        steps: Steps without an observation after which a landmark is forgotten: longer than errors
            of the sensor last.
    """

    steps: int = 64

    def forget(self, first: Any, state: Belief, step: Array) -> Belief:
        """The state with less memory before a step, without landmarks not seen for long."""
        del first, step
        gone = (state.num_seen > 0) & (state.step + 1 - state.last_seen > self.steps)
        return prune(state, gone)

    def __call__(self, info: Memories, sequence: Any) -> Array:
        """The loss ()."""
        del sequence
        return _difference_nll(info, self.steps)

    def check(self, data: Any, name: str) -> None:
        """Raise ValueError where no landmark is seen again, or there are no landmarks."""
        if not isinstance(data, Episode):
            raise ValueError(
                "closures are of the SLAM filter: for a model of your own use PredictionNll, or "
                "losses.innovation_nll"
            )
        _check_steps(self, data, name)
        if data.landmark_ids is None:
            return
        for number, ids in enumerate(np.asarray(data.landmark_ids)):
            seen = [np.flatnonzero((ids == i).any(axis=1)) for i in np.unique(ids[ids >= 0])]
            if not any(np.any(np.diff(steps) > self.steps) for steps in seen):
                raise ValueError(
                    f"{name}: no landmark of episode {number} is seen again after more than "
                    f"{self.steps} steps, which this loss needs; use fewer steps, or "
                    "losses.innovation_nll"
                )


Comparison = PredictionNll | ClosureNll
prediction_nll, closure_nll = PredictionNll(), ClosureNll()


@dataclass(frozen=True)
class NisConsistency:
    """Squared z-score of the logarithm of NIS, mean over windows: a loss, or a term of one.

        (log(NIS / n) - digamma(n / 2) + log(n / 2))^2 n / 2

    with NIS and its degrees of freedom n summed over windows of steps. Alone it determines the
    scale of the innovations, not what they are made of: add it to another.

    Attributes:
        steps: Number of steps of a window.
    """

    steps: int = 64

    def check(self, data: Any, name: str) -> None:
        """Raise ValueError where the windows are impossible."""
        del data, name
        as_count("NisConsistency.steps", self.steps)

    def __call__(self, info: Any, sequence: Any) -> Array:
        """The loss ()."""
        del sequence
        nis, dof = _sums(info.nis, self.steps), _sums(info.dof.astype(info.nis.dtype), self.steps)
        used = (dof > 0.0) & (nis > 0.0)
        n, x = jnp.where(used, dof, 1.0), jnp.where(used, nis, 1.0)
        error = jnp.log(x / n) - digamma(n / 2) + jnp.log(n / 2)
        count = jnp.maximum(jnp.sum(used), 1).astype(x.dtype)
        return jnp.sum(jnp.where(used, error**2 * n / 2, 0.0)) / count


nis_consistency = NisConsistency()


class _State(NamedTuple):
    """State of a model that is run twice.

    Attributes:
        both: [2] states: with the whole memory, with less.
        first: The state before the first step.
        step: () int32 number of the step.
    """

    both: Any
    first: Any
    step: Array


class _Init(NamedTuple):
    """`Model.init` of a model that is run twice."""

    init: Callable[..., Any]

    def __call__(self, params: Any, sequence: Any) -> _State:
        first = self.init(params, sequence)
        both = jax.tree.map(lambda x: jnp.stack([x, x]), first)
        return _State(both, first, jnp.zeros((), jnp.int32))


class _Step(NamedTuple):
    """`Model.step` of a model that is run twice."""

    step: Callable[..., tuple[Any, Any]]
    loss: Comparison

    def __call__(self, params: Any, state: _State, now: Any) -> tuple[_State, Memories]:
        part = jax.tree.map(lambda x: x[1], state.both)
        part = self.loss.forget(state.first, part, state.step)
        both = jax.tree.map(lambda x, y: jnp.stack([x[0], y]), state.both, part)
        both, info = jax.vmap(self.step, in_axes=(None, 0, None))(params, both, now)
        whole, less = (jax.tree.map(lambda x, i=i: x[i], info) for i in range(2))
        return state._replace(both=both, step=state.step + 1), Memories(whole, less)


def run_twice(model: Model, loss: Comparison) -> Model:
    """The model run beside itself with less memory, as the loss needs it; infos are `Memories`."""
    if isinstance(model.step, _Step):
        return model
    # mypy does not see that a NamedTuple can be called.
    init, step = cast(Any, (_Init(model.init), _Step(model.step, loss)))
    return model._replace(init=init, step=step)


def _difference_nll(info: Memories, steps: int) -> Array:
    """Negative log-density () per scalar of what the whole memory predicts beyond the part."""
    whole, part = info
    dtype = whole.nis.dtype
    nis, logdet, dof = (
        _sums((a - b).astype(dtype), steps)
        for a, b in (
            (whole.nis, part.nis),
            (_logdet(whole), _logdet(part)),
            (whole.dof, part.dof),
        )
    )
    used = dof > 0.0
    n = jnp.where(used, dof, 1.0)
    each = (_rho(nis, n) + logdet) / 2 + n * math.log(2 * math.pi) / 2
    return jnp.sum(jnp.where(used, each, 0.0)) / jnp.maximum(jnp.sum(jnp.where(used, n, 0.0)), 1.0)


def _rho(nis: Array, dof: Array) -> Array:
    """NIS up to a quantile of chi-square, its logarithm beyond; none below 0, by linearisation.

    The quantile is that of Wilson and Hilferty (1931).
    """
    spread = 2.0 / (9.0 * dof)
    limit = dof * (1.0 - spread + NORMAL_QUANTILE * jnp.sqrt(spread)) ** 3
    beyond = limit * (1.0 + jnp.log(jnp.maximum(nis, limit) / limit))
    return jnp.where(nis <= limit, jnp.maximum(nis, 0.0), beyond)


def _logdet(info: Any) -> Array:
    """Log-determinants (T,) of the innovation covariances."""
    given = getattr(info, "logdet", None)
    if given is not None:
        return given
    dof = info.dof.astype(info.nis.dtype)
    return -2.0 * info.log_likelihood - info.nis - dof * math.log(2 * math.pi)


def _sums(x: Array, steps: int) -> Array:
    """Sums (N,) of x (T,) over windows of steps; the last may be shorter."""
    return jnp.sum(jnp.pad(x, (0, -len(x) % steps)).reshape(-1, steps), axis=1)


def _check_steps(loss: Comparison, data: Any, name: str) -> None:
    """Raise ValueError unless the steps of a loss are possible, and episodes longer."""
    kind = type(loss).__name__
    steps = as_count(f"{kind}.steps", loss.steps)
    if isinstance(data, Episode) and data.odometry.shape[1] <= steps:
        raise ValueError(
            f"{name} have {data.odometry.shape[1]} steps, of which {kind} needs more than {steps}; "
            "use fewer, or losses.innovation_nll"
        )
