"""A small network as the noise model of the filter, tuned like any parameters."""

import jax
import jax.numpy as jnp
import landmark_drives
import numpy as np

from jaxslam.core.episode import Episode
from jaxslam.filtering.heteroscedastic import MeasurementWeights
from jaxslam.filtering.noise_model import NoiseModel
from jaxslam.pipeline.config import Config
from jaxslam.tuning import fitting
from jaxslam.tuning.losses import innovation_nll

TRUE = landmark_drives.PARAMS._replace(
    measurement_weights=MeasurementWeights(range=jnp.array([0.8, 0.0, 0.0]))
)


def network_noise(layers, features, measurement, R):
    """R with the standard deviations times exp(network(range)): two hidden layers."""
    x = jnp.linalg.norm(features.xy, axis=1, keepdims=True) / 4.0 - 1.0
    for w, b in layers[:-1]:
        x = jnp.tanh(x @ w + b[None])
    w, b = layers[-1]
    factor = jnp.exp(jnp.clip(x @ w + b[None], -5.0, 5.0))  # (M, 2): of range, of bearing
    return R * factor[:, :, None] * factor[:, None]


def random_layers(key, sizes=(1, 6, 6, 2)):
    keys = jax.random.split(key, len(sizes) - 1)
    layers = [
        [jax.random.normal(k, (n, m)) / np.sqrt(n), jnp.zeros(m)]
        for k, n, m in zip(keys, sizes[:-1], sizes[1:], strict=True)
    ]
    layers[-1][0] *= 0.0  # noise as without the network, at first
    return layers


def test_a_network_learns_how_noise_depends_on_range():
    truth, given = landmark_drives.drives(jax.random.key(0), TRUE, count=24, steps=25)
    drives = Episode(truth, given.odometry, given.features, given.landmark_ids)
    train, test = (jax.tree.map(lambda x, s=s: x[s], drives) for s in (slice(16), slice(16, None)))
    constant = Config(filter=landmark_drives.CONFIG)
    config = Config(
        filter=landmark_drives.CONFIG._replace(noise_model=NoiseModel(measurement=network_noise))
    )
    start = landmark_drives.PARAMS._replace(custom=random_layers(jax.random.key(1)))
    fixed = ("odometry_coefficients", "feature_std_scale", "wall_angle_std")
    found = fitting.tune(
        config, start, train, loss=innovation_nll, num_updates=25, frozen=fixed
    ).params
    before, after = (fitting.values(config, p, test, innovation_nll) for p in (start, found))
    best = fitting.values(constant, TRUE, test, innovation_nll)
    lost = after - best  # against the noise that is true
    assert lost.mean() < 0.2 * (before - best).mean()
    assert (before - after).mean() > 5 * (before - after).std() / np.sqrt(len(before))
