"""Loop closures as factors of the batch problem: whitened residuals, and a robust kernel on them.

NumPy, in double precision, for the sparse smoother.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxslam.core import se2_np
from jaxslam.core.arguments import as_array
from jaxslam.core.types import as_float64, check_array
from jaxslam.matching.loop_closure import LoopClosures


class LoopClosureRows(NamedTuple):
    """Reweighted residuals of C loop closures, and their Jacobian.

    Attributes:
        poses: Indices (C,) of the first pose of each, and (C,) of the second.
        residual: (C, 3).
        J_pose: Derivatives (C, 3, 3) with respect to the first pose, and to the second.
    """

    poses: tuple[np.ndarray, np.ndarray]
    residual: np.ndarray
    J_pose: tuple[np.ndarray, np.ndarray]


def as_loop_closures(loop_closures: LoopClosures, num_poses: int) -> LoopClosures:
    """Loop closures in NumPy arrays, checked.

    Args:
        loop_closures: Between poses of one trajectory.
        num_poses: T, number of these poses.

    Raises:
        ValueError: An array has another shape or kind, or an index is not of a pose.
    """
    if not isinstance(loop_closures, LoopClosures):
        raise ValueError(f"loop_closures is a {type(loop_closures).__name__}, not LoopClosures")
    name, given = "loop_closures", loop_closures
    first = _as_pose_index(f"{name}.first", given.first, ("C",), num_poses)
    size = first.shape
    return LoopClosures(
        first=first,
        second=_as_pose_index(f"{name}.second", given.second, size, num_poses),
        relative_pose=as_float64(f"{name}.relative_pose", given.relative_pose, (*size, 3)),
        information=as_float64(f"{name}.information", given.information, (*size, 3, 3)),
    )


def _as_pose_index(name: str, x: Any, shape: tuple[Any, ...], num_poses: int) -> np.ndarray:
    """Indices of poses as a NumPy array, checked."""
    index = np.asarray(as_array(name, x))
    check_array(name, index, shape, jnp.integer)
    if index.size and not 0 <= index.min() <= index.max() < num_poses:
        raise ValueError(f"{name} holds {index.min()} to {index.max()}, not 0 to {num_poses - 1}")
    return index


def closure_residuals(
    poses: np.ndarray, loop_closures: LoopClosures
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whitened residuals of loop closures, and their derivatives.

    With W^T W the information, the residual is W ((x_first^-1 x_second) - relative_pose), its angle
    wrapped.

    Args:
        poses: (T, 3) [m, m, rad] map frame.
        loop_closures: Between them.

    Returns:
        Residuals (C, 3); derivatives (C, 3, 3) with respect to the first poses and to the second.
    """
    first, second = poses[loop_closures.first], poses[loop_closures.second]
    relative = se2_np.relative(first, second)
    error = relative - loop_closures.relative_pose
    error[:, 2] -= 2 * np.pi * np.round(error[:, 2] / (2 * np.pi))
    by_first, by_second = np.zeros((2, len(first), 3, 3))
    c, s = np.cos(first[:, 2]), np.sin(first[:, 2])
    by_second[:, :2, :2] = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], -2)
    by_first[:, :2, :2] = -by_second[:, :2, :2]
    by_first[:, :2, 2] = np.stack([relative[:, 1], -relative[:, 0]], axis=-1)
    by_first[:, 2, 2], by_second[:, 2, 2] = -1.0, 1.0
    eigenvalues, axes = np.linalg.eigh(loop_closures.information)
    root = np.sqrt(np.maximum(eigenvalues, 0.0))[..., None] * axes.swapaxes(1, 2)
    return (root @ error[..., None])[..., 0], root @ by_first, root @ by_second


def weighted_closures(
    robust_scale: float, poses: np.ndarray, gradient: np.ndarray, loop_closures: LoopClosures
) -> tuple[float, np.ndarray, LoopClosureRows]:
    """Cost of loop closures under the Cauchy kernel, and what they add to the normal equations.

    Args:
        robust_scale: [std] scale c of the kernel.
        poses: (T, 3) [m, m, rad] map frame.
        gradient: (T, 3) half the gradient of all other residuals.
        loop_closures: Between the poses.

    Returns:
        Cost; the gradient with half of the closures' added; reweighted residuals and Jacobian.
    """
    residual, by_first, by_second = closure_residuals(poses, loop_closures)
    square = np.sum(residual**2, axis=1)
    root = 1.0 / np.sqrt(1.0 + square / robust_scale**2)[:, None]
    rows = LoopClosureRows(
        (loop_closures.first, loop_closures.second),
        root * residual,
        (root[..., None] * by_first, root[..., None] * by_second),
    )
    gradient = np.array(gradient)
    for index, block in zip(rows.poses, rows.J_pose, strict=True):
        np.add.at(gradient, index, (block.swapaxes(1, 2) @ rows.residual[..., None])[..., 0])
    return float(np.sum(robust_scale**2 * np.log1p(square / robust_scale**2))), gradient, rows
