"""The rotation that scans see, compared with that of the wheels: is a clock off, or a sign wrong?

Readings of two scans are shifted against each other, beam by beam, until they agree. That is too
coarse to drive by, but over a log it shows whether the odometry turns when the scans do.
"""

import numpy as np

from jaxslam.io.clocks import offset_note

INTERVAL = 0.3  # [s] between the scans that are compared, at least
MAX_TURN = 0.7  # [rad] between them that is looked for
MIN_STEP = 0.017  # [rad] between the beams that are compared
MAX_RANGE = 10.0  # [m] from which on readings are taken as equal
MAX_PAIRS = 3000  # pairs of scans at most
MIN_PAIRS = 40  # pairs that are needed, at which the robot turns
MIN_TURNING = 0.02  # [rad] standard deviation of the turns that are needed
MAX_OFFSET, OFFSET_STEP = 12.0, 0.05  # [s] clock offsets that are looked for
MIN_OFFSET = 0.5  # [s] that is corrected: less may be a delay, and the scans can do with it
CLEAR, MARGIN = 0.8, 0.2  # correlation of the best offset, and how much better it is than none


def compare_rotations(
    scan_times: np.ndarray,
    ranges: np.ndarray,
    step: float,
    odom_times: np.ndarray,
    headings: np.ndarray,
) -> tuple[float, list[str]]:
    """Compare the turns of T scans of R beams with those of N poses.

    Args:
        scan_times: (T,) [s].
        ranges: (T, R) [m], counter-clockwise; infinite where there is no return.
        step: [rad] between beams.
        odom_times: (N,) [s], ascending.
        headings: (N,) [rad] by odometry.

    Returns:
        How far the times of the scans are behind [s], 0 unless another offset is clearly better;
        and a note if it is, or if the odometry turns the other side.
    """
    if len(scan_times) <= MIN_PAIRS:
        return 0.0, []
    stride = int(np.ceil(INTERVAL / max(float(np.median(np.diff(scan_times))), 1e-2)))
    kept = np.arange(0, len(scan_times), max(stride, 1))[: MAX_PAIRS + 1]
    start, stop = scan_times[kept[:-1]], scan_times[kept[1:]]
    usable = (stop > start) & (stop - start < 10 * INTERVAL)
    if usable.sum() < MIN_PAIRS:
        return 0.0, []
    turns = turns_between(ranges[kept], step)[usable]
    start, stop = start[usable], stop[usable]
    if np.std(turns) < MIN_TURNING:
        return 0.0, []
    unwrapped = np.unwrap(headings)

    def correlation(offset: float) -> float:
        inside = (start + offset >= odom_times[0]) & (stop + offset <= odom_times[-1])
        if inside.sum() < max(MIN_PAIRS, 0.5 * len(turns)):
            return 0.0
        first, last = (np.interp(t[inside] + offset, odom_times, unwrapped) for t in (start, stop))
        wheels, scans = last - first, turns[inside]
        deviation = np.std(wheels) * np.std(scans)
        product = np.mean((wheels - wheels.mean()) * (scans - scans.mean()))
        return float(product / deviation) if deviation > 0.0 else 0.0

    at_zero = correlation(0.0)
    if at_zero < -CLEAR:
        question = "is the scanner upside down? --upside-down settles it"
        return 0.0, [f"scans turn against the odometry: {question}"]
    offsets = np.arange(-MAX_OFFSET, MAX_OFFSET + OFFSET_STEP / 2, OFFSET_STEP)
    correlations = np.array([correlation(offset) for offset in offsets])
    best = int(np.argmax(correlations))
    offset = float(offsets[best])
    is_clear = correlations[best] > max(CLEAR, at_zero + MARGIN)
    if not is_clear or abs(offset) < MIN_OFFSET:
        return 0.0, []
    return offset, [offset_note(offset, "the turns that both see")]


def turns_between(ranges: np.ndarray, step: float) -> np.ndarray:
    """Turn (T - 1,) [rad] of the scanner between T scans (T, R) whose beams are `step` apart."""
    stride = max(1, round(MIN_STEP / step))
    seen = np.minimum(ranges[:, ::stride], MAX_RANGE)
    step = step * stride
    count = seen.shape[1]
    is_full = count * step > 2 * np.pi - 1.5 * step
    most = min(int(MAX_TURN / step), count // 3)
    shifts = np.arange(-most, most + 1)
    before, after = seen[:-1], seen[1:]
    cost = np.empty((len(shifts), len(before)))
    for row, shift in enumerate(shifts):
        if is_full:
            difference = np.roll(before, -shift, axis=1) - after
        else:
            difference = (
                before[:, max(shift, 0) : count + min(shift, 0)]
                - after[:, max(-shift, 0) : count + min(-shift, 0)]
            )
        cost[row] = np.mean(np.minimum(np.abs(difference), 1.0), axis=1)
    return step * shifts[np.argmin(cost, axis=0)]
