"""Speed of the automaton beside hand-written C, and beside what other libraries offer.

All on maps of 128 x 128 cells, in one run on one core. The C program is a yardstick that is no
part of the project; its figures are null where it or a compiler is not there.
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
from experiments.one_core import least, seconds
from jaxslam.frontend.automaton import Diagram, expand

SIZE, STEPS = 128, 64
YARDSTICK = Path(__file__).resolve().parents[1] / ".." / "shared" / "bench" / "ca_limit.c"
PATIENCE = 4.0  # [s] for a batch of a peer; it is of fewer maps where that is not enough


class Rival(NamedTuple):
    """A C program that tells its milliseconds a map, or why there is none."""

    program: Path | None
    note: str

    def milliseconds(self) -> float:
        """Run it once."""
        told = subprocess.run([self.program], capture_output=True, text=True, check=True).stdout
        return float(re.search(r"([\d.]+) ms/map", told)[1])


def compiled(source: Path, folder: Path, *flags: str) -> Rival:
    """The C program of a source file, compiled to a folder, with more flags for the compiler."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if not source.is_file():
        return Rival(None, f"no {source.name} beside the repository: not compared with C")
    if not compiler:
        return Rival(None, "no C compiler: not compared with C")
    text = source.read_text().replace("R=2000", "R=100")  # short runs find quiet moments too
    (folder / source.name).write_text(text)
    program = folder / source.stem
    command = [compiler, "-O3", "-march=native", folder / source.name, "-o", program, *flags]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        return Rival(None, f"{source.name} does not compile: not compared with C")
    return Rival(program, "gcc -O3 -march=native, the same rule without the steps of arrival")


def scattered(maps: int) -> np.ndarray:
    """Labels (maps, SIZE, SIZE) uint8 of 200 sources each: their fronts settle after 20 steps."""
    random = np.random.default_rng(0)
    labels = np.zeros((maps, SIZE * SIZE), np.uint8)
    place = random.integers(0, SIZE * SIZE, (maps, 200))
    np.put_along_axis(labels, place, 1 << random.integers(0, 5, place.shape).astype(np.uint8), 1)
    return labels.reshape(maps, SIZE, SIZE)


def distant(maps: int) -> np.ndarray:
    """Labels (maps, SIZE, SIZE) uint8 of sources so far apart that fronts move in every step."""
    labels = np.zeros((maps, SIZE, SIZE), np.uint8)
    labels[:, 0, 0], labels[:, -1, -1] = 1, 2
    return labels


@partial(jax.jit, static_argnames="steps")
def _together(labels: jax.Array, *, steps: int) -> Diagram:
    return jax.vmap(lambda own: expand(own, own == 0, steps=steps))(labels)


def automaton(maps: int, repeats: int) -> Numbers:
    """Milliseconds a map of `expand` and of the C program, and their ratios."""
    one = jax.jit(lambda labels: expand(labels, labels == 0, steps=STEPS))
    many = partial(_together, steps=STEPS)
    sets = {"": jnp.asarray(scattered(maps)), "_all_moving": jnp.asarray(distant(maps))}
    calls = {f"one{name}": (one, labels[0]) for name, labels in sets.items()}
    calls |= {f"batch{name}": (many, labels) for name, labels in sets.items()}
    own, c = dict.fromkeys(calls, np.inf), np.inf
    with tempfile.TemporaryDirectory() as folder:
        rival = compiled(YARDSTICK, Path(folder))
        for _ in range(repeats):
            if rival.program:
                c = min(c, *(rival.milliseconds() for _ in range(5)))
            taken = least(calls, repeats=1)
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

    edt, cdt = ndimage.distance_transform_edt, ndimage.distance_transform_cdt
    return {
        "scipy distance_transform_edt, indices": lambda free: edt(free, return_indices=True),
        "scipy distance_transform_cdt, indices": lambda free: cdt(
            free, metric="taxicab", return_indices=True
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
    transform = cv2.distanceTransformWithLabels
    return {
        "OpenCV distanceTransformWithLabels, L1": lambda free: transform(
            free.view(np.uint8), cv2.DIST_L1, 3
        )
    }


def table(maps: int, repeats: int) -> Numbers:
    """Milliseconds a map of each peer that is installed, alone and in a batch, and ratios."""
    peers, missing = {}, []
    for name, find in (("scipy", _scipy), ("scikit-image", _skimage), ("OpenCV", _opencv)):
        try:
            peers |= find()
        except ImportError:
            missing.append(name)
    labels = scattered(maps)
    free = labels == 0
    own = jnp.asarray(labels)
    calls = {name: (peer, free[0]) for name, peer in peers.items()}
    calls["automaton"] = (partial(expand, steps=STEPS), own[0], own[0] == 0)
    alone = least(calls, repeats=repeats)
    many = {}
    for name, peer in peers.items():
        count = max(1, min(maps, int(PATIENCE / alone[name])))
        run = lambda peer=peer, count=count: [peer(one) for one in free[:count]]
        many[name] = min(seconds(run) for _ in range(min(2, repeats))) / count
    many["automaton"] = (
        least({"automaton": (partial(_together, steps=STEPS), own)}, repeats=repeats)["automaton"]
        / maps
    )
    row = lambda name: {
        "ms": 1e3 * alone[name],
        "ms_in_batch": 1e3 * many[name],
        "times_automaton": alone[name] / alone["automaton"],
        "times_automaton_in_batch": many[name] / many["automaton"],
    }
    return {"batch": maps, "not_installed": missing} | {name: row(name) for name in calls}
