"""Calibration by `tune` and in closed form on the same drives: part of `experiments.tuning`.

The robot is that of `experiments.calibration`, which looks at starts and standard errors. The
closed form is given the true motion of the scanner, which `tune` is not: it has the measurements of
landmarks, and the innovations' likelihood as its loss. The closed form knows no noise. So there is
a row with the noise that was set by hand, and one with the noise that is tuned for it.
"""

from functools import partial
from time import perf_counter

import jax
import numpy as np

from experiments import calibration, calibration_drives, common
from jaxslam.core.episode import Episode
from jaxslam.tuning import fitting
from jaxslam.tuning.calibrated import CalibratedParams

LOSS = "innovation_nll"


def compute(
    seed: int, num_trials: int, num_heldout: int, cache: common.ResultCache
) -> list[common.Numbers]:
    """A row for each method: errors on held-out drives, the calibration, seconds of finding it."""
    key = jax.random.key(seed)
    total = num_trials + num_heldout
    drives = calibration_drives.drives(key, calibration_drives.HURT, num_trials=total)
    train = common.take(drives, slice(num_trials))
    test = common.take(drives, slice(num_trials, None))
    known = {
        "truth": calibration.true_params(),
        "hand": calibration.uncalibrated(),
    }
    rows = [_row(method, params, 0.0, test) for method, params in known.items()]
    for name, make in (("noise alone", _noise_alone), ("closed form", _closed_form)):
        rows += cache(f"calibration {name}", partial(make, train, test))["rows"]
    return [*rows, cache("calibration gradient", partial(_gradient, train, test))]


def _noise_alone(train: Episode, test: Episode) -> common.Numbers:
    """No calibration, and the noise tuned for that."""
    hand = calibration.uncalibrated()
    _compile(hand, train)
    begin = perf_counter()
    params = _tune_noise(hand, train)
    return {"rows": [_row("noise by gradient", params, perf_counter() - begin, test)]}


def _closed_form(train: Episode, test: Episode) -> common.Numbers:
    """The closed form, with the noise set by hand, and tuned."""
    hand = calibration.uncalibrated()
    _compile(hand, train)
    begin = perf_counter()
    own = hand._replace(calibration=calibration.closed_form_of(train))
    seconds = perf_counter() - begin
    params = _tune_noise(own, train)
    both = perf_counter() - begin
    rows = [("closed form", own, seconds), ("closed form, noise by gradient", params, both)]
    return {"rows": [_row(*row, test) for row in rows]}


def _tune_noise(params: CalibratedParams, train: Episode) -> CalibratedParams:
    updates = calibration.UNCALIBRATED_UPDATES
    options = {"loss": LOSS, "num_updates": updates, "frozen": ("calibration",)}
    return fitting.tune(calibration.MODEL, params, train, **options).params


def _gradient(train: Episode, test: Episode) -> common.Numbers:
    """Calibration and noise by `tune`."""
    hand = calibration.uncalibrated()
    _compile(hand, train)
    begin = perf_counter()
    params = calibration.approach(LOSS, hand, train)
    return _row("gradient", params, perf_counter() - begin, test)


def _compile(params: CalibratedParams, train: Episode) -> None:
    """Compile the programs, before the clock starts."""
    fitting.tune(calibration.MODEL, params, train, loss=LOSS, num_updates=1)
    calibration.closed_form_of(train)


def _row(method: str, params: CalibratedParams, seconds: float, test: Episode) -> common.Numbers:
    """Errors on held-out drives, and what was found less what is true."""
    truth = calibration.true_params().calibration
    error = jax.tree.map(lambda x, y: np.asarray(x - y), params.calibration, truth)
    found = calibration.heldout(params, test)
    return {
        "data": "calibration",
        "method": method,
        **found,
        "seconds": seconds,
        "calibration": params.calibration._asdict(),
        "error": error._asdict(),
    }
