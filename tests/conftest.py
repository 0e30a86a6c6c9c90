import os
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest

# Most of the time of these tests is XLA's compiler, and what they run is small. The old emitters
# take half of its time, and a program in one piece less than in several, the cores being busy;
# both flags may go with a next version, and an unknown flag ends the process.
FLAGS = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
FLAGS += " --xla_force_host_platform_device_count=2"
OLD = " --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
OLD = OLD if jax.__version_info__ < (0, 11) else ""
os.environ.setdefault("XLA_FLAGS", FLAGS + OLD)

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture(params=["float64", "float32"])
def precision(request) -> Iterator[str]:
    """Run a test twice: in float64, as all tests are, and in float32, as users are."""
    with jax.enable_x64(request.param == "float64"):
        yield request.param


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of recorded logs, which are not part of the project."""
    folder = Path(__file__).resolve().parents[1].parent / "shared" / "data"
    if not (folder / "intel" / "intel.clf").is_file():
        pytest.skip("no recorded logs in ../shared/data beside the repository")
    return folder
