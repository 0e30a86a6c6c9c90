"""Sequences of a tuning: their minibatches, their means, and two sets of them in one.

In: trees of arrays that lead with the number of sequences, numbers of each sequence. Out: the same.
"""

from typing import Any

import jax
import numpy as np


def mean_gradient(values: np.ndarray, each: np.ndarray) -> tuple[float, np.ndarray, int]:
    """Means of losses (B,) and gradients (B, P) over the episodes where both are finite.

    Returns:
        Mean loss, NaN if no episode is left; mean gradient (P,), 0 if none is left; number of
        episodes left out.
    """
    good = np.isfinite(values) & np.isfinite(each).all(axis=1)
    if not good.any():
        return np.nan, np.zeros(each.shape[1]), len(good)
    return values[good].mean(), each[good].mean(axis=0), int(np.sum(~good))


def draw_batch(seed: int, step: int, num_episodes: int, batch_size: int) -> np.ndarray:
    """Minibatch of a step: sorted numbers (batch_size,) of episodes, drawn without replacement.

    Steps take the next `batch_size` numbers of a sequence of permutations of all episodes, one for
    each epoch, which depend on the seed alone: a step can be drawn without the steps before it.
    """
    position = step * batch_size + np.arange(batch_size)
    epoch, offset = (position // num_episodes).tolist(), (position % num_episodes).tolist()
    order = {e: np.random.default_rng([seed, e]).permutation(num_episodes) for e in set(epoch)}
    return np.sort([order[e][k] for e, k in zip(epoch, offset, strict=True)])


def take(indices: np.ndarray, data: Any) -> Any:
    """Some of the sequences, by number."""
    return jax.tree.map(lambda x: x[indices], data)


def joined(first: Any, second: Any) -> Any:
    """Sequences [A] and [B] as [A + B]; None where their arrays differ in more than that number."""
    shapes = [[x.shape[1:] for x in jax.tree.leaves(data)] for data in (first, second)]
    if shapes[0] != shapes[1]:
        return None
    return jax.tree.map(lambda a, b: np.concatenate([a, b]), first, second)


def total_steps(data: Any) -> int:
    """Steps of all sequences [B], padding among them."""
    leaves = jax.tree.leaves(data)
    return len(leaves[0]) * max(x.shape[1] if x.ndim > 1 else 1 for x in leaves)


def finite_mean(values: np.ndarray) -> float:
    """Mean of those of the values (B,) that are finite; NaN if none is."""
    good = np.isfinite(values)
    return values[good].mean() if good.any() else np.nan
