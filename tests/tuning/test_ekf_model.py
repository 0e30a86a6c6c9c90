"""The EKF of a user's functions against a textbook filter, finite differences and dynamax."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import any_model
from jaxslam.tuning import batch_last, fitting
from jaxslam.tuning.ekf_model import EkfSequence, ekf_model
from jaxslam.tuning.model import Model, run_model
from jaxslam.tuning.model_checks import check_model

RNG = np.random.default_rng(0)
N, M, T, B = 3, 2, 6, 3
A = np.eye(N) + 0.2 * RNG.normal(size=(N, N))
C = RNG.normal(size=(M, N))
Q, R, P0 = (x @ x.T + 0.1 * np.eye(len(x)) for x in (RNG.normal(size=(k, k)) for k in (N, M, N)))
INPUTS, Y = RNG.normal(size=(B, T, N)), RNG.normal(size=(B, T, M))
MASK = RNG.uniform(size=(B, T, M)) < 0.6
PARAMS = {"gain": jnp.array(1.1), "scale": jnp.array(0.8)}


def linear(size=N, **changes):
    """x' = gain A x + u, y = C x; the covariances in proportion to `scale`."""
    given = {
        "init": lambda params, sequence: (jnp.zeros(size), jnp.eye(size)),
        "motion": lambda params, x, u: params["gain"] * A @ x + u,
        "measure": lambda params, x: C @ x,
        "motion_cov": lambda params, x, u: params["scale"] * Q,
        "measurement_cov": lambda params, x: params["scale"] * R,
    }
    return ekf_model(**(given | changes))


LINEAR = linear(init=lambda params, sequence: (jnp.zeros(N), jnp.asarray(P0)))


def pendulum_measure(params, x):
    return jnp.stack([params["gain"] * jnp.sin(x[0]), x[1] ** 2, x[0], x[2] * x[0], x[2]])


# Five measurements: the batch is the last axis.
CURVED = linear(
    motion=lambda params, x, u: jnp.stack(
        [x[0] + 0.1 * x[1], x[1] - params["gain"] * jnp.sin(x[0]) + u[0], x[2] + 0.1 * u[1]]
    ),
    measure=pendulum_measure,
    measurement_cov=lambda params, x: params["scale"] * jnp.eye(5) * (1.0 + x[0] ** 2),
    measurement_angles=(2,),
    state_angles=(0,),
)
Y5, MASK5 = 2 * RNG.normal(size=(B, T, 5)), RNG.uniform(size=(B, T, 5)) < 0.7


def textbook(gain, scale, inputs, y, mask):
    """Log-likelihood, mean and covariance of a Kalman filter; what is missing is deleted."""
    x, P, total = np.zeros(N), P0, 0.0
    for u, measured, there in zip(inputs, y, mask, strict=True):
        F = gain * A
        x, P = F @ x + u, F @ P @ F.T + scale * Q
        H, noise, v = C[there], scale * R[np.ix_(there, there)], measured[there] - C[there] @ x
        S = H @ P @ H.T + noise
        K = P @ H.T @ np.linalg.inv(S)
        total -= (v @ np.linalg.inv(S) @ v + np.linalg.slogdet(2 * np.pi * S)[1]) / 2
        x, P = x + K @ v, P - K @ S @ K.T
    return total, x, P


def log_likelihood(model, params, sequence):
    return jnp.sum(run_model(model, params, sequence)[1].log_likelihood)


