"""Probability of a failure that is rare, by multilevel splitting on the noise of trials.

A trial is a function of its noise, and its score says how near to a failure it is. Level after
level, a share of the trials, those with the highest scores, begin chains of further trials whose
noise is moved so that its distribution stays the same, among the noises whose trials score higher
than the level. With c_1 < c_2 < ... < threshold the levels, each the quantile of the scores before,

    P(score > threshold) = P(score > c_1) P(score > c_2 | score > c_1) ...

so that 1e-4 is four times 0.1. A move keeps part of the noise: of a normal x with the correlation
1 - m, m the size of the move,

    x' = (1 - m) x + sqrt(1 - (1 - m)^2) z,        z a standard normal,

while of what is not normal, a key, is drawn anew with the probability m, so that people, missing
beams and lost scans are split as well as the noise of encoders. The size follows the share of
moves that are accepted.

The standard error counts a chain and its relatives, those that begin in the same chain of the level
before, as one draw, because they are not independent. It is good where scores rise little by little
to a failure. Where failures come at once, most results are too low, a few too high, and not all of
them are `is_uncertain`: repeat it with other keys, and `combine` the results.

References:
    Au, Beck (2001), "Estimation of small failure probabilities in high dimensions by subset
    simulation". Cerou, Del Moral, Furon, Guyader (2012), "Sequential Monte Carlo for rare event
    estimation". Papaioannou, Betz, Zwirglmaier, Straub (2015), "MCMC algorithms for subset
    simulation" (moves with a correlation, of a size that follows the acceptance).
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from jaxslam.core.types import Array, Key, as_count, as_size
from jaxslam.evaluation.trial_statistics import CONFIDENCE, Interval, proportion

ACCEPTANCE = 0.4  # share of moves to be accepted
MOVES = 0.02, 1.0  # least and largest size of a move
FIRST_MOVE = 0.2
FEW_CHAINS = 0.5  # relative error of a level above which its chains are too few


class Level(NamedTuple):
    """One level.

    Attributes:
        threshold: Score that trials have to exceed to reach the next one.
        share: [-] of the trials that do.
        relative_error: Standard error of `share` by `share`.
        acceptance: [-] share of the moves that were accepted; of the first level, 1.
        move: Size of the last moves.
    """

    threshold: float
    share: float
    relative_error: float
    acceptance: float
    move: float


class RareFailure(NamedTuple):
    """What multilevel splitting finds.

    Attributes:
        probability: Of a failure, with its interval, which is lognormal; NaN, with the interval
            below the highest level, if the threshold was not reached.
        relative_error: Standard error of `probability` by `probability`.
        threshold: Score that a failure exceeds.
        num_trials: All trials that were made.
        levels: Of the splitting; the last is at the threshold if it was reached.
        failures: Noise [F] of trials of the last level that fail.
        scores: (F,) their scores.
    """

    probability: Interval
    relative_error: float
    threshold: float
    num_trials: int
    levels: tuple[Level, ...]
    failures: Any
    scores: np.ndarray

    @property
    def reached(self) -> bool:
        """Whether a trial failed."""
        return bool(self.levels[-1].threshold >= self.threshold and len(self.scores))

    @property
    def is_uncertain(self) -> bool:
        """Whether the trials of a level are those of few families: the interval may be too short.

        It is so where few trials of a level show the path to a failure: take more `level_trials`,
        and other keys.
        """
        return any(level.relative_error > FEW_CHAINS for level in self.levels)

    @property
    def plain_trials(self) -> float:
        """Plain trials that determine the probability as well."""
        p = self.probability.value
        return (1.0 - p) / (p * self.relative_error**2)


def rare_failure(
    key: Key,
    draw: Callable[[Key], Any],
    score: Callable[[Any], Any],
    *,
    threshold: float,
    level_trials: int = 500,
    chain_length: int = 10,
    least: float = 1e-9,
    callback: Callable[[int], None] | None = None,
) -> RareFailure:
    """Probability that the score of a trial exceeds a threshold.

    It takes about `level_trials` times 1 + 0.9 log10(1 / probability) trials, and keeps the noise
    of twice `level_trials` trials.

    Args:
        key: Of all that is random.
        draw: Of keys (B,): noise [B] of trials, a tree of arrays that lead with B. Those of floats
            are independent standard normals, the others keys; B is always the same.
        score: Of noise [B]: (B,) score of each trial, the higher the nearer to failure; NaN is a
            failure.
        threshold: A trial fails if its score is larger.
        level_trials: Trials of a level, at least ten times `chain_length`.
        chain_length: Trials of a chain; its inverse is the share that reaches the next level.
        least: The search ends if the probability is below.
        callback: Called with the number of trials so far.

    Raises:
        ValueError: An argument is not possible, or `draw` returns something else.
    """
    length = as_count("chain_length", chain_length, least=2)
    chains = as_count("level_trials", level_trials, least=10 * length) // length
    bound = as_size("threshold", threshold, least=-math.inf, unit="the score")
    end = as_size("least", least, positive=True, most=1.0, unit="probability")
    num_trials = 0

    def scored(noise: Any) -> np.ndarray:
        nonlocal num_trials
        num_trials += chains
        values = np.asarray(score(noise), np.float64)
        if values.shape != (chains,):
            raise ValueError(f"score returns {values.shape}, not ({chains},) of as many trials")
        if callback is not None:
            callback(num_trials)
        return np.where(np.isnan(values), np.inf, values)

    parts = [draw(own) for own in jax.random.split(jax.random.fold_in(key, 0), (length, chains))]
    check_noise(parts[0], chains)
    population = _join(parts)
    scores = np.concatenate([scored(part) for part in parts])
    chain, parent = np.arange(len(scores)), np.arange(len(scores))
    levels: list[Level] = []
    acceptance, move = 1.0, FIRST_MOVE
    while True:
        level = min(float(np.sort(scores)[-1 - chains]), bound)
        above = scores > level
        levels.append(Level(level, *_share(above, parent[chain]), acceptance, move))
        reached = np.flatnonzero(above)
        if level == bound or not len(reached) or math.prod(x.share for x in levels) < end:
            return _result(levels, bound, num_trials, _take(population, reached), scores[reached])
        own = jax.random.fold_in(key, len(levels))
        begin = _seeds(own, reached, chains)
        # The first level has no chains: each trial is its own.
        parent = chain[begin]
        state, now = _take(population, begin), scores[begin]
        states, history, accepted = [state], [now], []
        for step in range(1, length):
            moved = move_noise(jax.random.fold_in(own, step), move, state)
            found = scored(moved)
            is_accepted = found > level
            state = _where(is_accepted, moved, state)
            now = np.where(is_accepted, found, now)
            states.append(state)
            history.append(now)
            accepted.append(is_accepted.mean())
            move = float(np.clip(move * np.exp(accepted[-1] - ACCEPTANCE), *MOVES))
        population, scores = _join(states), np.concatenate(history)
        chain, acceptance = np.tile(np.arange(chains), length), float(np.mean(accepted))


def combine(found: Sequence[RareFailure]) -> Interval:
    """Mean probability of results with different keys, and its interval by their spread.

    A result that did not reach the threshold counts as 0.

    Raises:
        ValueError: There is one result, or the thresholds differ.
    """
    if len(found) < 2 or len({one.threshold for one in found}) > 1:
        raise ValueError("found holds one result, or those of several thresholds")
    values = np.array([one.probability.value if one.reached else 0.0 for one in found])
    error = values.std(ddof=1) / math.sqrt(len(values))
    width = stats.t.ppf(0.5 + CONFIDENCE / 2, len(values) - 1) * error
    mean = float(values.mean())
    return Interval(mean, max(0.0, mean - float(width)), min(1.0, mean + float(width)))


def describe(found: RareFailure, unit: str = "m") -> str:
    """What was found, in one line."""
    end = f"{found.num_trials} trials"
    if found.is_uncertain:
        end += " of few families: take more for each level"
    if found.reached:
        p, low, high = found.probability
        return (
            f"probability of more than {found.threshold:g} {unit}: {p:.2g} "
            f"({low:.2g} to {high:.2g}), {end}; as well known from "
            f"{found.plain_trials:.0f} plain ones"
        )
    highest = found.levels[-1].threshold
    return (
        f"{found.threshold:g} {unit} were not reached in {end}: more than {highest:.3g} {unit} has "
        f"a probability of at most {found.probability.high:.2g}"
    )


@jax.jit
def move_noise(key: Key, size: Any, noise: Any) -> Any:
    """Noise [B] that is distributed as before, and like the one before.

    Args:
        key: Of the move.
        size: [-] 1 for noise that is independent of the one before, 0 for the same.
        noise: [B] of trials, as of `rare_failure`.
    """
    leaves, tree = jax.tree.flatten(noise)
    moved = []
    for x, own in zip(leaves, jax.random.split(key, len(leaves)), strict=True):
        if _is_key(x):
            of_choice, of_new = jax.random.split(own)
            chosen = jax.random.uniform(of_choice, x.shape) < size
            moved.append(jnp.where(chosen, jax.random.split(of_new, x.shape), x))
        else:
            kept = jnp.asarray(1.0 - size, x.dtype)
            z = jax.random.normal(own, x.shape, x.dtype)
            moved.append(kept * x + jnp.sqrt(1.0 - kept**2) * z)
    return jax.tree.unflatten(tree, moved)


def check_noise(noise: Any, count: int) -> None:
    """Raise ValueError unless noise is a tree of floats and keys that lead with their number."""
    leaves = jax.tree.leaves(noise)
    if not leaves:
        raise ValueError("draw returns no arrays")
    for x in leaves:
        is_array = isinstance(x, jax.Array)
        if not is_array or not (_is_key(x) or jnp.issubdtype(x.dtype, jnp.floating)):
            kind = x.dtype if is_array else type(x).__name__
            raise ValueError(f"draw returns {kind}, not JAX arrays of floats and keys")
        if x.shape[:1] != (count,):
            raise ValueError(f"draw returns an array {x.shape} for {count} keys")


def _is_key(x: Array) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _share(above: np.ndarray, family: np.ndarray) -> tuple[float, float]:
    """Share of trials (N,) above a level, and its relative error, by families (N,) of trials."""
    share = float(above.mean())
    if not share:
        return 0.0, math.inf
    influence = np.bincount(family, (above - share) / (len(above) * share))
    return share, float(np.sqrt(np.sum(influence**2)))


def _seeds(key: Key, reached: np.ndarray, count: int) -> np.ndarray:
    """Trials that begin chains: those that reached a level in random order, some of them twice."""
    order = np.asarray(jax.random.permutation(jax.random.fold_in(key, 0), len(reached)))
    return reached[order[np.arange(count) % len(reached)]]


def _result(
    levels: list[Level], threshold: float, num_trials: int, failures: Any, scores: np.ndarray
) -> RareFailure:
    """The result, from the levels."""
    # Of a level that no trial exceeds, the share says nothing.
    known = [level for level in levels if level.share]
    found = math.prod(level.share for level in known)
    error = math.sqrt(sum(level.relative_error**2 for level in known))
    spread = math.exp(stats.norm.ppf(0.5 + CONFIDENCE / 2) * error)
    interval = Interval(found, found / spread, min(1.0, found * spread))
    is_reached = len(known) == len(levels) and levels[-1].threshold == threshold
    if not known:
        interval = Interval(math.nan, 0.0, 1.0)
    elif not is_reached:
        interval = Interval(math.nan, 0.0, interval.high)
    elif len(levels) == 1:  # plain trials
        interval = proportion(len(scores), num_trials)
    scores = scores if is_reached else scores[:0]
    failures = jax.tree.map(lambda x: x[: len(scores)], failures)
    return RareFailure(
        interval,
        error if is_reached else math.nan,
        threshold,
        num_trials,
        tuple(levels),
        failures,
        scores,
    )


@jax.jit
def _join(parts: list[Any]) -> Any:
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


def _take(noise: Any, index: np.ndarray) -> Any:
    return jax.tree.map(lambda x: x[index], noise)


@jax.jit
def _where(chosen: Array, one: Any, other: Any) -> Any:
    def select(x: Array, y: Array) -> Array:
        return jnp.where(jnp.expand_dims(chosen, tuple(range(1, x.ndim))), x, y)

    return jax.tree.map(select, one, other)
