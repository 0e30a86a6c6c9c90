"""Wheels against scan matching as a model to tune: calibration and noise, without any truth.

A sequence is a piece of a drive, a step one span between keyframes, and its innovation the matched
motion less that of the calibrated wheels (`smoothing.odometry_calibration` has the density). So a
calibration is tuned by gradient, with priors and standard errors, as the noise of the filter is;
pieces of several drives of one robot are tuned together.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.batching import pad_to
from jaxslam.core.calibration import Calibration
from jaxslam.core.types import Array
from jaxslam.smoothing.calibration_noise import NOISE_LOG_STD, CalibrationNoise, log_density
from jaxslam.smoothing.odometry_calibration import (
    DETERMINED,
    CalibrationEstimate,
    MotionSpans,
    default_prior_std,
    flat,
    motion_error,
    unflat,
)
from jaxslam.tuning import fitting, standard_errors
from jaxslam.tuning.model import Model
from jaxslam.tuning.priors import Prior
from jaxslam.tuning.transforms import POSITIVE, real

NUM_PIECES = 16
"""Of all drives, at least: they are the independent sequences of the standard errors."""

MARGIN = 20
"""Scans before and after a piece, for odometry whose clock is ahead or behind."""


class CalibrationParams(NamedTuple):
    """What is tuned.

    Attributes:
        calibration: Of the robot.
        noise: What is left of the difference of wheels and scans.
    """

    calibration: Calibration
    noise: CalibrationNoise


class SpanInfo(NamedTuple):
    """Diagnostics of a step, as those of the filter's that losses need.

    Attributes:
        log_likelihood: () log density of the matched motion.
        dof: () int32 numbers that it is of; 0 if the span is not usable.
        nis: () its squared Mahalanobis distance from that of the wheels.
    """

    log_likelihood: Array
    dof: Array
    nis: Array


def _init(params: CalibrationParams, spans: MotionSpans) -> Array:
    """No state: the spans are independent."""
    del params
    return jnp.zeros((), spans.odometry.dtype)


def _inputs(params: CalibrationParams, spans: MotionSpans) -> tuple[Array, ...]:
    """Error, motion, covariance and use of each span, [N]."""
    error = motion_error(params.calibration, spans)
    error = jnp.where(spans.usable[:, None], error, 0.0)
    return error, spans.driven, spans.match_cov, spans.usable


def _step(
    params: CalibrationParams, state: Array, now: tuple[Array, ...]
) -> tuple[Array, SpanInfo]:
    """The density of one span."""
    *of_span, usable = now
    density, square = log_density(params.noise, *of_span)
    dof = jnp.where(usable, 3, 0).astype(jnp.int32)
    return state, SpanInfo(jnp.where(usable, density, 0.0), dof, jnp.where(usable, square, 0.0))


CALIBRATION_MODEL = Model(_init, _step, _inputs)


def span_nll(info: SpanInfo, spans: MotionSpans) -> Array:
    """Negative log density [nats] of a piece, per span of the longest piece.

    So pieces count by their number of spans, and the prior as it should.
    """
    return -jnp.sum(info.log_likelihood) / spans.usable.shape[0]


def cut_into_pieces(drives: Sequence[MotionSpans], num_pieces: int = NUM_PIECES) -> MotionSpans:
    """Pieces [B] of drives, of about as many spans each, padded; B is `num_pieces` or a few more.

    Args:
        drives: NumPy, each with a span.
        num_pieces: Least number of pieces, if there are as many spans.
    """
    total = sum(len(spans.usable) for spans in drives)
    longest = max(total // num_pieces, 1)
    pieces, timed = [], all(spans.times is not None for spans in drives)
    for spans in drives:
        count = -(-len(spans.usable) // longest)
        for part in np.array_split(np.arange(len(spans.usable)), count):
            begin = max(int(spans.first[part[0]]) - MARGIN, 0)
            end = int(spans.last[part[-1]]) + 1 + MARGIN
            some = slice(int(part[0]), int(part[-1]) + 1)
            by_span = {
                name: getattr(spans, name)[some]
                for name in ("increment", "match_cov", "driven", "usable")
            }
            pieces.append(
                spans._replace(
                    times=spans.times[begin:end] - spans.times[begin] if timed else None,
                    odometry=spans.odometry[begin:end],
                    first=spans.first[some] - begin,
                    last=spans.last[some] - begin,
                    **by_span,
                )
            )
    scans = max(len(piece.odometry) for piece in pieces)
    spans_each = max(len(piece.usable) for piece in pieces)
    padded = [_padded(piece, scans, spans_each) for piece in pieces]
    return jax.tree.map(lambda *x: np.stack(x), *padded)


def _padded(piece: MotionSpans, scans: int, spans: int) -> MotionSpans:
    """A piece of as many scans, at rest after its end, and spans, which are not usable."""
    odometry = np.zeros((scans, 3))
    odometry[: len(piece.odometry)] = piece.odometry
    usable = np.zeros(spans, bool)
    usable[: len(piece.usable)] = piece.usable
    names = "first", "last", "increment", "match_cov", "driven"
    by_span = {name: pad_to(getattr(piece, name), to=spans) for name in names}
    times = None if piece.times is None else pad_to(piece.times, to=scans)
    return piece._replace(times=times, odometry=odometry, usable=usable, **by_span)


def _transforms() -> Calibration:
    """Numbers in units in which a standard error of 1 is that of what is not determined.

    They are small for scales, too, whose logarithms would be changed by more than is known of them.
    """
    units = (DETERMINED * np.asarray(x, float) for x in default_prior_std())
    return Calibration._make(
        real(float(x)) if np.ndim(x) == 0 else real(tuple(x.tolist())) for x in units
    )


def tune_calibration(
    drives: Sequence[MotionSpans], start: CalibrationEstimate, *, num_updates: int = 20
) -> CalibrationEstimate:
    """The calibration of one robot by several drives, with standard errors over their pieces.

    Args:
        drives: Spans of each drive, NumPy.
        start: Estimate of one of them, from which the optimiser starts.
        num_updates: Of the optimiser.

    Raises:
        ValueError: There are fewer than two spans.
    """
    data = cut_into_pieces(drives)
    if len(data.usable) < 2:
        raise ValueError("a calibration with standard errors needs two spans between keyframes")
    frozen: tuple[str, ...] = ()
    if data.times is None:
        frozen = ("calibration.time_offset",)
    params: Any = CalibrationParams(start.calibration, start.noise)
    typical, std = CalibrationNoise.typical(), default_prior_std()
    of_noise = [Prior(x, NOISE_LOG_STD * x) for x in typical]
    of_calibration = map(Prior, Calibration.identity(), std)
    prior = CalibrationParams(Calibration._make(of_calibration), CalibrationNoise._make(of_noise))
    options: dict[str, Any] = {
        "loss": span_nll,
        "transforms": CalibrationParams(_transforms(), POSITIVE),  # type: ignore[arg-type]
        "prior": prior,
        "frozen": frozen,
    }
    found = fitting.tune(CALIBRATION_MODEL, params, data, num_updates=num_updates, **options).params
    sure = standard_errors.standard_errors(CALIBRATION_MODEL, found, data, **options).of_params
    numbers, prior_std = flat(found.calibration), flat(std)
    errors = np.nan_to_num(flat(sure.calibration), nan=0.0, posinf=np.inf)
    if frozen:
        prior_std[-1] = 0.0
    noise = CalibrationNoise._make(np.asarray(x, np.float64) for x in found.noise)
    return CalibrationEstimate(
        unflat(numbers),
        unflat(np.minimum(errors, prior_std)),
        unflat(prior_std),
        noise,
        int(np.count_nonzero(data.usable)),
    )
