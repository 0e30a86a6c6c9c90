"""A long computation's state in a file, so that it can go on after any stop."""

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
    """Keep a state; the file is replaced as a whole, so that one of them is always there.

    Args:
        path: File to write (NumPy's .npz).
        state: Records of arrays, nested at will.
        about: What the state belongs to: all that must be the same for it to go on.

    Raises:
        InputError: The file cannot be written.
    """
    leaves = {f"leaf{i}": np.asarray(x) for i, x in enumerate(jax.tree.leaves(state))}
    with replace(path) as file:
        np.savez(file, **{ABOUT: json.dumps(plain(about))}, **leaves)


def read(path: str | PathLike, template: Tree, about: Mapping[str, Any]) -> Tree:
    """Read a state that `write` kept.

    Args:
        path: The file.
        template: A state with the same records, shapes and dtypes.
        about: What it is to belong to.

    Raises:
        InputError: The file cannot be read, is no such file, or belongs to something else.
    """
    advice = "remove it to begin anew, or name another folder by --out"
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            found = json.loads(str(file[ABOUT]))
            leaves = [file[f"leaf{i}"] for i in range(len(file.files) - 1)]
    except Exception as error:  # NumPy, zipfile and json list nowhere what damage raises
        problem = f"is no checkpoint ({type(error).__name__})"
        raise InputError(problem, path=path, advice=advice) from None
    wanted = plain(about)
    for name in sorted(wanted.keys() | (found.keys() if isinstance(found, dict) else set())):
        if not isinstance(found, dict) or found.get(name) != wanted.get(name):
            raise InputError("belongs to another run", path=path, field=name, advice=advice)
    own, structure = jax.tree.flatten(template)
    same = len(own) == len(leaves) and all(
        np.shape(a) == b.shape and np.asarray(a).dtype == b.dtype
        for a, b in zip(own, leaves, strict=True)
    )
    if not same:
        raise InputError("belongs to another run (its shapes)", path=path, advice=advice)
    return jax.tree.unflatten(structure, leaves)
