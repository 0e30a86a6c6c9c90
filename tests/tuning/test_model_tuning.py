"""Models of a user's own, tuned: a mean with known variance, whose estimate has a closed form."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.tuning import Model, Prior, bounded, fitting, real, standard_errors
from jaxslam.tuning.transforms import POSITIVE

B, T = 6, 10
RNG = np.random.default_rng(0)
DATA = {"y": RNG.normal(1.5, 0.7, (B, T))}


class Info(NamedTuple):
    """What `innovation_nll` needs."""

    log_likelihood: np.ndarray
    dof: np.ndarray
    nis: np.ndarray


def init(params, sequence):
    return jnp.zeros(())


def step(params, state, now):
    error = now["y"] - params["mean"]
    nis = (error / params["std"]) ** 2
    density = -0.5 * (nis + jnp.log(2 * jnp.pi)) - jnp.log(params["std"])
    return state, Info(density, jnp.int32(1), nis)


NORMAL = Model(init, step)
START = {"mean": np.array(0.0), "std": np.array(2.0)}
TRANSFORMS = {"mean": real(0.5), "std": POSITIVE}


def tuned(**changes):
    return fitting.tune(
        NORMAL, START, DATA, **({"transforms": TRANSFORMS, "num_updates": 25} | changes)
    )


def test_maximum_likelihood_is_the_mean_and_the_standard_deviation_of_the_data():
    found = tuned()
    y = DATA["y"]
    np.testing.assert_allclose(found.params["mean"], y.mean(), atol=1e-4)
    np.testing.assert_allclose(found.params["std"], y.std(), rtol=1e-4)
    assert found.history["std"].shape == (26,) and not found.skipped.any()


def test_standard_errors_in_units_of_the_parameters_are_those_of_the_sample():
    """Of the mean sqrt(J / B) / H: the spread of the sequences' means."""
    params = {"mean": np.array(DATA["y"].mean()), "std": np.array(DATA["y"].std())}
    found = standard_errors.standard_errors(NORMAL, params, DATA, transforms=TRANSFORMS)
    of_means = DATA["y"].mean(axis=1).std() / np.sqrt(B)
    np.testing.assert_allclose(found.of_params["mean"], of_means, rtol=2e-3)
    np.testing.assert_allclose(found.relative[0], of_means / 0.5, rtol=2e-3)
    np.testing.assert_allclose(found.of_params["std"], found.relative[1] * params["std"], rtol=1e-6)
    assert found.identifiable.all()
    frozen = standard_errors.standard_errors(
        NORMAL, params, DATA, transforms=TRANSFORMS, frozen=("std",)
    )
    assert np.isnan(frozen.of_params["std"]) and np.isfinite(frozen.of_params["mean"])


def test_a_prior_is_weighed_with_the_data_as_by_bayes():
    """Known std s, prior N(m, p^2): the mean is weighed by n / s^2 and 1 / p^2."""
    std, prior = 0.7, {"mean": Prior(-1.0, 0.05), "std": None}
    start = START | {"std": np.array(std)}
    options = {"transforms": TRANSFORMS, "prior": prior, "frozen": ("std",)}
    found = fitting.tune(NORMAL, start, DATA, num_updates=25, **options)
    n, y = B * T, DATA["y"].mean()
    precision = n / std**2 + 1 / 0.05**2
    expected = (n / std**2 * y - 1.0 / 0.05**2) / precision
    np.testing.assert_allclose(found.params["mean"], expected, atol=1e-5)


def test_a_prior_alone_is_the_standard_error_where_the_data_say_nothing():
    model = Model(init, lambda params, state, now: step(params | {"mean": 0.0}, state, now))
    params = {"mean": np.array(0.2), "std": np.array(1.6)}
    prior = {"mean": Prior(0.2, 0.03), "std": None}
    found = standard_errors.standard_errors(model, params, DATA, transforms=TRANSFORMS, prior=prior)
    assert not found.identifiable[0] and "mean" in found.warnings[0]
    np.testing.assert_allclose(np.sqrt(found.covariance[0, 0]), 0.03 / 0.5, rtol=1e-6)