@pytest.mark.parametrize("mask", [None, MASK], ids=["all", "some"])
def test_a_linear_model_is_the_textbook_filter_and_missing_numbers_are_as_deleted(mask):
    data = EkfSequence(INPUTS, Y if mask is None else np.where(mask, Y, np.nan), mask)
    state, info = jax.vmap(lambda s: run_model(LINEAR, PARAMS, s))(jax.tree.map(jnp.asarray, data))
    for k in range(B):
        there = np.ones((T, M), bool) if mask is None else mask[k]
        expected, x, P = textbook(1.1, 0.8, INPUTS[k], Y[k], there)
        np.testing.assert_allclose(info.log_likelihood[k].sum(), expected, rtol=1e-10)
        np.testing.assert_allclose(state.mean[k], x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(state.cov[k], P, rtol=1e-10, atol=1e-10)
        np.testing.assert_array_equal(info.dof[k], there.sum(axis=1))
    assert info.finite.all()


@pytest.mark.parametrize("model, y, mask", [(LINEAR, Y, MASK), (CURVED, Y5, MASK5)])
def test_gradient_is_that_of_differences_and_a_batch_is_a_loop(model, y, mask):
    """Of the small model a batch is first, of the other last; missing numbers are NaN."""
    data = EkfSequence(*map(jnp.asarray, (INPUTS, np.where(mask, y, np.nan), mask)))
    single = jax.jit(jax.value_and_grad(lambda p, s: log_likelihood(model, p, s)))
    values, gradients = jax.jit(jax.vmap(single, in_axes=(None, 0)))(PARAMS, data)
    for k in range(B):
        own = jax.tree.map(lambda x, k=k: x[k], data)
        value, gradient = single(PARAMS, own)
        np.testing.assert_allclose(values[k], value, rtol=1e-12)
        for name, step in [("gain", 1e-5), ("scale", 1e-5)]:
            both = [single(PARAMS | {name: PARAMS[name] + s}, own)[0] for s in (step, -step)]
            np.testing.assert_allclose(gradient[name], (both[0] - both[1]) / (2 * step), rtol=2e-6)
            np.testing.assert_allclose(gradients[name][k], gradient[name], rtol=1e-9)


@pytest.mark.parametrize("model, y", [(LINEAR, Y), (CURVED, Y5)])
def test_derivatives_by_all_results_are_those_of_differences(model, y):
    """A loss may take anything of the infos, and parameters may enter by the inputs."""

    def loss(bias):
        sequence = EkfSequence(jnp.asarray(INPUTS[0]) + bias, jnp.asarray(y[0]))
        info = run_model(model, PARAMS, sequence)[1]
        parts = (info.mean, info.cov, info.innovation, info.innovation_cov, info.nis)
        return sum(jnp.sum(jnp.sin(0.1 * part + i)) for i, part in enumerate(parts))

    loss = jax.jit(loss)
    slope = (loss(0.1 + 1e-5) - loss(0.1 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.jit(jax.grad(loss))(jnp.array(0.1)), slope, rtol=1e-6)


def test_an_angle_beyond_pi_is_near():
    turn = linear(
        2,
        motion=lambda params, x, u: x + u,
        measure=lambda params, x: x[:1],
        motion_cov=lambda params, x, u: 0.01 * jnp.eye(2),
        measurement_cov=lambda params, x: 0.01 * jnp.eye(1),
        init=lambda params, s: (jnp.array([3.1, 0.0]), 0.01 * jnp.eye(2)),
        state_angles=(True, False),
        measurement_angles=(0,),
    )
    sequence = EkfSequence(jnp.zeros((1, 2)), jnp.array([[-3.1]]))
    _, info = run_model(turn, {}, sequence)
    np.testing.assert_allclose(info.innovation, [[2 * np.pi - 6.2]])
    np.testing.assert_allclose(info.mean[0, 0], 3.1 + 2 / 3 * (2 * np.pi - 6.2) - 2 * np.pi)


def test_a_step_that_fails_is_left_out_and_makes_the_likelihood_minus_infinity():
    bad = linear(measurement_cov=lambda params, x: -100 * jnp.eye(M))
    sequence = EkfSequence(jnp.asarray(INPUTS[0]), jnp.asarray(Y[0]))
    state, info = run_model(bad, PARAMS, sequence)
    assert not info.finite.any() and np.isneginf(info.log_likelihood).all()
    np.testing.assert_array_equal(state.mean, np.zeros(N))
    np.testing.assert_array_equal(state.cov, np.eye(N))


def test_the_step_keeps_nothing_but_its_arguments():
    """The memory of the derivative is that of the states."""
    compute = batch_last.recomputed(
        lambda args, batched: ((jnp.sin(jnp.cos(args["x"])),), ()), last=False
    )
    args = {"x": jnp.arange(3.0), "n": jnp.arange(3)}
    _, pull = jax.vjp(lambda a: compute(a)[0][0], args)
    assert {x.shape for x in jax.tree.leaves(pull)} == {(3,)}
    np.testing.assert_allclose(
        pull(jnp.ones(3))[0]["x"], -jnp.cos(jnp.cos(args["x"])) * jnp.sin(args["x"])
    )


WRONG = {
    "motion(params, state, input) returns float64 (2,), not floats (3,)": {
        "motion": lambda params, x, u: x[:2]
    },
    "measure(params, state) returns float64 (3,), not floats (2,)": {
        "measure": lambda params, x: x
    },
    "measurement_cov(params, state) returns float64 (), not floats (2, 2)": {
        "measurement_cov": lambda params, x: params["scale"]
    },
    "motion(params, state, input): TypeError:": {"motion": lambda params, x: x},
    "state_angles names 7 of 3 numbers": {"state_angles": (7,)},
    "state_angles has 2 bools, but there are 3 numbers": {"state_angles": (True, False)},
    "init(params, sequence) returns no pair": {"init": lambda params, sequence: jnp.zeros(3)},
    "init(params, sequence): covariance returns float64 (3,)": {
        "init": lambda params, sequence: (jnp.zeros(3), jnp.ones(3))
    },
}


@pytest.mark.parametrize("message", WRONG)
def test_functions_that_do_not_fit_are_one_line_before_compiling(message):
    sequence = EkfSequence(jnp.asarray(INPUTS[0]), jnp.asarray(Y[0]))
    with pytest.raises(ValueError) as error:
        check_model(linear(**WRONG[message]), PARAMS, sequence)
    assert message in str(error.value) and "\n" not in str(error.value)


def test_data_that_do_not_fit_are_one_line():
    for message, data in {
        "data.measurements[1, 2, 0] is nan": EkfSequence(
            INPUTS, np.where(np.arange(B * T * M).reshape(B, T, M) == (T + 2) * M, np.nan, Y)
        ),
        "data.mask is float64": EkfSequence(INPUTS, Y, np.ones((B, T, M))),
        "data.inputs is float64 (3, 5, 3)": EkfSequence(INPUTS[:, 1:], Y),
        "data.inputs[0, 0, 0] is -inf: inputs are known": EkfSequence(INPUTS * np.inf, Y),
        "data.mask is False everywhere": EkfSequence(INPUTS, Y, np.zeros((B, T, M), bool)),
        "data.measurements is (3, 0, 2): nothing was": EkfSequence(None, Y[:, :0]),
        "data[1] is ndarray, not EkfSequence": [EkfSequence(INPUTS[0], Y[0]), Y[1]],
        "data[1] has other fields, or arrays": [
            EkfSequence(INPUTS[0], Y[0]),
            EkfSequence(INPUTS[1, :, :1], Y[1]),
        ],
        "data is tuple, not EkfSequence": (INPUTS, Y),
    }.items():
        with pytest.raises(ValueError) as error:
            fitting.values(LINEAR, PARAMS, data)
        assert message in str(error.value) and "\n" not in str(error.value)


class Unhashable:
    """A function that cannot be static under jit."""

    __hash__ = None

    def __call__(self, params, x):
        return x


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"measure": 3}, "measure is int, not a function"),
        ({"measure": Unhashable()}, "measure is .*, which has no hash"),
        ({"predict_first": "no"}, "predict_first is 'no', not True or False"),
        ({"state_angles": "ab"}, "state_angles is 'ab', not indices"),
    ],
)
def test_what_makes_no_model_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        linear(**changes)


