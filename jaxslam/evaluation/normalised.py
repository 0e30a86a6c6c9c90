"""Vectors with their covariances, checked, and whitened."""

from typing import Any

import numpy as np

from jaxslam.core.types import as_float64, as_numpy, check_array

MAX_ASYMMETRY = 1e-5  # of a covariance, relative to its largest number


def steps_of(x: np.ndarray, trailing: int) -> np.ndarray:
    """Array (T, ...) or (B, T, ...) with `trailing` more axes, as (B, T, ...)."""
    return x if x.ndim == 2 + trailing else x[None]


def check_squares(name: str, dof_name: str, values: Any, dof: Any) -> tuple[np.ndarray, np.ndarray]:
    """Normalised squares and their degrees of freedom, (B, T) each, 0 where there are none.

    Raises:
        ValueError: One has another shape or kind or is out of its range, or none is left.
    """
    values = as_float64(name, values, (..., "T"))
    if values.ndim > 2:
        raise ValueError(f"{name} has the shape {values.shape}, not (T,) or (B, T)")
    degrees = as_numpy(dof_name, dof)
    check_array(dof_name, degrees, values.shape if degrees.ndim else (), np.integer)
    degrees = np.broadcast_to(degrees, values.shape)
    if np.min(degrees, initial=0) < 0:
        raise ValueError(f"{dof_name} holds {degrees.min()}, not a number of degrees of freedom")
    used = degrees > 0
    if not used.any():
        raise ValueError(f"{dof_name} is 0 in all steps: there is nothing to report on")
    wrong = used & ~(np.isfinite(values) & (values >= 0.0))
    if wrong.any():
        first = np.argwhere(wrong)[0].tolist()
        raise ValueError(
            f"{name}{first} is {values[tuple(first)]}, not a square; leave it out by {dof_name} 0"
        )
    return steps_of(np.where(used, values, 0.0), 0), steps_of(degrees, 0)


def normalise(
    names: tuple[str, str, str], vectors: Any, covariances: Any, mask: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whiten vectors v by the Cholesky factor of their covariances, S = L L^T: w = L^-1 v.

    A number that is left out has its row and column of S replaced by those of the identity, so the
    others are whitened by their own covariance, as if it had never been there.

    Args:
        names: Of the three arguments, for messages.
        vectors: (T, m) or (B, T, m), or columns (..., m, 1) with a covariance for each.
        covariances: (..., m, m), or one (m, m).
        mask: (..., m) or (...) bool; None for all.

    Returns:
        Squares w^T w (...), the numbers of each vector (...) int64 that count, and w (..., m), NaN
        where left out.

    Raises:
        ValueError: As of `filter_consistency.consistency_report`.
    """
    name, cov_name, mask_name = names
    v, cov = as_float64(name, vectors, (..., "m")), as_numpy(cov_name, covariances)
    if v.ndim == cov.ndim > 2 and v.shape[-1] == 1 and cov.shape[:-1] == v.shape[:-1]:
        v = v[..., 0]  # columns, as filters of matrices return them
    if v.ndim not in (2, 3) or not v.size:
        raise ValueError(f"{name} has the shape {v.shape}, not (T, m) or (B, T, m) with numbers")
    size = v.shape[-1]
    cov = as_float64(cov_name, cov, (size, size) if cov.ndim == 2 else (*v.shape, size))
    cov = np.broadcast_to(cov, (*v.shape, size))
    has = _check_mask(mask_name, mask, v.shape)
    both = has[..., :, None] & has[..., None, :]
    _check_finite(name, mask_name, v, has)
    _check_finite(cov_name, mask_name, cov, both)
    v = np.where(has, v, 0.0)
    cov = np.where(both, cov, np.eye(size))
    root = _cholesky(cov_name, mask_name, cov)
    w = np.linalg.solve(root, v[..., None])[..., 0]
    with np.errstate(over="ignore"):
        _check_finite(f"the square of {name}", mask_name, w**2, has)
    return np.sum(w**2, axis=-1), has.sum(axis=-1), np.where(has, w, np.nan)


def _check_mask(name: str, mask: Any, shape: tuple[int, ...]) -> np.ndarray:
    """A mask of vectors, by number (..., m)."""
    if mask is None:
        return np.ones(shape, bool)
    mask = as_numpy(name, mask)
    by_step = mask.ndim == len(shape) - 1
    check_array(name, mask, shape[:-1] if by_step else shape, np.bool_)
    mask = np.broadcast_to(mask[..., None], shape) if by_step else mask
    if not mask.any():
        raise ValueError(f"{name} leaves nothing to report on")
    return mask


def _check_finite(name: str, mask_name: str, x: np.ndarray, used: np.ndarray) -> None:
    """Raise ValueError, naming the first, if a number that is used is not finite."""
    wrong = used & ~np.isfinite(x)
    if wrong.any():
        index = np.argwhere(wrong)[0].tolist()
        raise ValueError(f"{name}{index} is {x[tuple(index)]}; leave it out by {mask_name}")


def _cholesky(name: str, mask_name: str, cov: np.ndarray) -> np.ndarray:
    """Cholesky factors of covariances (..., m, m); ValueError names the first that has none."""
    asymmetry = np.abs(cov - np.swapaxes(cov, -1, -2)).max(axis=(-1, -2))
    skew = asymmetry > MAX_ASYMMETRY * np.abs(cov).max(axis=(-1, -2))
    if skew.any():
        raise ValueError(f"{name}{np.argwhere(skew)[0].tolist()} is not symmetric")
    cov = (cov + np.swapaxes(cov, -1, -2)) / 2
    try:
        return np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        least = np.linalg.eigvalsh(cov)[..., 0]
        index = np.argwhere(least <= least.min().clip(min=0.0))[0].tolist()
        raise ValueError(
            f"{name}{index} is not positive definite: its smallest eigenvalue is "
            f"{least[tuple(index)]:g}; leave the step out by {mask_name}"
        ) from None
