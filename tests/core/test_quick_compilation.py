import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core import quick_compilation, trace_cache
from jaxslam.core.quick_compilation import quick_options

KNOWN = {"xla_cpu_enable_fast_min_max": False}
"""An option that the flags of the tests do not name, as options that they do are left out."""


@pytest.fixture(autouse=True)
def options_anew():
    quick_options.cache_clear()
    yield
    quick_options.cache_clear()


def wave(x):
    return jnp.sin(2.0 * x) + jnp.exp(-x)


def test_options_of_the_compiler_are_none_where_the_user_sets_them(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=true")
    assert quick_options() == {}


def test_an_option_that_xla_does_not_know_is_left_out(monkeypatch):
    monkeypatch.setattr(quick_compilation, "QUICK", {"xla_cpu_no_such_option": False})
    assert quick_options() == {}


def constant():
    return wave(jnp.arange(3.0))


def test_a_quickly_compiled_function_is_part_of_other_programs(monkeypatch):
    monkeypatch.setattr(quick_compilation, "QUICK", KNOWN)
    assert quick_options()
    quick, quick_constant = (trace_cache.jit(f, compile_quickly=True) for f in (wave, constant))
    x = jnp.linspace(0.0, 3.0, 6)
    for call in (lambda f: f(x), lambda f: jax.jit(f)(x), lambda f: jax.vmap(f)(x[:, None])):
        np.testing.assert_allclose(call(quick), call(wave), rtol=1e-14)
    np.testing.assert_allclose(jax.vmap(jax.grad(quick))(x), jax.vmap(jax.grad(wave))(x))
    for call in (
        lambda f: f(),
        lambda f: jax.jit(f)(),
        lambda f: jax.vmap(lambda y: f()[0] + y)(x),
    ):
        np.testing.assert_allclose(call(quick_constant), call(constant), rtol=1e-14)


@pytest.mark.parametrize("quickly", [True, "unoptimised"])
def test_each_kind_of_program_has_the_options_of_its_kind(monkeypatch, quickly):
    own, other = ("QUICK", "UNOPTIMISED")[:: 1 if quickly is True else -1]
    monkeypatch.setattr(quick_compilation, own, KNOWN)
    monkeypatch.setattr(quick_compilation, other, {"xla_cpu_no_such_option": False})
    given, real = [], jax.jit

    def jit(function, **options):
        given.append(options.get("compiler_options"))
        return real(function, **options)

    monkeypatch.setattr(jax, "jit", jit)
    x = jnp.linspace(0.0, 3.0, 7)
    found = trace_cache.jit(wave, compile_quickly=quickly)(x)
    np.testing.assert_allclose(found, wave(x), rtol=1e-14)
    assert KNOWN in given