def test_sequences_of_different_lengths_have_the_likelihood_of_each_alone():
    """They are padded; masks by step, whole numbers and lists are taken."""
    whole = np.round(3 * Y)
    lengths, by_step = (T, 2, 4), MASK[..., 0]
    parts = [
        EkfSequence(INPUTS[b, :t], whole[b, :t].astype(int), by_step[b, :t])
        for b, t in enumerate(lengths)
    ]
    found = fitting.values(LINEAR, PARAMS, parts)
    for b, t in enumerate(lengths):
        mask = np.repeat(by_step[b, :t, None], M, axis=1)
        total = textbook(1.1, 0.8, INPUTS[b, :t], whole[b, :t], mask)[0]
        np.testing.assert_allclose(found[b], -total / max(mask.sum(), 1), rtol=1e-10)
    lists = EkfSequence(INPUTS, whole.tolist(), np.repeat(by_step[..., None], M, axis=2).tolist())
    same = fitting.values(LINEAR, PARAMS, EkfSequence(INPUTS, whole, by_step))
    np.testing.assert_array_equal(fitting.values(LINEAR, PARAMS, lists), same)


def test_a_model_whose_state_changes_is_refused():
    def model(step, inputs=lambda params, s: s):
        return Model(lambda params, s: {"x": jnp.zeros(2), "k": jnp.zeros(())}, step, inputs)

    sequence = jnp.zeros((4, 2))
    check_model(model(lambda params, state, now: (state, now)), {}, sequence)
    for message, wrong in {
        "state['x'] is float64 (1,) after the step and float64 (2,) before it": model(
            lambda params, state, now: (state | {"x": state["x"][:1]}, now)
        ),
        "state['k'] is int32 ()": model(
            lambda params, state, now: (state | {"k": jnp.int32(0)}, now)
        ),
        "state['y'] is float64 (2,) after the step and missing before": model(
            lambda params, state, now: (state | {"y": now}, now)
        ),
        "state['k'] is missing after": model(lambda params, state, now: ({"x": now}, now)),
        "no pair of state and info": model(lambda params, state, now: state),
        "model.step(params, state, now): TypeError": model(lambda state, now: (state, now)),
        "differs in the number of steps": model(
            lambda params, state, now: (state, now), lambda params, s: (s, s[1:])
        ),
    }.items():
        with pytest.raises(ValueError) as error:
            check_model(wrong, {}, sequence)
        assert message in str(error.value) and "\n" not in str(error.value)


@pytest.mark.slow
def test_likelihood_is_that_of_dynamax_of_a_pendulum_and_of_beacons():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pytest.importorskip("dynamax.nonlinear_gaussian_ssm", exc_type=ImportError)
    for name in any_model.MODELS:
        task = any_model.task(name, seed=1, num_trials=2, num_steps=12)
        own, peer = (
            jax.jit(jax.vmap(jax.value_and_grad(f), in_axes=(None, 0))) for f in task.likelihoods()
        )
        (a, da) = own(task.params, task.data)
        with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
            (b, db) = peer(task.params, task.data)
        np.testing.assert_allclose(a, b, rtol=1e-6)
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-4), da, db)
