import gc
import os
import shutil
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

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

gc.set_threshold(100_000)  # else collecting is a good part of tracing

# What one worker has compiled, the others find in a folder, whose name they inherit.
OWNS_CACHE = "JAX_COMPILATION_CACHE_DIR" not in os.environ
if OWNS_CACHE:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="compiled-")
jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)


def share_contexts() -> None:
    """Let all programs of a thread be written in one context of MLIR.

    JAX makes one for each program, which takes a quarter of the time of a small one. The function
    is not of JAX's interface: where there is none of this name, nothing is shared.
    """
    from jax._src.interpreters import mlir

    if make := getattr(mlir, "make_ir_context", None):
        of_thread = threading.local()

        def shared(*args: object) -> object:
            if args or not hasattr(of_thread, "context"):
                context = make(*args)
                if args:
                    return context
                of_thread.context = context
            return of_thread.context

        mlir.make_ir_context = shared


share_contexts()

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


# Files whose programs are the same, so that one worker runs them: it compiles them once.
SAME_PROGRAMS = (
    [
        f"tests/pipeline/test_{x}.py"
        for x in ("sessions", "pieces", "reclosing", "self_calibration")
    ],
    [f"tests/cli/test_{x}.py" for x in ("run_logs", "calibrated_logs")],
    [
        f"tests/{x}.py"
        for x in ("simulation/test_trials", "study/test_runner", "experiments/test_monte_carlo")
    ],
)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give each file to one worker, and those with the same programs to the same one."""
    from xdist.scheduler import LoadFileScheduling

    if config.getoption("dist") != "loadfile":
        return None
    leader = {file: files[0] for files in SAME_PROGRAMS for file in files}

    class Scheduler(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = super()._split_scope(nodeid)
            return leader.get(file, file)

    return Scheduler(config, log)


def pytest_unconfigure() -> None:
    """Remove the compiled programs of this run."""
    if OWNS_CACHE:
        shutil.rmtree(os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)


@pytest.fixture(scope="module", autouse=True)
def frozen() -> Iterator[None]:
    """What a module leaves behind, above all traces of JAX, is not looked through again."""
    yield
    gc.freeze()


@pytest.fixture
def single_precision() -> Iterator[None]:
    """Run a test in float32, as users do; the others run in float64."""
    with jax.enable_x64(False):
        yield


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of recorded logs, which are not part of the project."""
    folder = Path(__file__).resolve().parents[1].parent / "shared" / "data"
    if not (folder / "intel" / "intel.clf").is_file():
        pytest.skip("no recorded logs in ../shared/data beside the repository")
    return folder
