"""Several episodes in one record, padded to the same length, and in JAX's precision."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.episode import Episode
from jaxslam.core.features import Features
from jaxslam.core.measurement import ScanMatch
from jaxslam.core.types import AnyArray


def stack_episodes(episodes: Sequence[Episode]) -> Episode:
    """Stack B drives; shorter ones are padded with scans without motion or features.

    Raises:
        ValueError: There are none, or some have `landmark_ids` or `scan_matches` and others do not.
    """
    if isinstance(episodes, Episode) or not all(isinstance(one, Episode) for one in episodes):
        raise ValueError("episodes is not a list of records of type Episode")
    if not len(episodes):
        raise ValueError("episodes is empty")
    for name in ("landmark_ids", "scan_matches"):
        if len({getattr(episode, name) is None for episode in episodes}) > 1:
            raise ValueError(f"episodes with and without `{name}` do not go together")
    num_scans = max(len(episode.odometry) for episode in episodes)
    num_features = max(episode.features.valid.shape[1] for episode in episodes)

    def fill(x: AnyArray, width: int | None = None, value: float = 0) -> np.ndarray:
        """Pad the scans of an array and, if a width is given, the features of each scan."""
        x = np.asarray(x)
        ends = [(0, num_scans - len(x))]
        ends += [] if width is None else [(0, width - x.shape[1])]
        ends += [(0, 0)] * (x.ndim - len(ends))
        return np.pad(x, ends, constant_values=value)

    def padded(episode: Episode) -> Episode:
        ids, mask, steps = episode.landmark_ids, episode.truth_mask, len(episode.truth)
        return numpy_episode(
            fill(episode.truth),
            fill(episode.odometry),
            jax.tree.map(lambda x: fill(x, num_features), episode.features),
            landmark_ids=None if ids is None else fill(ids, num_features, -1),
            truth_mask=fill(np.ones(steps, bool) if mask is None else mask),
            num_steps=np.array(steps, np.int32),
            scan_matches=jax.tree.map(fill, episode.scan_matches),
        )

    return jax.tree.map(lambda *x: np.stack(x), *map(padded, episodes))


def stack_list(episodes: Any) -> Any:
    """A list of episodes stacked to one record; what is no such list as it is."""
    if isinstance(episodes, list) and all(isinstance(one, Episode) for one in episodes):
        return stack_episodes(episodes)
    return episodes


def numpy_episode(
    truth: AnyArray,
    odometry: AnyArray,
    features: Features,
    *,
    landmark_ids: AnyArray | None = None,
    truth_mask: AnyArray | None = None,
    num_steps: AnyArray | None = None,
    scan_matches: ScanMatch | None = None,
) -> Episode:
    """An episode with NumPy arrays, as `to_numpy_precision`; the fields are those of `Episode`."""
    fields = truth, odometry, features, landmark_ids, truth_mask, num_steps, scan_matches
    return to_numpy_precision(Episode._make(fields))


def to_numpy_precision(episode: Episode) -> Episode:
    """The episode with NumPy arrays, floats in the precision of JAX (float32 unless x64 is on)."""
    precision = jnp.zeros(()).dtype

    def convert(x: np.ndarray) -> np.ndarray:
        x = np.asarray(x)
        return x.astype(precision) if x.dtype.kind == "f" else x

    return jax.tree.map(convert, episode)


def as_episodes(episodes: Any) -> Episode:
    """Episodes [B] whose lists and NumPy arrays are in JAX's precision; arrays of JAX as they are.

    Args:
        episodes: [B] in one record, or a list of B episodes, which are stacked.

    Raises:
        ValueError: It is something else.
    """
    episodes = stack_list(episodes)
    if not isinstance(episodes, Episode):
        raise ValueError(f"episodes is {type(episodes).__name__}, not Episode or a list of them")
    kinds = {"f": jnp.zeros(()).dtype, "i": np.dtype(np.int32)}

    def convert(x: Any) -> Any:
        if isinstance(x, jax.Array):
            return x
        x = np.asarray(x)
        return x.astype(kinds.get(x.dtype.kind, x.dtype), copy=False)

    return jax.tree.map(convert, episodes, is_leaf=lambda x: isinstance(x, list))
