"""Memory of this process, as the system counts it."""

import numpy as np

from jaxslam.core.memory import memory_now, peak_memory, release_memory


def test_what_is_held_counts_and_the_most_of_it_stays():
    before = memory_now()
    held = np.ones(12_000_000)  # 96 MB
    assert memory_now() - before > 80.0
    most = peak_memory()
    assert most >= memory_now() - 1.0
    del held
    release_memory()
    assert peak_memory() >= most - 1.0  # the system counts in steps
