"""What `tune` refuses of a user's own model, data and loss, and what it counts and goes on with."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxslam.core.devices import DeviceMap
from jaxslam.tuning import (
    CHOLESKY,
    POSITIVE,
    Model,
    NisConsistency,
    PredictionNll,
    WeightedLoss,
    bounded,
    fitting,
    prediction_nll,
    real,
    standard_errors,
)
from jaxslam.tuning.ekf_model import EkfSequence, ekf_model

B, T = 6, 20
RNG = np.random.default_rng(0)
Y = np.cumsum(0.3 * RNG.normal(size=(B, T)), axis=1) + 0.5 * RNG.normal(size=(B, T))
START = {"q": 1.0, "r": 1.0}


def init(params, sequence):
    return jnp.zeros(()), jnp.ones(())


def step(params, state, y):
    """A filter of a random walk, written by hand; each step returns its likelihood."""
    x, P = state[0], state[1] + params["q"] ** 2
    S, v = P + params["r"] ** 2, y - x
    return (x + P / S * v, P - P**2 / S), (v**2 / S + jnp.log(S)) / 2


def mean_loss(info, sequence):
    return jnp.mean(info)


WALK = Model(init, step)


def tuned(model=WALK, params=START, data=Y, **changes):
    given = {"loss": mean_loss, "transforms": POSITIVE, "num_updates": 2} | changes
    return fitting.tune(model, params, data, **given)


@pytest.fixture
def no_work(monkeypatch):
    """Fail the test if anything is compiled to be run on the sequences."""
    monkeypatch.setattr(
        "jaxslam.core.devices._compile",
        lambda run, program, common_of, batch_of: lower(run, program, common_of[0], batch_of[0]),
    )


def lower(run, program, common, batch):
    run.trace(program, common, batch)
    pytest.fail("nothing was refused before compiling")


def flat(info, sequence):
    return info


REFUSED = [
    ({"model": WALK._replace(batch_size=0)}, "model.batch_size is 0, not a whole number"),
    ({"model": WALK._replace(batch_size=2.5)}, "model.batch_size is 2.5, not a whole number"),
    ({"data": Y[0]}, r"model.inputs\(params, sequence\) is a number, not an array that leads"),
    ({"data": Y[:, :0]}, r"model.inputs\(params, sequence\) has no steps, not an array that"),
    ({"data": 1e300 * Y, "params": START}, r"data\[0, 0\] is .*e\+\d+, too large for float32"),
    ({"loss": None}, "loss innovation_nll needs dof in what the steps of the model return"),
    ({"loss": prediction_nll}, r"loss PredictionNll\(steps=64\) needs nis in what the steps of"),
    ({"loss": NisConsistency(0)}, "NisConsistency.steps is 0, not a whole number of at least 1"),
    ({"loss": PredictionNll(True)}, "PredictionNll.steps is True, not a whole number"),
    ({"loss": flat}, r"loss flat returns float\d+ \(20,\) of a sequence, not one float"),
    ({"loss": lambda info, s: None}, r"returns object \(\) of a sequence, not one float"),
    ({"loss": lambda info, s: jnp.int32(1)}, r"returns int32 \(\) of a sequence, not one float"),
    ({"loss": lambda info, s: info.x}, "loss <lambda> of infos and a sequence: AttributeError: "),
    ({"loss": WeightedLoss([(1.0, flat)])}, r"WeightedLoss.terms is \[.*, not a tuple of \(weig"),
    ({"loss": WeightedLoss(((flat, 1.0),))}, "WeightedLoss.terms holds the weight <function flat"),
    ({"loss": WeightedLoss(((np.nan, flat),))}, "terms holds the weight nan, not a finite number"),
    ({"loss": WeightedLoss(((1.0, 2.0),))}, "WeightedLoss.terms holds 2.0, not a loss"),
    ({"frozen": None}, "frozen is None, not a collection of names"),
    ({"optimizer": "adam"}, "optimizer is 'adam', not one of optax"),
    ({"optimizer": optax.adam}, "optimizer is <function adam.*, not one of optax"),
    ({"optimizer": optax.lbfgs()}, "optimizer fails: TypeError: .*; it is given gradient, state"),
    ({"callback": 3}, "callback is 3, not a function of the state"),
    ({"patience": 2}, "patience is 2, but there is no heldout"),
    ({"heldout": (Y,)}, r"heldout is \[0\], not one array as the data"),
    ({"heldout": Y[..., None]}, r"heldout is float\d+ \(6, 20, 1\), of the data to tune on"),
    ({"heldout": np.ones((2, T), int)}, r"heldout is int\d+ \(2, 20\), of the data to tune on"),
    ({"params": {"q": True, "r": 1.0}}, "params.q is a bool, not a number"),
    ({"params": {"q": 1e60, "r": 1.0}}, r"params.q is 1e\+60, not positive and finite in float32"),
    ({"transforms": bounded(0.0, 1.0 + 1e-9)}, "q is 1.0, not between 0 and 1 and .* in float32"),
]


@pytest.mark.parametrize("changes, message", REFUSED, ids=[text[:30] for _, text in REFUSED])
def test_what_does_not_fit_is_one_line_before_compiling(no_work, changes, message):
    with (
        jax.enable_x64("float32" not in message),
        pytest.raises(ValueError, match=message) as error,
    ):
        tuned(**changes)
    assert "\n" not in str(error.value)


def test_whole_numbers_beyond_32_bits_are_refused_without_64(no_work):
    """Time stamps in nanoseconds would be other numbers without a word."""
    with jax.enable_x64(False), pytest.raises(ValueError, match=r"\[0, 0\] is .*, too large for i"):
        tuned(data=np.full((B, T), 2**40))


def test_a_loss_of_no_sequence_or_without_influence_is_said():
    nothing = np.full((B, T), np.nan)
    with pytest.raises(ValueError, match="loss and gradient of none of 6 sequences are finite; lo"):
        tuned(data=nothing)
    with pytest.raises(ValueError, match="heldout: the loss of no sequence is finite; look for"):
        tuned(heldout=nothing)
    with pytest.raises(ValueError, match="loss depends on no parameter that is tuned: its gradie"):
        tuned(loss=lambda info, s: jnp.mean(s))
    one = np.where(np.arange(B)[:, None] == 2, np.nan, Y)
    assert tuned(data=one).skipped.tolist() == [1, 1, 1]


def test_prediction_of_an_ekf_that_has_no_map_is_refused(no_work):
    """Its value would be 0 whatever the parameters are."""
    model = ekf_model(
        init=lambda params, s: (jnp.zeros(1), jnp.eye(1)),
        motion=lambda params, x, u: x,
        measure=lambda params, x: x,
        motion_cov=lambda params, x, u: params["q"] * jnp.eye(1),
        measurement_cov=lambda params, x: params["r"] * jnp.eye(1),
    )
    with pytest.raises(ValueError, match="prediction is of maps"):
        tuned(model, data=EkfSequence(None, Y[..., None]), loss=PredictionNll(5))


def test_a_state_of_another_tuning_is_refused():
    seen = []
    whole = tuned(callback=seen.append)
    state = seen[1]
    jax.tree.map(np.testing.assert_array_equal, whole, tuned(state=state))
    for changes, message in [
        ({"data": Y + 1.0}, "state is of another model, data, loss, prior or seed: its first"),
        ({"loss": lambda info, s: 2 * jnp.mean(info)}, "state is of another model, data, loss"),
        ({"transforms": real(1.0)}, "state is of a tuning that began with other params or tran"),
        ({"params": {"q": 2.0, "r": 1.0}}, "state is of a tuning that began with other params"),
        ({"frozen": ("q",)}, "state is of another optimizer, or other parameters were frozen"),
        ({"optimizer": optax.adam(0.1)}, "state is of another optimizer"),
        (
            {"state": state._replace(theta=np.zeros(7))},
            r"state.theta has the shape \(7,\), not \(2",
        ),
        ({"state": whole}, "state is TuneResult, not TuneState"),
    ]:
        with pytest.raises(ValueError, match=message):
            tuned(**({"state": state} | changes))


def test_minibatches_that_end_in_numbers_that_are_not_finite_give_the_last_that_were():
    found = tuned(optimizer=optax.sgd(1e6), batch_size=3)
    assert np.isnan(found.loss[-1]) and found.best == 0
    assert all(np.isfinite(x) and x > 0.0 for x in jax.tree.leaves(found.params))


def test_what_is_singular_or_on_a_bound_in_single_precision_is_tuned_on():
    """The loss wants a correlation of 1 and the bound: both are reached only by rounding."""

    def far(params, state, now):
        C, share = params["C"], params["share"]
        return state, (C[0, 1] / jnp.sqrt(C[0, 0] * C[1, 1]) - 2.0) ** 2 - share

    model, start = Model(lambda params, s: jnp.zeros(()), far), {"C": np.eye(2), "share": 0.5}
    transforms = {"C": CHOLESKY, "share": bounded(0.0, 1.0)}
    with jax.enable_x64(False):
        found = tuned(model, start, transforms=transforms, optimizer=optax.sgd(4.0), num_updates=99)
    assert np.isfinite(found.loss).all() and not found.skipped.any()
    np.testing.assert_allclose(found.loss[-1], 0.0, atol=0.02)


def test_standard_errors_say_where_the_loss_has_no_minimum():
    found = tuned(num_updates=25).params
    assert (
        standard_errors.standard_errors(
            WALK, found, Y, loss=mean_loss, transforms=POSITIVE
        ).warnings
        == ()
    )
    beside = {"q": found["q"], "r": 1.3 * found["r"]}
    (warning,) = standard_errors.standard_errors(
        WALK, beside, Y, loss=mean_loss, transforms=POSITIVE
    ).warnings
    assert warning.startswith("no minimum of the loss: it still falls along ") and "r by" in warning
    (warning,) = standard_errors.standard_errors(
        WALK,
        found | {"z": 1.0},
        Y,
        loss=mean_loss,
        transforms={"q": POSITIVE, "r": POSITIVE, "z": None},
    ).warnings
    assert "not identifiable from these 6 sequences: z; freeze" in warning
    assert "transforms.real(scale)" in warning
    with pytest.raises(ValueError, match="two sequences or more; sequences has 1"):
        standard_errors.standard_errors(WALK, found, Y[:1], loss=mean_loss, transforms=POSITIVE)


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_tuning_is_the_same_in_any_unit(unit):
    """By the likelihood, of positive parameters and in single precision."""
    model = Model(lambda params, s: (jnp.zeros(()), jnp.full((), unit**2)), step)
    with jax.enable_x64(False):
        ours, other = (
            tuned(a_model, jax.tree.map(lambda x, u=u: u * x, START), u * Y, num_updates=12)
            for a_model, u in ((WALK, 1.0), (model, unit))
        )
    for name in START:
        np.testing.assert_allclose(other.params[name] / unit, ours.params[name], rtol=5e-3)


def test_a_parameter_without_numbers_may_be_there_and_be_frozen():
    params = START | {"none": np.zeros((0, 3))}
    assert tuned(params=params, frozen=("none", "q")).params["q"] == 1.0


def test_only_gradients_of_short_data_are_compiled_quickly(monkeypatch):
    used = []

    class Recorded(DeviceMap):
        def __init__(self, function, **given):
            used.append(given["compile_quickly"])
            super().__init__(function, **given)

    monkeypatch.setattr(fitting, "DeviceMap", Recorded)
    monkeypatch.setattr(fitting, "QUICK_STEPS", 12)
    fitting._over_devices.cache_clear()
    model = Model(lambda params, data: 0.0, lambda params, state, x: (state, x * params))

    def mean(info, data):
        return info.mean()

    for count, quickly in ((3, True), (4, False)):
        data = np.ones((count, 4))
        found = fitting.values(model, jnp.float64(2.0), data, mean)
        value, gradient = fitting.gradients(model, jnp.float64(2.0), data, mean)
        np.testing.assert_allclose([found, value], 2.0)
        np.testing.assert_allclose(gradient, 1.0)
        assert used[-1] == quickly
    assert used == [False, True, False]
    fitting._over_devices.cache_clear()
