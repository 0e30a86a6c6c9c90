"""Checkpoints: the state of a long computation in a file, to resume it after an interruption."""

import json
from collections.abc import Mapping
from os import PathLike
from typing import Any, TypeVar

import jax
import numpy as np

from jaxslam.io.errors import InputError
from jaxslam.io.output import plain, replace

Tree = TypeVar("Tree")
ABOUT = "about"


def write(path: str | PathLike, state: Any, about: Mapping[str, Any]) -> None:
    """Save a state; the file is replaced atomically, so a complete one always exists.

    Args:
        path: File to write (NumPy's .npz).
        state: Pytree of arrays.
        about: Settings of the computation: all that must be equal for it to be resumed.

    Raises:
        InputError: The file cannot be written.
    """
    leaves = {f"leaf{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(state))}
    arrays = {ABOUT: np.asarray(json.dumps(plain(about)))} | leaves
    with replace(path) as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]  # the stub takes a name for an option


def read(path: str | PathLike, template: Tree, about: Mapping[str, Any]) -> Tree:
    """Read a state that `write` saved.

    Args:
        path: The file.
        template: A state with the same structure, shapes and dtypes.
        about: Settings that the saved ones must be equal to.

    Raises:
        InputError: The file cannot be read, is no checkpoint, or has other settings or shapes.
    """
    advice = "remove it to start again, or name another folder by --out"
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            saved = json.loads(str(file[ABOUT]))
            leaves = [file[f"leaf{i}"] for i in range(len(file.files) - 1)]
    except Exception as error:  # NumPy, zipfile and json do not document what damage raises
        problem = f"is no checkpoint ({type(error).__name__})"
        raise InputError(problem, path=path, advice=advice) from None
    expected = plain(about)
    for name in sorted(expected.keys() | (saved.keys() if isinstance(saved, dict) else set())):
        if not isinstance(saved, dict) or saved.get(name) != expected.get(name):
            raise InputError("belongs to another run", path=path, field=name, advice=advice)
    template_leaves, structure = jax.tree.flatten(template)
    same = len(template_leaves) == len(leaves) and all(
        np.shape(wanted) == found.shape and np.asarray(wanted).dtype == found.dtype
        for wanted, found in zip(template_leaves, leaves, strict=True)
    )
    if not same:
        raise InputError("belongs to another run (its shapes)", path=path, advice=advice)
    return jax.tree.unflatten(structure, leaves)
