"""Ways to find the noise, with a clock: by gradient, at random, by Bayesian optimisation.

All look at the same training runs and start from the noise set by hand. The clock stands still
while the best so far is judged on the held-out runs, and programs are compiled before it starts.
"""

from collections.abc import Callable
from importlib.util import find_spec
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from experiments.common import Numbers
from jaxslam.core.episode import Episode
from jaxslam.evaluation import summary
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.tuning import fitting, parameters
from jaxslam.tuning.fitting import TuneState
from jaxslam.tuning.losses import Loss, pose_nll

WIDE = 30.0  # each parameter is searched within this factor of the one set by hand


class Task(NamedTuple):
    """What the noise is wanted for."""

    config: Config
    hand: NoiseParams  # set by hand; where everything starts
    train: Episode  # [B]
    test: Episode  # [H]
    frozen: tuple[str, ...] = ()


class Trace:
    """The best so far over time and evaluations, judged on the held-out runs."""

    def __init__(self, task: Task):
        """Start the clock."""
        self.points: list[Numbers] = []
        self.evaluations = 0
        self._task, self._stopped, self._since = task, 0.0, perf_counter()
        self._least = np.inf

    @property
    def seconds(self) -> float:
        """Seconds so far, without those of judging."""
        return perf_counter() - self._since - self._stopped

    def add(self, noise: NoiseParams, loss: float) -> None:
        """Note an evaluation of the training runs."""
        self.evaluations += 1
        if not loss < self._least:
            return
        self._least, now, begin = loss, self.seconds, perf_counter()
        told = {"evaluations": self.evaluations, "seconds": now, "loss": loss}
        told["theta"] = parameters.flatten_params(noise)
        self.points.append(told | judge(self._task, noise))
        self._stopped += perf_counter() - begin

    def numbers(self) -> Numbers:
        """All of it."""
        seconds = self.seconds
        return {"points": self.points, "evaluations": self.evaluations, "seconds": seconds}


def judge(task: Task, noise: NoiseParams) -> Numbers:
    """Errors on the held-out runs."""
    told = summary.evaluate(episodes.filter_episodes(task.config, noise, task.test))
    keys = {"position_rmse_m": "heldout_rmse_m", "nees": "nees", "diverged": "diverged"}
    return {new: told[key] for key, new in keys.items()}


def compile_all(task: Task, loss: Loss) -> None:
    """Compile what a search runs."""
    judge(task, task.hand)
    fitting.values(task.config, task.hand, task.train, loss)
    fitting.tune(task.config, task.hand, task.train, loss=loss, num_updates=1)


def by_gradient(task: Task, loss: Loss, steps: int) -> Numbers:
    """`fitting.tune`."""
    trace = Trace(task)
    with tqdm(total=steps + 1, unit="step", leave=False, desc=loss.__name__) as bar:

        def report(state: TuneState) -> None:
            at = int(state.step) - 1
            bar.set_postfix(loss=f"{state.loss[at]:.4g}")
            bar.update()
            trace.add(
                parameters.unflatten_params(state.theta_history[at], task.hand), state.loss[at]
            )

        how = {"loss": loss, "steps": steps, "frozen": task.frozen, "report": report}
        fitting.tune(task.config, task.hand, task.train, **how)
    return trace.numbers()


Ask = Callable[[], np.ndarray]
Tell = Callable[[float], Any]


def at_random(size: int, seed: int) -> tuple[Ask, Tell]:
    """Numbers (size,) drawn uniformly from -1 to 1, but the first, which are 0."""
    rng, first = np.random.default_rng(seed), iter([np.zeros(size)])
    return lambda: next(first, rng.uniform(-1.0, 1.0, size)), lambda loss: None


def bayesian(size: int, seed: int) -> tuple[Ask, Tell]:
    """Numbers (size,) from -1 to 1, by Optuna's tree-structured Parzen estimator; the first 0."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed))
    names = [f"x{i}" for i in range(size)]
    study.enqueue_trial(dict.fromkeys(names, 0.0))
    under_way = []

    def ask() -> np.ndarray:
        under_way.append(study.ask())
        return np.array([under_way[0].suggest_float(name, -1.0, 1.0) for name in names])

    def tell(loss: float) -> None:
        failed = optuna.trial.TrialState.FAIL
        trial = under_way.pop()
        study.tell(trial, loss) if np.isfinite(loss) else study.tell(trial, state=failed)

    return ask, tell


METHODS = {"random": at_random, "bayesian": bayesian}
NEEDS = {"bayesian": "optuna"}


def methods() -> list[str]:
    """Names of the searches whose libraries are there; tells of the others."""
    missing = {name for name, library in NEEDS.items() if find_spec(library) is None}
    for name in sorted(missing):
        print(f"left out: {name}, as {NEEDS[name]} is missing; pip install '.[bench]'")
    return [name for name in METHODS if name not in missing]


def by_search(task: Task, method: str, seed: int, seconds: float, least: int) -> Numbers:
    """Search for at least so many seconds and evaluations."""
    moves = parameters.trainable_mask(task.hand, task.frozen)
    ask, tell = METHODS[method](int(moves.sum()), seed)
    hand = parameters.flatten_params(task.hand)
    trace = Trace(task)
    with tqdm(total=round(seconds), unit="s", leave=False, desc=method) as bar:
        while trace.seconds < seconds or trace.evaluations < least:
            theta = hand.copy()
            theta[moves] += np.log(WIDE) * ask()
            noise = parameters.unflatten_params(theta, task.hand)
            values = fitting.values(task.config, noise, task.train, pose_nll)
            # A noise with which a run gives no number is no candidate.
            loss = float(values.mean()) if np.isfinite(values).all() else np.inf
            tell(loss)
            trace.add(noise, loss)
            bar.update(min(round(trace.seconds), bar.total) - bar.n)
    return trace.numbers()


def best_by(trace: Numbers, **limit: float) -> Numbers:
    """The last point of a trace within a limit of `seconds` or `evaluations`."""
    ((key, most),) = limit.items()
    within = [point for point in trace["points"] if point[key] <= most]
    return (within or trace["points"][:1])[-1]


def time_to(trace: Numbers, error: float) -> float | None:
    """Seconds until the held-out error was no larger than this; None: it never was."""
    times = [p["seconds"] for p in trace["points"] if (p["heldout_rmse_m"] or np.inf) <= error]
    return times[0] if times else None
