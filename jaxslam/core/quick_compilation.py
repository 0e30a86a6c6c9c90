"""Options of XLA with which large programs of small operations take a third less to compile."""

import os
from functools import cache
from typing import Any

import jax
import numpy as np

QUICK = {"xla_cpu_use_fusion_emitters": False}  # XLA's older code generator

UNOPTIMISED = QUICK | {"xla_backend_optimization_level": 0}
"""Nothing is optimised by LLVM either: a fifth of the time to compile, four to ten times that to
run, of programs that run a few times."""

SHORT_WORK = 10_000
"""Scans of a batch up to which front end and filter are compiled quickly: what then runs slower
costs at most a third of the compile time that is saved."""


def is_short(num_scans: int) -> bool:
    """Whether so little is to be done that compiling it takes longer than doing it."""
    return num_scans <= SHORT_WORK


@cache
def quick_options(optimised: bool = True) -> dict[str, Any]:
    """Options of XLA that take its older code generator for fused operations on CPUs.

    What it compiles is equal to rounding. Programs of one robot run as fast or up to a fifth
    slower, gradients of batches a seventh, other programs of batches two to three times.

    Args:
        optimised: False: the machine code is not optimised (`UNOPTIMISED`).

    Returns:
        The options; none on other platforms, where this jaxlib does not know them, and where
        XLA_FLAGS sets one.
    """
    present = os.environ.get("XLA_FLAGS", "")
    options = QUICK if optimised else UNOPTIMISED
    if jax.default_backend() != "cpu" or any(name in present for name in options):
        return {}
    try:
        jax.jit(lambda: np.float32(0), compiler_options=options).lower().compile()
    except RuntimeError:  # an option that this jaxlib does not know
        return {}
    return options
