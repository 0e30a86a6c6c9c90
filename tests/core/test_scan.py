import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.scan import Lidar, Scan, as_scan, check_lidar

SMALL = Lidar(num_beams=3)


@pytest.mark.parametrize(
    "lidar, message",
    [
        (SMALL._replace(num_beams=1), "lidar.num_beams is 1, not an integer of at least 2"),
        (SMALL._replace(num_beams=2.5), "lidar.num_beams is 2.5, not an integer of at least 2"),
        (SMALL._replace(angle_increment=0.0), "lidar.angle_increment is 0.0, not above 0"),
        (SMALL._replace(angle_increment=-0.1), "lidar.angle_increment is -0.1, not above 0"),
        (SMALL._replace(range_max=0.0), "lidar.range_max is 0.0, not above 0"),
        (SMALL._replace(range_max=np.inf), "lidar.range_max is inf, not a finite number"),
        (SMALL._replace(angle_min=np.nan), "lidar.angle_min is nan, not a finite number"),
        (SMALL._replace(range_std=-0.1), "lidar.range_std is -0.1, which is below 0"),
        (SMALL._replace(range_max="10"), "lidar.range_max is <U2 (), not numbers"),
        (None, "lidar is a NoneType, not a Lidar"),
    ],
)
def test_an_impossible_scanner_is_refused(lidar, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        check_lidar(lidar)


def test_possible_scanners_pass():
    for lidar in (
        Lidar(),
        SMALL,
        SMALL._replace(range_std=0),
        SMALL._replace(num_beams=np.int64(7)),
    ):
        check_lidar(lidar)


def _single(x):
    x = np.asarray(x)
    return x if x.dtype == bool else x.astype(np.float32)


@pytest.mark.parametrize("kind", [list, np.asarray, _single, jnp.asarray])
def test_scans_of_lists_and_arrays_are_the_same(kind):
    scan = as_scan(SMALL, Scan(kind([1.0, 10.0, 2.5]), kind([True, False, True])))
    assert isinstance(scan.ranges, jax.Array) and isinstance(scan.hit, jax.Array)
    assert scan.ranges.dtype == jnp.float64 and scan.hit.dtype == bool
    assert scan.ranges.tolist() == [1.0, 10.0, 2.5] and scan.hit.tolist() == [True, False, True]


@pytest.mark.parametrize(
    "scan, message",
    [
        (np.zeros(3), "scan is a ndarray, not a Scan"),
        (Scan(np.zeros(4), np.ones(4, bool)), "scan.ranges is float64 (4,), not floating (3,)"),
        (Scan(np.zeros(3), np.ones(4, bool)), "scan.hit is bool (4,), not bool (3,)"),
        (Scan(np.zeros(3), np.ones(3)), "scan.hit is float64 (3,), not bool (3,)"),
    ],
)
def test_scans_of_another_scanner_are_refused(scan, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        as_scan(SMALL, scan)
