"""Methods that find noise parameters, on a clock: by gradient, at random, by Bayesian optimisation.

All use the same training drives and start from the hand-set noise. The clock is stopped while the
best parameters so far are evaluated on the held-out drives, and programs are compiled before it
starts.
"""

from collections.abc import Callable
from importlib.util import find_spec
from time import perf_counter
from typing import Any, NamedTuple, Protocol

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

SEARCH_FACTOR = 30.0  # each parameter is searched within this factor of the hand-set one


class Task(NamedTuple):
    """Drives and filter whose noise parameters are to be found.

    Attributes:
        config: Of the filter.
        hand: Hand-set noise, where everything starts.
        train: Training drives [B].
        test: Held-out drives [H].
        frozen: Names of parameters that stay as they are.
    """

    config: Config
    hand: NoiseParams
    train: Episode
    test: Episode
    frozen: tuple[str, ...] = ()


class Trace:
    """The best result so far over time and evaluations, evaluated on the held-out drives."""

    def __init__(self, task: Task):
        """Start the clock."""
        self.points: list[Numbers] = []
        self.evaluations = 0
        self._task, self._stopped, self._since = task, 0.0, perf_counter()
        self._best_loss = np.inf

    @property
    def seconds(self) -> float:
        """Seconds so far, without those of held-out evaluation."""
        return perf_counter() - self._since - self._stopped

    def add(self, params: NoiseParams, loss: float) -> None:
        """Record an evaluation of the training drives."""
        self.evaluations += 1
        if not loss < self._best_loss:
            return
        self._best_loss, now, begin = loss, self.seconds, perf_counter()
        point = {"evaluations": self.evaluations, "seconds": now, "loss": loss}
        point["theta"] = parameters.flatten_params(params)
        self.points.append(point | evaluate_heldout(self._task, params))
        self._stopped += perf_counter() - begin

    def numbers(self) -> Numbers:
        """All points, and the totals."""
        seconds = self.seconds
        return {"points": self.points, "evaluations": self.evaluations, "seconds": seconds}


def evaluate_heldout(task: Task, params: NoiseParams) -> Numbers:
    """Errors on the held-out drives."""
    found = summary.evaluate(episodes.filter_episodes(task.config, params, task.test))
    keys = {"position_rmse_m": "heldout_rmse_m", "nees": "nees", "diverged": "diverged"}
    return {new: found[key] for key, new in keys.items()}


def compile_all(task: Task, loss: Loss) -> None:
    """Compile the programs of a search."""
    evaluate_heldout(task, task.hand)
    fitting.values(task.config, task.hand, task.train, loss)
    fitting.tune(task.config, task.hand, task.train, loss=loss, num_updates=1)


def by_gradient(task: Task, loss: Loss, num_updates: int) -> Numbers:
    """Trace of `fitting.tune`."""
    trace = Trace(task)
    with tqdm(total=num_updates + 1, unit="update", leave=False, desc=loss.__name__) as bar:

        def callback(state: TuneState) -> None:
            last = int(state.step) - 1
            bar.set_postfix(loss=f"{state.loss[last]:.4g}")
            bar.update()
            params = parameters.unflatten_params(state.theta_history[last], task.hand)
            trace.add(params, state.loss[last])

        fitting.tune(
            task.config,
            task.hand,
            task.train,
            loss=loss,
            num_updates=num_updates,
            frozen=task.frozen,
            callback=callback,
        )
    return trace.numbers()


class Sampler(Protocol):
    """A search method: proposes points (size,) in [-1, 1] and is given their losses."""

    def propose(self) -> np.ndarray:
        """The next point; the first is 0."""

    def observe(self, loss: float) -> None:
        """Take the loss of the last point."""


class RandomSampler:
    """Points drawn uniformly, except the first."""

    def __init__(self, size: int, seed: int):
        """Start the generator."""
        self._size, self._random = size, np.random.default_rng(seed)
        self._first = True

    def propose(self) -> np.ndarray:
        """The next point."""
        point = self._random.uniform(-1.0, 1.0, self._size)
        first, self._first = self._first, False
        return np.zeros(self._size) if first else point

    def observe(self, loss: float) -> None:
        """Ignore the loss."""


class BayesianSampler:
    """Optuna's tree-structured Parzen estimator."""

    def __init__(self, size: int, seed: int):
        """Start a study.

        Raises:
            ImportError: Optuna is not installed.
        """
        import optuna

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._failed = optuna.trial.TrialState.FAIL
        self._study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed))
        self._names = [f"x{i}" for i in range(size)]
        self._study.enqueue_trial(dict.fromkeys(self._names, 0.0))
        self._trial: Any = None

    def propose(self) -> np.ndarray:
        """The next point."""
        self._trial = self._study.ask()
        return np.array([self._trial.suggest_float(name, -1.0, 1.0) for name in self._names])

    def observe(self, loss: float) -> None:
        """Take the loss; a point without a finite loss has failed."""
        study = self._study
        if np.isfinite(loss):
            study.tell(self._trial, loss)
        else:
            study.tell(self._trial, state=self._failed)


METHODS: dict[str, Callable[[int, int], Sampler]] = {
    "random": RandomSampler,
    "bayesian": BayesianSampler,
}
NEEDS = {"bayesian": "optuna"}


def available_methods() -> list[str]:
    """Names of the searches whose libraries are installed; prints the others."""
    missing = {name for name, library in NEEDS.items() if find_spec(library) is None}
    for name in sorted(missing):
        print(f"left out: {name}, as {NEEDS[name]} is missing; pip install '.[bench]'")
    return [name for name in METHODS if name not in missing]


def by_search(task: Task, method: str, seed: int, seconds: float, evaluations: int) -> Numbers:
    """Search for at least so many seconds and evaluations."""
    trainable = parameters.trainable_mask(task.hand, task.frozen)
    sampler = METHODS[method](int(trainable.sum()), seed)
    hand = parameters.flatten_params(task.hand)
    trace = Trace(task)
    with tqdm(total=round(seconds), unit="s", leave=False, desc=method) as bar:
        while trace.seconds < seconds or trace.evaluations < evaluations:
            theta = hand.copy()
            theta[trainable] += np.log(SEARCH_FACTOR) * sampler.propose()
            params = parameters.unflatten_params(theta, task.hand)
            values = fitting.values(task.config, params, task.train, pose_nll)
            # Parameters with which a drive is not finite are no candidate.
            loss = float(values.mean()) if np.isfinite(values).all() else np.inf
            sampler.observe(loss)
            trace.add(params, loss)
            bar.update(min(round(trace.seconds), bar.total) - bar.n)
    return trace.numbers()


def last_within(trace: Numbers, key: str, limit: float) -> Numbers:
    """The last point of a trace whose `key` (`seconds` or `evaluations`) is within a limit."""
    within = [point for point in trace["points"] if point[key] <= limit]
    return (within or trace["points"][:1])[-1]


def time_to(trace: Numbers, error: float) -> float | None:
    """Seconds until the held-out error was at most `error`; None if it never was."""
    times = [p["seconds"] for p in trace["points"] if (p["heldout_rmse_m"] or np.inf) <= error]
    return times[0] if times else None
