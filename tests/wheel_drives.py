"""Drives of a robot whose wheels, scanner and clocks are off, as spans of scan matching."""

import numpy as np

from jaxslam.core.calibration import calibrate_odometry
from jaxslam.smoothing.odometry_calibration import MotionSpans, unflat

TRUE = unflat(np.array([1.05, 0.97, 0.02, 0.25, 0.05, 0.05, 0.08]))
MATCH_STD = np.array([0.01, 0.01, 0.005])
INTERVAL = 0.5  # s between scans


def drive(rng, steps=300, *, true=TRUE, turning=0.6, match_std=MATCH_STD):
    """Spans from scan to scan: speed and turn rate vary, the wheels have noise of their own.

    Args:
        rng: Random numbers.
        steps: Scans.
        true: Calibration.
        turning: [rad/s] greatest turn rate, about; 0 for a straight drive.
        match_std: (3,) std of scan matching.
    """
    t = np.arange(steps)
    speed = 0.5 + 0.2 * np.sin(t / 7) + 0.05 * rng.normal(size=steps)
    rate = turning * (np.sin(t / 11 + 6 * rng.random()) + 0.2 * rng.normal(size=steps))
    distance, turn = INTERVAL * speed, INTERVAL * rate
    chord = distance * np.sinc(turn / (2 * np.pi))
    reported = np.stack([chord * np.cos(turn / 2), chord * np.sin(turn / 2), turn], axis=1)
    reported[0] = 0.0
    times = INTERVAL * t
    moved = calibrate_odometry(true, reported, times=times, mount=np.zeros(3))
    wheel_std = np.stack([0.01 * np.sqrt(distance)] * 2 + [0.01 * np.sqrt(distance)], axis=1)
    matched = moved + rng.normal(size=moved.shape) * np.hypot(match_std, wheel_std)
    first = np.arange(steps - 1, dtype=np.int32)
    return MotionSpans(
        times=times,
        odometry=reported,
        mount=np.zeros(3),
        first=first,
        last=first + 1,
        increment=matched[1:],
        match_cov=np.tile(np.diag(np.asarray(match_std) ** 2), (steps - 1, 1, 1)),
        driven=np.stack([distance[1:], np.abs(turn[1:])], axis=1),
        usable=np.ones(steps - 1, bool),
    )
