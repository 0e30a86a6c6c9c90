"""The whole chain of trials as one program for an accelerator; it is lowered, and not compiled."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.programs import trials_program
from jaxslam.frontend.extract import SCAN_BATCH
from jaxslam.pipeline.episodes import EPISODE_BATCH

TRIALS = 4096
CALLBACK = re.compile(r"custom_call @(\S*callback\S*?)\(")


def lowered(function, *arguments):
    """StableHLO for CUDA, of a host that need not have it."""
    with jax.default_device("gpu"):
        traced = jax.jit(function).trace(*arguments)
    return traced.lower(lowering_platforms=("cuda",)).as_text()


@pytest.mark.parametrize("life", [False, True])
def test_thousands_of_trials_are_one_program_without_calls_of_the_host(life, single_precision):
    program = trials_program(life=life, num_trials=TRIALS)
    text = lowered(program.function, *program.arguments)
    assert not CALLBACK.search(text)
    trials, scans = EPISODE_BATCH.accelerator, SCAN_BATCH.accelerator
    # Scans of all trials of a batch, some of each, are cast and segmented together.
    assert f"tensor<{trials}x{scans // trials}x361xf32>" in text
    assert f"tensor<{TRIALS // trials}x{trials}x" in text


@pytest.mark.parametrize("call", [jax.pure_callback, jax.experimental.io_callback])
def test_a_call_of_the_host_would_be_found(call):
    def function(x):
        return call(np.sin, jax.ShapeDtypeStruct(x.shape, x.dtype), x)

    assert CALLBACK.search(jax.jit(function).lower(jnp.zeros(3)).as_text())
    with pytest.raises((ValueError, NotImplementedError)):  # without the accelerator
        lowered(function, jnp.zeros(3))
