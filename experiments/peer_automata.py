"""Speed of the automaton beside hand-written C, and beside similar functions of other libraries.

All on maps of 128 x 128 cells, in one process on one core. The C program is not part of the
project; its figures are null where it or a compiler is missing.
"""

import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.common import Numbers
from experiments.timing import fastest, seconds
from jaxslam.frontend.automaton import Diagram, expand

SIZE, STEPS = 128, 64
C_SOURCE = Path(__file__).resolve().parents[1] / ".." / "shared" / "bench" / "ca_limit.c"
TIME_LIMIT = 4.0  # [s] for a batch of a peer; the batch is smaller where that is not enough


class CProgram(NamedTuple):
    """A C program that prints its milliseconds per map, or a note why there is none."""

    program: Path | None
    note: str

    def milliseconds(self) -> float:
        """Run it once."""
        done = subprocess.run([self.program], capture_output=True, text=True, check=True)
        return float(re.search(r"([\d.]+) ms/map", done.stdout)[1])


def compile_c(source: Path, folder: Path, *flags: str) -> CProgram:
    """Compile a C source file into a folder, with further compiler flags."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if not source.is_file():
        return CProgram(None, f"no {source.name} beside the repository: not compared with C")
    if not compiler:
        return CProgram(None, "no C compiler: not compared with C")
    text = source.read_text().replace(
        "R=2000", "R=100"
    )  # short runs are less disturbed by other load
    (folder / source.name).write_text(text)
    program = folder / source.stem
    command = [compiler, "-O3", "-march=native", folder / source.name, "-o", program, *flags]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        return CProgram(None, f"{source.name} does not compile: not compared with C")
    return CProgram(program, "gcc -O3 -march=native, the same rule without the steps of arrival")


def scattered(maps: int) -> np.ndarray:
    """Labels (maps, SIZE, SIZE) uint8 of 200 sources each: fronts settle after 20 steps."""
    random = np.random.default_rng(0)
    labels = np.zeros((maps, SIZE * SIZE), np.uint8)
    cells = random.integers(0, SIZE * SIZE, (maps, 200))
    np.put_along_axis(labels, cells, 1 << random.integers(0, 5, cells.shape).astype(np.uint8), 1)
    return labels.reshape(maps, SIZE, SIZE)


def distant(maps: int) -> np.ndarray:
    """Labels (maps, SIZE, SIZE) uint8 of sources so far apart that fronts move in every step."""
    labels = np.zeros((maps, SIZE, SIZE), np.uint8)
    labels[:, 0, 0], labels[:, -1, -1] = 1, 2
    return labels


@partial(jax.jit, static_argnames="steps")
def _expand_batch(labels: jax.Array, *, steps: int) -> Diagram:
    return jax.vmap(partial(_expand_one, steps=steps))(labels)


@partial(jax.jit, static_argnames="steps")
def _expand_one(labels: jax.Array, *, steps: int) -> Diagram:
    return expand(labels, labels == 0, steps=steps)


def automaton(maps: int, repeats: int) -> Numbers:
    """Milliseconds per map of `expand` and of the C program, and their ratios."""
    one = partial(_expand_one, steps=STEPS)
    many = partial(_expand_batch, steps=STEPS)
    sets = {"": jnp.asarray(scattered(maps)), "_all_moving": jnp.asarray(distant(maps))}
    calls = {f"one{name}": (one, labels[0]) for name, labels in sets.items()}
    calls |= {f"batch{name}": (many, labels) for name, labels in sets.items()}
    own, c = dict.fromkeys(calls, np.inf), np.inf
    with tempfile.TemporaryDirectory() as folder:
        rival = compile_c(C_SOURCE, Path(folder))
        for _ in range(repeats):
            if rival.program:
                c = min(c, *(rival.milliseconds() for _ in range(5)))
            taken = fastest(calls, repeats=1)
            own = {name: min(own[name], 1e3 * s) for name, s in taken.items()}
    own = {name: ms / (maps if name.startswith("batch") else 1) for name, ms in own.items()}
    ratio = {name: ms / c if rival.program else None for name, ms in own.items()}
    return {
        "cells": [SIZE, SIZE],
        "steps": STEPS,
        "batch": maps,
        "ms_per_map": own | {"c": c if rival.program else None},
        "automaton_vs_c": ratio["one"],
        "automaton_batch_vs_c": ratio["batch"],
        "automaton_vs_c_all_moving": ratio["one_all_moving"],
        "automaton_batch_vs_c_all_moving": ratio["batch_all_moving"],
        "note": f"{rival.note}; the automaton stops when nothing moves any more, after about 20 "
        "steps of scattered sources; all_moving: two sources whose fronts take every step",
    }


def _scipy() -> dict[str, Callable]:
    from scipy import ndimage

    return {
        "scipy distance_transform_edt, indices": partial(
            ndimage.distance_transform_edt, return_indices=True
        ),
        "scipy distance_transform_cdt, indices": partial(
            ndimage.distance_transform_cdt, metric="taxicab", return_indices=True
        ),
    }


def _skimage() -> dict[str, Callable]:
    morphology = import_module("skimage.morphology")
    return {
        "scikit-image skeletonize": morphology.skeletonize,
        "scikit-image medial_axis": morphology.medial_axis,
    }


def _opencv() -> dict[str, Callable]:
    cv2 = import_module("cv2")
    cv2.setNumThreads(1)

    def transform(free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return cv2.distanceTransformWithLabels(free.view(np.uint8), cv2.DIST_L1, 3)

    return {"OpenCV distanceTransformWithLabels, L1": transform}


def table(maps: int, repeats: int) -> Numbers:
    """Milliseconds per map of each installed peer, alone and in a batch, and ratios."""
    peers, missing = {}, []
    for library, find in (("scipy", _scipy), ("scikit-image", _skimage), ("OpenCV", _opencv)):
        try:
            peers |= find()
        except ImportError:
            missing.append(library)
    labels = scattered(maps)
    free = labels == 0
    own = jnp.asarray(labels)
    calls = {name: (peer, free[0]) for name, peer in peers.items()}
    calls["automaton"] = (partial(expand, steps=STEPS), own[0], own[0] == 0)
    alone = fastest(calls, repeats=repeats)
    batch = {}
    for name, peer in peers.items():
        count = max(1, min(maps, int(TIME_LIMIT / alone[name])))
        taken = [seconds(_call_each, peer, free[:count]) for _ in range(min(2, repeats))]
        batch[name] = min(taken) / count
    call = {"automaton": (partial(_expand_batch, steps=STEPS), own)}
    batch["automaton"] = fastest(call, repeats=repeats)["automaton"] / maps
    rows = {
        name: {
            "ms": 1e3 * alone[name],
            "ms_in_batch": 1e3 * batch[name],
            "times_automaton": alone[name] / alone["automaton"],
            "times_automaton_in_batch": batch[name] / batch["automaton"],
        }
        for name in calls
    }
    return {"batch": maps, "not_installed": missing} | rows


def _call_each(function: Callable, maps: np.ndarray) -> list:
    return [function(one) for one in maps]
