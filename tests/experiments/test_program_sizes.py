"""The main programs do not grow unseen; nothing is compiled."""

import jax
import pytest
from jax import lax

from experiments import program_sizes
from experiments.program_sizes import difference, num_equations
from experiments.programs import PROGRAMS, traced


@pytest.mark.parametrize("name", PROGRAMS)
def test_programs_have_their_recorded_size(name, single_precision):
    recorded = program_sizes.read()
    if not program_sizes.is_comparable(recorded.jax):
        pytest.skip(f"sizes are recorded with jax {recorded.jax}, and this is {jax.__version__}")
    wrong = difference(name, program_sizes.size(name), recorded.equations)
    assert wrong is None, wrong


@pytest.mark.parametrize("name", [name for name in PROGRAMS if not name.startswith("trials")])
def test_programs_lower_for_an_accelerator(name, single_precision):
    """`test_accelerator` has those of trials."""
    text = traced(name).lower(lowering_platforms=("cuda",)).as_text()
    assert "stablehlo" in text and "callback" not in text


def test_all_that_is_recorded_exists():
    assert set(program_sizes.read().equations) == set(PROGRAMS)


def test_equations_within_loops_branches_and_calls_count():
    def function(x):
        x = lax.fori_loop(0, 3, lambda _, x: lax.cos(lax.cos(x)), x)  # a scan of add, cos, cos
        on = x > 0.0  # gt, and convert_element_type for the index of the branch
        return lax.cond(on, lambda x: lax.tan(lax.tan(x)), lambda x: x, lax.sin(x))

    assert num_equations(jax.make_jaxpr(function)(1.0).jaxpr) == 4 + 2 + 1 + 3
    assert num_equations(jax.make_jaxpr(jax.jit(function))(1.0).jaxpr) == 1 + 10


def test_growth_is_named_with_both_numbers_and_the_command():
    recorded = {"filter": 100}
    assert difference("filter", 110, recorded) is None
    assert difference("filter", 90, recorded) is None
    grown, shrunk = difference("filter", 111, recorded), difference("filter", 89, recorded)
    assert grown.startswith("filter has 111 equations, 11% more than the 100 recorded; if that")
    assert shrunk.startswith("filter has 89 equations, 11% fewer than the 100 recorded; record")
    unknown = difference("smoother", 5, recorded)
    assert unknown.startswith("smoother has no recorded number")
    for message in (grown, shrunk, unknown):
        assert f"`{program_sizes.COMMAND}`" in message


def test_versions_that_differ_in_the_last_number_are_comparable():
    major, minor, *_ = jax.__version__.split(".")
    assert program_sizes.is_comparable(f"{major}.{minor}.99")
    assert not program_sizes.is_comparable(f"{major}.{int(minor) + 1}.0")
