import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.arguments import as_bool, as_float, check_covariance
from jaxslam.core.types import as_float64, as_size, check_array


@pytest.mark.parametrize(
    "shape, wanted, kind",
    [
        ((), (), None),
        ((3,), (3,), jnp.floating),
        ((0, 2), ("N", 2), float),
        ((5,), (..., 5), None),
        ((7, 6, 5), (..., 6, 5), jnp.inexact),
        ((7, 6), (...,), None),
    ],
)
def test_what_fits_passes(shape, wanted, kind):
    check_array("x", jnp.zeros(shape), wanted, kind)


@pytest.mark.parametrize(
    "shape, wanted, kind, message",
    [
        ((), (3,), None, "x is float64 (), not (3,)"),
        ((3, 1), (3,), None, "x is float64 (3, 1), not (3,)"),
        ((4, 3), ("N", 2), None, "x is float64 (4, 3), not (N, 2)"),
        ((), (..., 2), None, "x is float64 (), not (..., 2)"),
        ((2,), (2,), jnp.integer, "x is float64 (2,), not integer (2,)"),
        ((2,), (2,), jnp.bool_, "x is float64 (2,), not bool (2,)"),
    ],
)
def test_what_does_not_fit_is_named(shape, wanted, kind, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        check_array("x", jnp.zeros(shape), wanted, kind)


def test_it_costs_nothing_at_run_time():
    def checked(x):
        check_array("x", x, ("N", 2), jnp.floating)
        return x + 1.0

    plain = jax.make_jaxpr(lambda x: x + 1.0)(jnp.zeros((4, 2)))
    assert str(jax.make_jaxpr(checked)(jnp.zeros((4, 2)))) == str(plain)


@pytest.mark.parametrize(
    "x", [[[1, 2], [3, 4]], np.array([[1, 2], [3, 4]]), np.float32([[1, 2], [3, 4]])]
)
def test_numbers_of_any_kind_become_floats(x):
    for given in (x, jnp.asarray(x)):
        floats = as_float("x", given, ("N", 2))
        assert isinstance(floats, jax.Array) and jnp.issubdtype(floats.dtype, jnp.floating)
        np.testing.assert_array_equal(floats, [[1, 2], [3, 4]])
        double = as_float64("x", given, (2, 2))
        assert isinstance(double, np.ndarray) and double.dtype == np.float64
        np.testing.assert_array_equal(double, [[1, 2], [3, 4]])


def test_a_jax_array_of_floats_keeps_its_precision():
    assert as_float("x", jnp.zeros(3, jnp.float32), (3,)).dtype == jnp.float32
    assert as_float("x", np.zeros(3, np.float32), (3,)).dtype == jnp.float64


@pytest.mark.parametrize(
    "x, message",
    [
        ([[1.0], [1.0, 2.0]], "x is not an array: its parts differ in shape"),
        ([True, False], "x is bool (2,), not numbers"),
        ("ab", "x is <U2 (), not numbers"),
        (None, "x is object (), not numbers"),
        ([1j, 2.0], "x is complex128 (2,), not numbers"),
        ([1.0, 2.0, 3.0], "x is float64 (3,), not floating (2,)"),
    ],
)
def test_what_is_no_array_of_numbers_is_named(x, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        as_float("x", x, (2,))


def test_bools_are_no_numbers():
    for x in ([True, False], np.array([True, False]), jnp.array([True, False])):
        assert as_bool("x", x, (2,)).tolist() == [True, False]
    for x in ([1, 0], np.array([1.0, 0.0]), "ab"):
        with pytest.raises(ValueError, match="^x is .*, not bool"):
            as_bool("x", x, (2,))


@pytest.mark.parametrize(
    "cov, message",
    [
        ([[1.0, 0.5], [0.0, 1.0]], "cov is not symmetric: [0, 1] is 0.5, [1, 0] 0"),
        ([[1.0, 2.0], [2.0, 1.0]], "cov is not positive definite: its smallest eigenvalue is -1"),
        ([[1.0, np.nan], [np.nan, 1.0]], "cov holds numbers that are not finite"),
    ],
)
def test_what_is_no_covariance_is_named(cov, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        check_covariance("cov", jnp.array(cov))


def test_one_bad_covariance_of_several_is_named_by_its_index():
    good = np.eye(2)
    check_covariance("cov", jnp.array([good, good]))
    check_covariance("cov", jnp.diag(jnp.array([1.0, 0.0])), definite=False)
    with pytest.raises(ValueError, match=re.escape("cov[1] is not positive definite")):
        check_covariance("cov", jnp.array([good, -good]))


@pytest.mark.parametrize(
    "x, limits, message",
    [
        (-1, {}, "x is -1.0, not a number of metres >= 0"),
        (np.inf, {}, "x is inf, not a number of metres >= 0"),
        (np.nan, {"unit": "seconds"}, "x is nan, not a number of seconds >= 0"),
        (0.0, {"positive": True}, "x is 0.0, not a positive number of metres"),
        (3, {"least": 1.0, "most": 2.0}, "x is 3.0, not a number of metres between 1 and 2"),
        (True, {}, "x is bool (), not numbers"),
        ([1.0], {}, "x is float64 (1,), not ()"),
    ],
)
def test_sizes_out_of_range_are_named(x, limits, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        as_size("x", x, **limits)


@pytest.mark.parametrize("x", [2, np.float32(2.0), np.array(2), jnp.array(2.0)])
def test_sizes_of_any_kind_become_floats(x):
    size = as_size("x", x, positive=True, most=2.0)
    assert type(size) is float and size == 2.0
