"""Submaps around a circle, whose errors are draws of their covariances, and their true map."""

import numpy as np

from jaxslam.core import se2_np
from jaxslam.core.types import CORNER
from jaxslam.filtering.submaps import Submap

COUNT, RADIUS, OWN = 24, 40.0, 8  # submaps in a round, radius [m], landmarks of each
STD = np.array([0.05, 0.05, 0.01])  # [m, m, rad] of the last pose of a submap
LANDMARK_STD = 0.03  # [m]


def circle(seed, num_submaps=COUNT + 2):
    """Submaps, landmarks of each, true origins, true landmarks.

    A submap holds its own 8 landmarks and 4 of the next; a second round holds those of the first.
    """
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(num_submaps + 1) / COUNT
    xy = RADIUS * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    origins = np.column_stack([xy, se2_np.wrap_angle(angle)])
    shape = np.random.default_rng(5).uniform([-3.0, -8.0], [8.0, 8.0], size=(COUNT, OWN, 2))
    places = [se2_np.transform(origins[k], shape[k]) for k in range(COUNT)]
    landmarks = np.concatenate(places)
    submaps, index = [], []
    for i in range(num_submaps):
        own = OWN * (i % COUNT) + np.arange(OWN)
        held = np.append(own, (OWN * ((i + 1) % COUNT) + np.arange(4)))
        std = np.append(STD, np.full(2 * len(held), LANDMARK_STD))
        exact = np.append(
            se2_np.relative(origins[i], origins[i + 1]),
            se2_np.inverse_transform(origins[i], landmarks[held]).reshape(-1),
        )
        z = exact + std * rng.normal(size=len(std))
        kind, none = np.full(len(held), CORNER, np.int32), np.zeros(len(held))
        cov = np.diag(std**2)
        submaps.append(Submap(z[:3], z[3:].reshape(-1, 2), cov, kind, kind, none, none))
        index.append(held)
    return submaps, index, origins, landmarks


def numbered(index):
    """The same indices without gaps, and which landmarks they are."""
    kept, label = np.unique(np.concatenate(index), return_inverse=True)
    ends = np.cumsum([len(one) for one in index])[:-1]
    return np.split(label, ends), kept
