import os
from pathlib import Path

# Most of the time of these tests is XLA's optimiser, and what they run is small.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")

import jax  # noqa: E402, as the flag must be set first
import pytest  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of recorded logs, which are not part of the project."""
    folder = Path(__file__).resolve().parents[1].parent / "shared" / "data"
    if not (folder / "intel" / "intel.clf").is_file():
        pytest.skip("no recorded logs in ../shared/data beside the repository")
    return folder