def test_a_number_with_a_part_in_what_is_not_determined_has_that_as_its_error():
    """The data determine mean + 0.2 other; (-0.2, 1) changes nothing, and may change by 1."""

    def of_sum(params, state, now):
        return step(params | {"mean": params["mean"] + 0.2 * params["other"]}, state, now)

    y, transforms = DATA["y"], TRANSFORMS | {"mean": real(1.0), "other": real(1.0)}
    params = {"mean": np.array(y.mean()), "other": np.array(0.0), "std": np.array(y.std())}
    found = standard_errors.standard_errors(
        Model(init, of_sum), params, DATA, transforms=transforms
    )
    assert found.identifiable.tolist() == [True, False, True]
    errors = found.of_params
    of_means = y.mean(axis=1).std() / np.sqrt(B)
    np.testing.assert_allclose(
        errors["mean"] ** 2, (of_means / 1.04) ** 2 + 0.2**2 / 1.04, rtol=1e-2
    )
    of_sum_too = np.array([1.0, 0.2]) @ found.covariance[:2, :2] @ np.array([1.0, 0.2])
    np.testing.assert_allclose(np.sqrt(of_sum_too), of_means, rtol=1e-2)
    known = standard_errors.standard_errors(
        Model(init, of_sum), params, DATA, transforms=transforms, frozen=("other",)
    )
    np.testing.assert_allclose(known.of_params["mean"], of_means, rtol=2e-3)


def test_a_bounded_parameter_stays_within_its_bounds():
    """The likelihood wants 1.5; the bound is 1."""
    found = tuned(transforms=TRANSFORMS | {"mean": bounded(-1.0, 1.0)}, num_updates=40)
    assert 0.9 < found.params["mean"] < 1.0 and np.all(np.abs(found.history["mean"]) < 1.0)


def test_minibatches_held_out_data_and_resuming_work_as_for_the_filter():
    seen = []
    options = {"batch_size": 2, "heldout": {"y": DATA["y"][:3]}, "evaluate_every": 5, "seed": 1}
    whole = tuned(callback=seen.append, **options)
    again = tuned(state=seen[7], **options)
    np.testing.assert_array_equal(whole.loss, again.loss)
    assert np.isfinite(whole.heldout).sum() == 6


@pytest.mark.parametrize(
    "data, changes, message",
    [
        ({"y": np.zeros((0, T))}, {}, "data: no sequences"),
        ({"y": np.zeros((2, T)), "z": np.zeros((3, T))}, {}, r"differ .*: data\['y'\] 2, data"),
        ({"y": "text"}, {}, r"data\['y'\] is <U4 \(\), not an array of numbers"),
        ({}, {}, "data holds no arrays"),
        (DATA, {"loss": "pose_nll"}, "loss .*pose_nll.* is of episodes, which data are not"),
        (DATA, {"heldout": {"x": DATA["y"]}}, r"heldout is \['x'\], not \['y'\] as the data"),
        (DATA, {"prior": {"mean": 3.0}}, "prior is no tree"),
        (DATA, {"frozen": ("y",)}, "no parameter is called 'y'; known: mean, std"),
    ],
)
def test_data_that_do_not_fit_are_refused(data, changes, message):
    with pytest.raises(ValueError, match=message):
        fitting.tune(NORMAL, START, data, transforms=TRANSFORMS, **changes)


def test_what_is_no_model_is_refused():
    with pytest.raises(ValueError, match="model is function, not Config or a tuning.Model"):
        fitting.tune(step, START, DATA)
    with pytest.raises(ValueError, match="model.step is None, not a function"):
        fitting.tune(NORMAL._replace(step=None), START, DATA)
