"""What is loaded when the package, or the first of its names, is imported."""

import subprocess
import sys

import pytest

from experiments import import_time

SLOW = ("scipy.spatial", "scipy.ndimage", "scipy.sparse", "scipy.special", "optax", "matplotlib")


def loaded(code):
    """Names of the modules that a new process has loaded after some code."""
    code += "; import sys; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_the_package_alone_loads_neither_jax_nor_numpy():
    new = loaded("import jaxslam")
    assert "jaxslam" in new and not {"jax", "numpy"} & new


@pytest.mark.parametrize("name", ["Config", "NoiseParams", "Lidar"])
def test_records_of_settings_load_little_but_jax(name):
    new = loaded(f"from jaxslam import {name}")
    assert "jax" in new and not new & set(SLOW)


def test_the_least_time_of_each_import_is_by_that_of_jax(monkeypatch):
    taken = iter([8.0, 1.0, 6.0, 20.0, 5.0, 2.0, 7.0, 10.0])  # two rounds of four
    order = []

    def processor_seconds(code):
        order.append(code)
        return next(taken)

    monkeypatch.setattr(import_time, "processor_seconds", processor_seconds)
    found = import_time.import_vs_jax(rounds=2)
    assert order == 2 * [import_time.JAX, *import_time.IMPORTS]
    assert found == dict(zip(import_time.IMPORTS, (0.2, 1.2, 2.0), strict=True))


def test_code_runs_with_these_sources_in_a_process_that_may_fail():
    assert import_time.processor_seconds("import jaxslam") > 0.0
    with pytest.raises(subprocess.CalledProcessError):
        import_time.processor_seconds("import nothing_of_this_name")
