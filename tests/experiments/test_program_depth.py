"""Depth and cost of a program that is written by hand; nothing is compiled, but once."""

import jax
import jax.numpy as jnp
import pytest

from experiments import chain_profile, program_depth
from experiments.program_depth import cost, depth, executed_operations, parse, unknown_loops

N = 8
MATRIX = f"f32[{N},{N}]{{1,0}}"
PRODUCT = 2 * N**3  # flops

# The entry: a = -x; then a loop of seven turns, a branch, and a sum with b = -x, which waits for
# nothing else. A turn is a product, its square, and beside them i + 1; so two are in the chain.
PROGRAM = f"""HloModule hand

%fused (p.1: f32[8,8]) -> f32[8,8] {{
  %p.1 = {MATRIX} parameter(0)
  %s.1 = {MATRIX} sine(%p.1)
  ROOT %c.1 = {MATRIX} cosine(%s.1)
}}

%body (state.1: (s32[], f32[8,8])) -> (s32[], f32[8,8]) {{
  %state.1 = (s32[], {MATRIX}) parameter(0)
  %i.1 = s32[] get-tuple-element(%state.1), index=0
  %one.1 = s32[] constant(1)
  %next.1 = s32[] add(%i.1, %one.1)
  %y.1 = {MATRIX} get-tuple-element(%state.1), index=1
  %z.1 = {MATRIX} dot(%y.1, %y.1), lhs_contracting_dims={{1}}, rhs_contracting_dims={{0}}
  %w.1 = {MATRIX} multiply(%z.1, %z.1)
  ROOT %out.1 = (s32[], /*index=1*/{MATRIX}) tuple(%next.1, %w.1)
}}

%test (state.2: (s32[], f32[8,8])) -> pred[] {{
  %state.2 = (s32[], {MATRIX}) parameter(0)
  %i.2 = s32[] get-tuple-element(%state.2), index=0
  %limit.2 = s32[] constant(7)
  ROOT %less.2 = pred[] compare(%i.2, %limit.2), direction=LT
}}

%long (p.3: f32[8,8]) -> f32[8,8] {{
  %p.3 = {MATRIX} parameter(0)
  %a.3 = {MATRIX} fusion(%p.3), kind=kLoop, calls=%fused
  %b.3 = {MATRIX} negate(%a.3)
  ROOT %c.3 = {MATRIX} negate(%b.3)
}}

%short (p.4: f32[8,8]) -> f32[8,8] {{
  %p.4 = {MATRIX} parameter(0)
  ROOT %a.4 = {MATRIX} negate(%p.4)
}}

ENTRY %main (x: f32[8,8], on: s32[]) -> f32[8,8] {{
  %x = {MATRIX} parameter(0)
  %on = s32[] parameter(1)
  %zero = s32[] constant(0)
  %a = {MATRIX} negate(%x)
  %b = {MATRIX} negate(%x), metadata={{op_name="jit(main)/neg" stack_frame_id=5}}
  %start = (s32[], {MATRIX}) tuple(%zero, %a)
  %loop = (s32[], {MATRIX}) while(%start), condition=%test, body=%body, TRIPS
  %y = {MATRIX} get-tuple-element(%loop), index=1
  %branch = {MATRIX} conditional(%on, %y, %y), branch_computations={{%long, %short}}
  ROOT %sum = {MATRIX} add(%branch, %b)
}}
"""
KNOWN = 'backend_config={"known_trip_count":{"n":"7"}}'
NAMED = "true_computation=%long, false_computation=%short"
UNKNOWN = 'backend_config={"known_init_step":{"init":"0"}}'


def program(trips=KNOWN):
    return parse(PROGRAM.replace("TRIPS", trips))


def test_the_depth_is_that_of_the_longest_chain():
    assert depth(program()) == 1 + 7 * 2 + 3 + 1  # a, the loop, the longer branch, sum
    assert depth(program(UNKNOWN)) == 1 + 2 + 3 + 1
    named = PROGRAM.replace("branch_computations={%long, %short}", NAMED)
    assert named != PROGRAM and depth(parse(named.replace("TRIPS", KNOWN))) == depth(program())


def test_all_operations_count_those_of_loops_and_of_all_branches():
    assert executed_operations(program()) == 2 + (1 + 7 * 3) + (1 + 3 + 1) + 1


def test_a_loop_of_unknown_length_is_counted():
    assert unknown_loops(program()) == 0 and unknown_loops(program(UNKNOWN)) == 1


def test_the_cost_of_a_loop_is_that_of_all_its_turns():
    seven, one = cost(program()), cost(program(UNKNOWN))
    if seven is None:
        pytest.skip("this jaxlib does not analyse parts of a program")
    assert seven.flops - one.flops == 6 * (PRODUCT + N**2 + 1)  # product, square and i + 1
    # Product and square read two matrices and write one; i + 1; and the tuple holds two addresses.
    assert seven.bytes - one.bytes == 6 * (2 * 3 * 4 * N**2 + 3 * 4 + 2 * 8)


def test_the_parts_of_a_whole_program_add_up_to_what_xla_counts():
    """Where each loop turns once; XLA counts the body of every loop once."""

    def function(x):
        def body(y, z):
            return jax.lax.fori_loop(0, 5, lambda _, y: jnp.cos(y) @ y, y) + z, None

        return jax.lax.scan(body, x, jnp.ones((3, *x.shape), x.dtype))[0]

    x = jax.ShapeDtypeStruct((N, N), jnp.float32)
    compiled = jax.jit(function).lower(x).compile()
    module = parse(compiled.as_text())
    if cost(module) is None:
        pytest.skip("this jaxlib does not analyse parts of a program")
    once = {
        name: [each._replace(trips=each.trips and 1) for each in operations]
        for name, operations in module.computations.items()
    }
    whole = compiled.cost_analysis()
    assert cost(module._replace(computations=once)) == (whole["flops"], whole["bytes accessed"])
    found = program_depth.profile(compiled)
    assert 15 * PRODUCT < found["flops"] < 16 * PRODUCT and found["unknown_loops"] == 0
    assert found["operations"] >= found["depth"] >= 15 * 2


def test_the_table_has_a_row_for_each_part(capsys):
    rows = [
        {"part": "filter", "us_per_scan": 0.1234, "equations": 1200, "flops": None},
        {"part": "segments", "us_per_scan": 12.0, "equations": 7, "flops": 1e6},
    ]
    chain_profile.print_table(rows)
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines == [
        ["a", "scan", "us", "per", "scan", "equations", "flops"],
        ["filter", "0.123", "1,200", "-"],
        ["segments", "12", "7", "1,000,000"],
    ]
