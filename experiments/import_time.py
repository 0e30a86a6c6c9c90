"""Processor time of imports in new processes, beside that of `import jax`."""

import os
import resource
import subprocess
import sys
from pathlib import Path

import jaxslam

HOME = Path(next(iter(jaxslam.__path__))).parent
JAX = "import jax"
IMPORTS = ("import jaxslam", "from jaxslam import Config", "from jaxslam import *")
"""Names are imported when they are first used: the package alone, one of them, and all."""


def processor_seconds(code: str) -> float:
    """Processor time [s] of a new process of Python that runs some code.

    Raises:
        subprocess.CalledProcessError: The code fails.
    """
    path = os.pathsep.join(filter(None, [str(HOME), os.environ.get("PYTHONPATH")]))
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", code], check=True, env=os.environ | {"PYTHONPATH": path})
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def import_vs_jax(rounds: int = 10) -> dict[str, float]:
    """Least processor time of each of `IMPORTS`, by that of `import jax`.

    Args:
        rounds: New processes of each, in turns.
    """
    best = dict.fromkeys([JAX, *IMPORTS], float("inf"))
    for _ in range(rounds):
        for code, seconds in best.items():
            best[code] = min(seconds, processor_seconds(code))
    return {code: best[code] / best[JAX] for code in IMPORTS}
