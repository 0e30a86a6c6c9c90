"""Track management: observations recorded, landmarks pruned, merged, added and evicted."""

import jax.numpy as jnp

from jaxslam.core.features import Features
from jaxslam.core.types import Array
from jaxslam.filtering import map_management
from jaxslam.filtering.belief import Belief, eviction_cost, prune, record_observations
from jaxslam.filtering.config import FilterConfig, confirmed
from jaxslam.filtering.data_association import Association, Matches
from jaxslam.filtering.match_verification import find_duplicate, missed_detection


def manage_tracks(
    config: FilterConfig, belief: Belief, features: Features, matches: Matches, is_known: bool
) -> tuple[Belief, Array, Array]:
    """Record the observations, prune landmarks that are not there, merge duplicates.

    Where correspondences are known, observations are recorded only. Of the landmarks that updated
    the state one is checked for a duplicate, in turn: row `step % K` of the update.

    Args:
        config: Static configuration.
        belief: Updated belief.
        features: Features of the scan.
        matches: Their matches.
        is_known: Whether correspondences are known.

    Returns:
        The belief, and the numbers () int32 of pruned landmarks and of merged duplicates.
    """
    belief = record_observations(belief, features, matches.slot)
    if is_known:
        return belief, jnp.int32(0), jnp.int32(0)
    used_slot = jnp.where(matches.used, matches.slot, belief.num_seen.size)[matches.order]
    belief, pruned = _prune(config, belief, jnp.any(features.valid))
    belief, merged = _merge_duplicate(config, belief, used_slot[belief.step % used_slot.size])
    return belief, pruned, merged


def _prune(config: FilterConfig, belief: Belief, any_feature: Array) -> tuple[Belief, Array]:
    """Prune landmarks that stay unconfirmed, and junctions whose detection is missed repeatedly.

    Args:
        config: Static configuration.
        belief: Updated belief, with the observations of this step recorded.
        any_feature: () bool; a scan without any feature is no evidence that a junction is gone.

    Returns:
        The belief, and the number () int32 of pruned landmarks.
    """
    missed = missed_detection(belief, config.field_of_view)
    missed &= (belief.last_seen < belief.step) & any_feature
    belief = belief._replace(num_missed=jnp.where(missed, belief.num_missed + 1, belief.num_missed))
    pruned = ~confirmed(config, belief) & (
        belief.step - belief.last_seen > config.max_unconfirmed_age
    )
    pruned = (pruned | (belief.num_missed >= config.max_misses)) & (belief.num_seen > 0)
    return prune(belief, pruned), jnp.sum(pruned, dtype=jnp.int32)


def _merge_duplicate(config: FilterConfig, belief: Belief, slot: Array) -> tuple[Belief, Array]:
    """Merge a landmark (slot (), L for none) with its duplicate, if any; the older id stays.

    Returns:
        The belief, and the number () int32 of merged duplicates.
    """
    size = belief.num_seen.size
    duplicate = find_duplicate(config.association, belief, slot)
    no_id = jnp.iinfo(jnp.int32).max
    duplicate_id = belief.id.at[duplicate].get(mode="fill", fill_value=no_id)
    own_id = belief.id.at[slot].get(mode="fill", fill_value=no_id)
    is_older = duplicate_id < own_id
    keep = jnp.where(is_older, duplicate, slot)
    merged = jnp.where(is_older, slot, duplicate)
    belief = map_management.merge(belief, jnp.minimum(keep, size - 1), merged)
    return belief, (duplicate < size).astype(jnp.int32)


def add_landmarks(
    config: FilterConfig,
    belief: Belief,
    features: Features,
    features_cov: Array,
    found: Association,
) -> tuple[Belief, Array, Array]:
    """Add the new features to the map; a full map evicts unconfirmed landmarks for them.

    Args:
        config: Static configuration.
        belief: Belief with its tracks managed.
        features: Features of the scan.
        features_cov: (M, 2, 2) their measurement covariance R.
        found: Their association, which says which are new.

    Returns:
        The belief, the slot (M,) int32 of each new landmark (L for none), and the number () int32
        of evicted ones.
    """
    cost = eviction_cost(belief, confirmed(config, belief), evict_after=config.evict_after)
    mapped, new_slot = map_management.augment(
        belief,
        features,
        features_cov,
        found.is_new,
        max_new=config.max_new,
        new_slot=found.new_slot,
        cost=cost,
        linearisation=config.linearisation,
    )
    replaced = belief.num_seen.at[new_slot].get(mode="fill", fill_value=0) > 0
    return mapped, new_slot, jnp.sum(replaced, dtype=jnp.int32)
