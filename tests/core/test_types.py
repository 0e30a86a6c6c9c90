import re

import jax
import jax.numpy as jnp
import pytest

from jaxslam.core.types import check_array
from jaxslam.frontend.edge_codes import edge_codes
from jaxslam.frontend.grid import Grid, GridSpec


@pytest.mark.parametrize(
    "shape, wanted, kind",
    [
        ((), (), None),
        ((3,), (3,), jnp.floating),
        ((0, 2), ("N", 2), float),
        ((5,), (..., 5), None),
        ((7, 6, 5), (..., 6, 5), jnp.inexact),
    ],
)
def test_what_fits_passes(shape, wanted, kind):
    check_array("x", jnp.zeros(shape), wanted, kind)


@pytest.mark.parametrize(
    "shape, wanted, kind, told",
    [
        ((), (3,), None, "x is float64 (), not (3,)"),
        ((3, 1), (3,), None, "x is float64 (3, 1), not (3,)"),
        ((4, 3), ("N", 2), None, "x is float64 (4, 3), not (N, 2)"),
        ((), (..., 2), None, "x is float64 (), not (..., 2)"),
        ((2,), (2,), jnp.integer, "x is float64 (2,), not integer (2,)"),
        ((2,), (2,), jnp.bool_, "x is float64 (2,), not bool (2,)"),
    ],
)
def test_what_does_not_fit_is_told(shape, wanted, kind, told):
    with pytest.raises(ValueError, match=f"^{re.escape(told)}$"):
        check_array("x", jnp.zeros(shape), wanted, kind)


def test_it_costs_nothing_at_run_time():
    def checked(x):
        check_array("x", x, ("N", 2), jnp.floating)
        return x + 1.0

    plain = jax.make_jaxpr(lambda x: x + 1.0)(jnp.zeros((4, 2)))
    assert str(jax.make_jaxpr(checked)(jnp.zeros((4, 2)))) == str(plain)


def test_codes_want_the_grid_they_are_told_of():
    cells = jnp.zeros((4, 5), bool)
    with pytest.raises(ValueError, match=r"grid.occupied is bool \(4, 5\), not bool \(82, 160\)"):
        jax.eval_shape(lambda: edge_codes(GridSpec(), Grid(cells, cells)))
