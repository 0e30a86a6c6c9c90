"""Checks of the data of the SLAM filter: noise and episodes. Nothing is compiled yet."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.episode import Episode
from jaxslam.core.features import Features
from jaxslam.core.measurement import ScanMatch
from jaxslam.core.types import check_array, check_type
from jaxslam.filtering.inputs import FLOATS, OTHERS, check_params, concrete_values
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline.stacking import stack_list

SCAN_MATCH_FIELDS: dict[str, tuple[int, ...]] = {
    "increment": (3,),
    "information": (3, 3),
    "inlier_fraction": (),
    "expected": (3,),
    "expected_variance": (3,),
    "odometry_weight": (),
}
"""Sizes after B and T of each field of `ScanMatch`; all are floats, the last three perhaps None."""

ORDER = "; the order is config, params, episodes"  # two that were swapped are the usual cause


def as_params(params: NoiseParams, *, positive: bool = True) -> NoiseParams:
    """Noise parameters as JAX arrays of the default float type, checked.

    Args:
        params: Numbers, lists, NumPy or JAX arrays; `scan_match_std_scale` may be None.
        positive: Whether the values are checked, too.

    Raises:
        ValueError: It is no `NoiseParams`, or a field has not its shape or is not finite and
            positive.
    """
    check_type("params", params, NoiseParams, advice=ORDER)
    params = check_params(params, check_values=positive)
    coefficients = concrete_values(params.odometry_coefficients)
    if positive and coefficients is not None and not (coefficients > 0.0).all():
        raise ValueError(
            f"params.odometry_coefficients is {coefficients.tolist()}, not positive: it is tuned "
            "by its logarithm"
        )
    return params


def as_episodes(episodes: Episode | list[Episode], *, name: str = "episodes") -> Episode:
    """Episodes [B] as arrays, floats in JAX's default precision, checked; values are not looked at.

    Args:
        episodes: [B] NumPy arrays, JAX arrays or lists; arrays that need no change are not copied.
            Or a list of B single episodes, which are stacked.
        name: What they are called in the error message.

    Raises:
        ValueError: It is no `Episode`, or a field has another shape or kind than it should.
    """
    episodes = stack_list(episodes)
    check_type(name, episodes, Episode, advice=ORDER)
    assert isinstance(episodes, Episode)
    check_type(f"{name}.features", episodes.features, Features)
    odometry = _convert(f"{name}.odometry", episodes.odometry, ("B", "T", 3), jnp.floating)
    b, t = odometry.shape[:2]
    kind = _convert(f"{name}.features.kind", episodes.features.kind, (b, t, "M"), jnp.integer)
    m = kind.shape[2]

    if not m:
        raise ValueError(f"{name}.features holds no feature, M = 0; give one with valid = False")

    def feature(field: str, x: Any) -> Any:
        if x is None and field == "incidence":
            return None
        shape = (b, t, m, *FLOATS.get(field, ()))
        family = jnp.floating if field in FLOATS else OTHERS[field][0]
        return _convert(f"{name}.features.{field}", x, shape, family)

    def optional(field: str, shape: tuple[int, ...], family: Any) -> Any:
        x = getattr(episodes, field)
        return None if x is None else _convert(f"{name}.{field}", x, shape, family)

    matches = episodes.scan_matches
    if matches is not None:
        check_type(f"{name}.scan_matches", matches, ScanMatch)
        given = matches._asdict()
        matches = ScanMatch(
            **{
                field: _convert(f"{name}.scan_matches.{field}", x, (b, t, *sizes), jnp.floating)
                for field, sizes in SCAN_MATCH_FIELDS.items()
                if (x := given[field]) is not None
            }
        )
    return Episode(
        truth=_convert(f"{name}.truth", episodes.truth, (b, t, 3), jnp.floating),
        odometry=odometry,
        features=Features(*map(feature, Features._fields, episodes.features)),
        landmark_ids=optional("landmark_ids", (b, t, m), jnp.integer),
        truth_mask=optional("truth_mask", (b, t), jnp.bool_),
        num_steps=optional("num_steps", (b,), jnp.integer),
        scan_matches=matches,
    )


def _convert(name: str, x: Any, shape: tuple[Any, ...], family: Any) -> Any:
    """An array of this shape and family of dtypes; one of NumPy stays one, a list becomes one."""
    if not isinstance(x, jax.Array | np.ndarray):
        try:
            x = np.asarray(x)
        except ValueError:
            raise ValueError(f"{name} is not an array: its parts differ in shape") from None
    is_integer = jnp.issubdtype(x.dtype, jnp.integer)
    wanted = x.dtype
    if family is jnp.floating and (is_integer or jnp.issubdtype(x.dtype, jnp.floating)):
        wanted = jnp.zeros(()).dtype
    elif family is jnp.integer and is_integer:
        wanted = np.dtype(np.int32)
    x = x if x.dtype == wanted else x.astype(wanted)
    check_array(name, x, shape, family)
    return x


def check_scan_matching(params: NoiseParams, episodes: Episode, *, name: str = "episodes") -> None:
    """Raise ValueError unless there is a factor on scan matching where there are scan matches."""
    matched = episodes.scan_matches is not None
    if matched and params.scan_match_std_scale is None:
        raise ValueError(
            f"params.scan_match_std_scale is None, but {name}.scan_matches are given; start from "
            "NoiseParams.for_laser_log(match_scans=True)"
        )
    if not matched and params.scan_match_std_scale is not None:
        raise ValueError(
            f"params.scan_match_std_scale is given, but {name}.scan_matches is None; give None, too"
        )


def check_alike(data: Any, heldout: Any) -> None:
    """Raise ValueError unless held-out sequences are of the kind of those to tune on.

    They have the same fields, and episodes the same number M of features a step; B and T may
    differ.
    """
    if not (isinstance(data, Episode) and isinstance(heldout, Episode)):
        if str(jax.tree.structure(data)) != str(jax.tree.structure(heldout)):
            wanted, found = (", ".join(sorted(_fields(each)))[:200] for each in (data, heldout))
            raise ValueError(
                f"heldout is {found or 'one array'}, not {wanted or 'one array'} as the data to "
                "tune on"
            )
        for name, x in _fields(data).items():
            own = _fields(heldout)[name]
            if np.ndim(own) != np.ndim(x) or own.dtype.kind != x.dtype.kind:
                raise ValueError(
                    f"heldout{name} is {own.dtype} {np.shape(own)}, of the data to tune on "
                    f"{x.dtype} {np.shape(x)}"
                )
        return
    for field in ("landmark_ids", "scan_matches"):
        ours, other = (getattr(part, field) is None for part in (data, heldout))
        if ours != other:
            without, given = ("episodes", "heldout") if ours else ("heldout", "episodes")
            raise ValueError(f"{without}.{field} is None, but {given}.{field} is not")
    m, other_m = (part.features.kind.shape[2] for part in (data, heldout))
    if m != other_m:
        raise ValueError(
            f"heldout has M = {other_m} features a step, episodes has {m}; pad them alike, as "
            "stack_episodes does"
        )


def _fields(data: Any) -> dict[str, Any]:
    """The arrays of a tree by their paths; a tree that is one array has the path of nothing."""
    leaves = jax.tree_util.tree_leaves_with_path(data)
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves}
