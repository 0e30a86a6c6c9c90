"""The SLAM filter with the systematic errors of the robot beside its noise, as a model to tune.

    odometry as reported  --calibrate_odometry-->  increments of the scanner  -->  SLAM filter

Wrong scales, a wrong mount or a wrong clock make innovations large in one direction, which noise
can only allow for. So the innovations' likelihood determines both, and no truth is needed; what the
drives do not determine, as the mount on a straight line, `standard_errors` names.

The process noise is that of `motion_model.odometry_cov` along the calibrated increments, at the
scanner: what a turn that errs moves a scanner far from the wheels by is not part of it.
"""

import math
from functools import lru_cache
from typing import Any, NamedTuple, cast

import jax.numpy as jnp
import numpy as np

from jaxslam.core.arguments import as_float
from jaxslam.core.calibration import Calibration, calibrate_odometry
from jaxslam.core.episode import Episode, measurements_of
from jaxslam.core.measurement import Measurement
from jaxslam.core.types import check_type
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.noise import NoiseParams
from jaxslam.filtering.slam_filter import StepInfo
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.episodes import EPISODE_BATCH
from jaxslam.tuning.model import Model
from jaxslam.tuning.priors import Prior
from jaxslam.tuning.slam_model import SlamCheck, SlamInit, SlamStep

SHAPES = {"mount": (3,)}  # of fields that are no scalars


class CalibratedParams(NamedTuple):
    """What is tuned of a robot.

    Attributes:
        noise: Q and R that the filter assumes.
        calibration: Systematic errors.
    """

    noise: NoiseParams
    calibration: Calibration


def default_prior() -> CalibratedParams:
    """Priors of the calibration of a robot that was built with care; none of the noise.

    Scales within 5 %, drift within 0.1 rad/m, the mount within 10 cm and 0.05 rad of where it was
    taken to be, clocks within 0.1 s.
    """
    mount = Prior(0.0, np.array([0.1, 0.1, 0.05]))
    own = Prior(1.0, 0.05), Prior(1.0, 0.05), Prior(0.0, 0.1), mount, Prior(0.0, 0.1)
    return CalibratedParams(*cast(Any, (None, Calibration(*cast(Any, own)))))


class _Step(NamedTuple):
    """`Model.step`: that of the SLAM filter, by the noise."""

    noise: SlamStep

    def __call__(
        self, params: CalibratedParams, belief: Belief, now: Measurement
    ) -> tuple[Belief, StepInfo]:
        return cast(Any, self.noise)(params.noise, belief, now)


class _Inputs(NamedTuple):
    """`Model.inputs`: measurements [T] with increments of the scanner, calibrated."""

    scan_period: float | None
    wheel_base: float

    def __call__(self, params: CalibratedParams, episode: Episode) -> Measurement:
        return measurements_of(
            calibrate_episode(
                params.calibration,
                episode,
                scan_period=self.scan_period,
                wheel_base=self.wheel_base,
            )
        )


class _Check(NamedTuple):
    """`Model.check`: of the calibration, and of the rest as the SLAM filter does."""

    noise: SlamCheck

    def __call__(
        self, params: CalibratedParams, episodes: Any, name: str
    ) -> tuple[CalibratedParams, Episode]:
        check_type("params", params, CalibratedParams)
        check_type("params.calibration", params.calibration, Calibration)
        calibration = Calibration(
            *(
                as_float(f"params.calibration.{field}", x, SHAPES.get(field, ()))
                for field, x in params.calibration._asdict().items()
            )
        )
        noise, stacked = cast(Any, self.noise)(params.noise, episodes, name)
        return CalibratedParams(noise, calibration), stacked


def calibrate_episode(
    calibration: Calibration,
    episode: Episode,
    *,
    scan_period: float | None = None,
    wheel_base: float = 0.0,
) -> Episode:
    """An episode whose odometry has no systematic errors any more; the rest is as it was.

    Args:
        calibration: The robot's.
        episode: One drive, its odometry as reported.
        scan_period: [s] from a scan to the next; None: the time offset is not used.
        wheel_base: [m] between the wheels, as the odometry assumes (`calibrate_odometry`).
    """
    count = episode.odometry.shape[0]
    times = None
    if scan_period is not None:
        times = scan_period * jnp.arange(count, dtype=episode.odometry.dtype)
    odometry = calibrate_odometry(calibration, episode.odometry, times=times, wheel_base=wheel_base)
    return episode._replace(odometry=odometry)


def calibrated_slam_model(
    config: Config, *, scan_period: float | None = None, wheel_base: float = 0.0
) -> Model:
    """The SLAM filter on calibrated odometry, as a model with `CalibratedParams`.

    Args:
        config: Its filter is the one that runs.
        scan_period: [s] from a scan to the next; None: the time offset is not used, and counts as
            not determined.
        wheel_base: [m] between the wheels, as the odometry assumes; 0 for unknown.

    Raises:
        ValueError: A number is not possible.
    """
    if scan_period is not None and not 0.0 < scan_period < math.inf:
        raise ValueError(f"scan_period is {scan_period!r}, not above 0")
    if not 0.0 <= wheel_base < math.inf:
        raise ValueError(f"wheel_base is {wheel_base!r}, not 0 or more")
    return _model(config, None if scan_period is None else float(scan_period), float(wheel_base))


@lru_cache
def _model(config: Config, scan_period: float | None, wheel_base: float) -> Model:
    """`calibrated_slam_model`, the same object for the same arguments."""
    own = config.filter
    inputs = _Inputs(scan_period, wheel_base)
    functions = SlamInit(own), _Step(SlamStep(own)), inputs, _Check(SlamCheck(own))
    # mypy does not see that a NamedTuple can be called.
    return Model(*cast(Any, functions))._replace(batch_size=EPISODE_BATCH)
