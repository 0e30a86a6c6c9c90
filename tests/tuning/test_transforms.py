"""Transforms, names and priors of parameters in any tree."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.calibration import Calibration
from jaxslam.filtering.noise import NoiseParams
from jaxslam.tuning import parameters, transforms
from jaxslam.tuning.priors import Prior, flatten_prior
from jaxslam.tuning.transforms import CHOLESKY, POSITIVE, REAL, bounded, real

COV = np.array([[2.0, 0.3, -0.1], [0.3, 1.0, 0.2], [-0.1, 0.2, 0.5]])
TREE = {
    "std": np.array([0.1, 20.0]),
    "share": np.array(0.2),
    "cov": COV,
    "shift": np.array([[1.0, -2.0]]),
}
OF_TREE = {"std": POSITIVE, "share": bounded(-1.0, 3.0), "cov": CHOLESKY, "shift": real(0.5)}


@pytest.mark.parametrize("kind", [np, jnp])
def test_transforms_are_inverted_by_their_inverse_and_stay_in_their_domain(kind):
    for name, one in OF_TREE.items():
        value = kind.asarray(TREE[name])
        theta = one.inverse(value, *one.constants)
        np.testing.assert_allclose(one.forward(theta, *one.constants), value, rtol=1e-12)
        for by in (-3.0, 4.0):
            moved = np.asarray(one.forward(theta + by, *one.constants))
            assert one.domain(moved, *one.constants), (name, by)


def test_the_flat_vector_is_that_of_the_leaves_in_the_order_of_their_names():
    theta = parameters.flatten_params(TREE, OF_TREE)
    names = parameters.param_names(TREE, OF_TREE)
    assert names == (
        *("cov[0,0]", "cov[1,0]", "cov[1,1]", "cov[2,0]", "cov[2,1]", "cov[2,2]"),
        *("share", "shift[0,0]", "shift[0,1]", "std[0]", "std[1]"),
    )
    root = np.linalg.cholesky(COV)
    u, log_std = np.arcsinh(root / np.diagonal(root)[:, None]), np.log(np.diagonal(COV)) / 2
    expected = [log_std[0], u[1, 0], log_std[1], u[2, 0], u[2, 1]]
    expected += [log_std[2], np.log(1.2 / 2.8), 2.0, -4.0, np.log(0.1), np.log(20.0)]
    np.testing.assert_allclose(theta, expected, rtol=1e-12)
    back = parameters.unflatten_params(theta, TREE, OF_TREE)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-12), back, TREE)
    slopes = parameters.natural_jacobian(theta, TREE, OF_TREE)
    exact = jax.jacfwd(lambda x: jnp.concatenate([0.2 * jnp.ones(1), jnp.exp(x)]))(theta[-2:])
    np.testing.assert_allclose(slopes[-2:, -2:], exact[1:], rtol=1e-6)
    assert slopes.shape == (14, 11)


def test_a_covariance_has_the_same_numbers_in_all_units_but_for_the_logarithms():
    units = np.diag([1e-3, 1.0, 1e6])
    diagonal = np.array([True, False, True, False, False, True])
    theta, scaled = (CHOLESKY.inverse(cov) for cov in (COV, units @ COV @ units))
    np.testing.assert_allclose(scaled[~diagonal], theta[~diagonal], rtol=1e-9)
    np.testing.assert_allclose((scaled - theta)[diagonal], np.log(np.diagonal(units)), atol=1e-12)
    correlation = COV[1, 0] / np.sqrt(COV[0, 0] * COV[1, 1])
    np.testing.assert_allclose(theta[1], np.arctanh(correlation), rtol=1e-12)
    slopes = jax.jacfwd(CHOLESKY.forward)(jnp.asarray(theta))
    for i, e in enumerate(1e-6 * np.eye(6)):
        difference = (CHOLESKY.forward(theta + e) - CHOLESKY.forward(theta - e)) / 2e-6
        np.testing.assert_allclose(slopes[..., i], difference, atol=1e-8)


def test_names_freeze_a_number_a_leaf_or_a_part_of_the_tree():
    params = {"noise": NoiseParams.for_landmark_sensor(), "w": {"a": np.ones(2), "ab": np.ones(1)}}
    names = parameters.param_names(params)
    assert names[0] == "noise.odometry_coefficients[0]" and names[-1] == "w.ab[0]"
    for frozen, count in (
        (("noise",), 8),
        (("noise.range_std",), 1),
        (("noise.odometry_coefficients", "w.a[1]"), 5),
        (("w.a",), 2),
        (("noise.scan_match_std_scale",), 0),
    ):
        mask = parameters.trainable_mask(params, frozen)
        assert np.sum(~mask) == count, frozen
    with pytest.raises(ValueError, match="no parameter is called 'w.b'; known: noise.odom"):
        parameters.trainable_mask(params, ("w.b",))


def test_defaults_are_by_the_kind_of_record():
    params = (NoiseParams.for_laser_log(match_scans=True), Calibration.identity(), np.zeros(2))
    used = transforms.of_leaves(params)
    assert used == (*[POSITIVE] * 6, *transforms.CALIBRATION, REAL)
    part = (None, REAL, POSITIVE)
    assert transforms.of_leaves(params, part) == (*[POSITIVE] * 6, *[REAL] * 5, POSITIVE)


@pytest.mark.parametrize(
    "changes, given, message",
    [
        ({"std": np.array([0.1, 0.0])}, OF_TREE, r"params.std is \[0.1, 0.0\], not positive and"),
        ({"share": np.array(3.0)}, OF_TREE, "params.share is 3.0, not between -1 and 3 and finite"),
        ({"cov": -COV}, OF_TREE, "params.cov is .*, not positive definite and finite"),
        ({"shift": np.array([[np.nan, 0.0]])}, OF_TREE, r"params.shift is \[\[nan, 0.0\]\], not f"),
        ({"share": "a"}, OF_TREE, "params.share is a str, not a number"),
        (
            {},
            {"std": POSITIVE},
            "transforms is no tree like the parameters: it lacks cov, share, s",
        ),
        ({}, OF_TREE | {"x": REAL}, "like the parameters: it has beside them x; None"),
        ({"std": np.array([True, True])}, OF_TREE, "params.std is an array of bool, not a number"),
        ({"std": "1"}, OF_TREE, "params.std is a str, not a number"),
        ({"std": 1e400}, OF_TREE, "params.std is inf, not positive and finite"),
        ({"cov": np.ones((2, 2))}, OF_TREE, "params.cov is .*, not positive definite"),
        ({"cov": np.zeros((0, 0))}, OF_TREE, r"params.cov is \[\], not positive definite"),
        (
            {"cov": COV.tolist()},
            OF_TREE,
            r"params.cov\[0\]\[0\] is of the shape \(\), not a matrix",
        ),
        (
            {},
            OF_TREE | {"std": real((1.0, 1.0, 2.0))},
            r"std is .*, not numbers \(..., 3\) as their",
        ),
        ({}, OF_TREE | {"std": 3}, "transforms holds 3, not a Transform"),
    ],
)
def test_parameters_outside_their_domain_are_refused_by_name(changes, given, message):
    with pytest.raises(ValueError, match=message):
        parameters.as_params(TREE | changes, given)


def test_impossible_transforms_are_refused():
    with pytest.raises(ValueError, match="scale is 0.0, not positive"):
        real(0.0)
    with pytest.raises(ValueError, match="scale is 'a', not positive"):
        real("a")
    with pytest.raises(ValueError, match="bounds are 2.0 and 1.0"):
        bounded(2.0, 1.0)
    with pytest.raises(ValueError, match="bounds are a and 1.0, not finite numbers"):
        bounded("a", 1.0)
    with pytest.raises(ValueError, match="params holds no numbers"):
        parameters.as_params({})


def test_a_prior_is_the_normal_density_of_the_unconstrained_numbers():
    prior = {"std": Prior(0.2, [0.02, 0.1]), "share": None, "cov": None, "shift": Prior(0.0, 2.0)}
    flat = flatten_prior(prior, TREE, OF_TREE)
    np.testing.assert_allclose(flat.mean[-4:], [0.0, 0.0, np.log(0.2), np.log(0.2)])
    np.testing.assert_allclose(flat.precision[-4:], [1 / 16, 1 / 16, 100.0, 4.0], rtol=1e-8)
    assert not flat.precision[:-4].any()
    theta = parameters.flatten_params(TREE, OF_TREE)
    value, slope = flat.value_and_gradient(theta)
    expected = 0.5 * np.sum(flat.precision * (theta - flat.mean) ** 2)
    np.testing.assert_allclose(value, expected)
    for i, e in enumerate(1e-6 * np.eye(len(theta))):
        up, down = (flat.value_and_gradient(theta + by)[0] for by in (e, -e))
        np.testing.assert_allclose(slope[i], (up - down) / 2e-6, rtol=1e-6, atol=1e-9)
    nothing = flatten_prior(None, TREE, OF_TREE)
    assert nothing.value_and_gradient(theta)[0] == 0.0


@pytest.mark.parametrize(
    "prior, message",
    [
        ({"std": None}, "prior is no tree like the parameters: it lacks cov, share, shift"),
        (
            dict.fromkeys(TREE) | {"std": Prior([1, 2, 3], 1.0)},
            "prior of std is .*, not numbers, one",
        ),
        (
            dict.fromkeys(TREE) | {"std": Prior("a", 1.0)},
            "prior of std is .*, not numbers, one for",
        ),
        (
            dict.fromkeys(TREE) | {"std": Prior(1.0, 1e-200)},
            "prior of std is .*, not .* both finite",
        ),
        (dict.fromkeys(TREE, 3.0), "prior is no tree of Priors"),
        (dict.fromkeys(TREE) | {"std": Prior(-1.0, 1.0)}, "not a mean that is positive"),
        (dict.fromkeys(TREE) | {"std": Prior(1.0, 0.0)}, "a positive standard deviation"),
        (dict.fromkeys(TREE) | {"cov": Prior(1.0, 1.0)}, "is of a matrix, which has none"),
    ],
)
def test_impossible_priors_are_refused(prior, message):
    with pytest.raises(ValueError, match=message):
        flatten_prior(prior, TREE, OF_TREE)
