"""Gaussian priors of parameters: what is known before there are data."""

from typing import Any, NamedTuple

import jax
import numpy as np

from jaxslam.tuning.parameters import leaf_names
from jaxslam.tuning.transforms import Transform, of_leaves, spread_leaves


class Prior(NamedTuple):
    """Normal distribution of the unconstrained numbers of a leaf of the parameters.

    Attributes:
        mean: Of the parameter itself; a number, or an array of its shape.
        std: Standard deviation of the parameter at its mean; likewise, above 0.
    """

    mean: Any
    std: Any


NO_PRIOR = Prior(0.0, np.inf)


class FlatPrior(NamedTuple):
    """Priors of the P unconstrained numbers.

    Attributes:
        mean: (P,).
        precision: (P,) 1 / variance; 0 where there is none.
    """

    mean: np.ndarray
    precision: np.ndarray

    def value_and_gradient(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """Negative log density, without its constant, and its gradient (P,)."""
        slope = self.precision * (theta - self.mean)
        return 0.5 * float(slope @ (theta - self.mean)), slope


def flatten_prior(prior: Any, params: Any, transforms: Any = None) -> FlatPrior:
    """Priors of the P unconstrained numbers, to first order in the transforms.

        theta ~ N(inverse(mean), (std / |d forward / d theta|)^2)

    Args:
        prior: Tree of `Prior`s like the parameters, None where there is none.
        params: The parameters.
        transforms: As of `transforms.of_leaves`.

    Raises:
        ValueError: It is no such tree; a mean or standard deviation has another shape, is not
            finite, or impossible; or one is given of a matrix, whose numbers are not its own.
    """
    leaves = jax.tree.leaves(params)
    used = of_leaves(params, transforms)
    given = spread_leaves("prior", prior, params, _is_prior, _spread)
    if not all(isinstance(one, Prior) for one in given):
        raise ValueError("prior is no tree of Priors like the parameters, None where there is none")
    means, precisions = [], []
    for name, one, leaf, transform in zip(leaf_names(params), given, leaves, used, strict=True):
        start = transform.inverse(np.asarray(leaf, np.float64), *transform.constants)
        if one is NO_PRIOR:
            means.append(np.zeros(np.shape(start)))
            precisions.append(np.zeros(np.shape(start)))
            continue
        if np.shape(start) != np.shape(leaf):
            raise ValueError(f"prior of {name} is of a matrix, which has none")
        mean, std = (_broadcast(name, one, x, np.shape(leaf)) for x in one)
        finite = np.isfinite(mean).all() and np.isfinite(std).all() and (std > 0.0).all()
        theta = precision = mean
        if finite and transform.domain(mean, *transform.constants):
            theta = transform.inverse(mean, *transform.constants)
            with np.errstate(over="ignore"):
                precision = (_slope(transform, theta) / std) ** 2
        else:
            finite = False
        if not finite or not np.isfinite(precision).all():
            wanted = f"a mean that is {transform.text}, and a positive standard deviation"
            raise ValueError(f"prior of {name} is {one}, not {wanted}, both finite")
        means.append(theta)
        precisions.append(precision)
    flat = [np.concatenate([np.ravel(x) for x in some]) for some in (means, precisions)]
    return FlatPrior(*flat)


def _broadcast(name: str, prior: Prior, x: Any, shape: tuple[int, ...]) -> np.ndarray:
    """A mean or standard deviation as floats of the shape of its parameter."""
    try:
        return np.broadcast_to(np.asarray(x, np.float64), shape)
    except (TypeError, ValueError):
        wanted = f"numbers, one for all or of the shape {shape}"
        raise ValueError(f"prior of {name} is {prior}, not {wanted}") from None


def _slope(transform: Transform, theta: np.ndarray) -> np.ndarray:
    """Derivative of each parameter by its own number, by central differences in float64."""
    step = 1e-5
    up, down = (transform.forward(theta + by, *transform.constants) for by in (step, -step))
    return (up - down) / (2 * step)


def _is_prior(x: Any) -> bool:
    return x is None or isinstance(x, Prior)


def _spread(one: Any, below: Any) -> Any:
    """A prior for each leaf of a part of the parameters."""
    return jax.tree.map(lambda _: NO_PRIOR if one is None else one, below)
