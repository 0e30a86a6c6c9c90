"""Static configuration of the topological map of a log, and its check."""

import math
from typing import NamedTuple

TOPOLOGIES = ("grid", "merged")
"""How the map can be made, for `MappingSpec.topology`."""


class MappingSpec(NamedTuple):
    """How the topological map of a log is made at its end; hashable.

    Attributes:
        topology: `"grid"`, the Voronoi diagram of all scans at their poses (`global_map`), or
            `"merged"`, the paper's: diagrams of single scans, merged without a grid
            (`topological_map`).
        robot_radius: [m] with `"grid"`, space narrower than twice this has no arcs, but where the
            robot drove.
    """

    topology: str = "grid"
    robot_radius: float = 0.2


def check_mapping_spec(spec: MappingSpec) -> None:
    """Raise ValueError, naming the field, unless a map can be made with a configuration."""
    if not isinstance(spec, MappingSpec):
        raise ValueError(f"mapping is a {type(spec).__name__}, not a MappingSpec")
    if spec.topology not in TOPOLOGIES:
        known = " or ".join(map(repr, TOPOLOGIES))
        raise ValueError(f"mapping.topology is {spec.topology!r}, not {known}")
    if not (math.isfinite(spec.robot_radius) and spec.robot_radius > 0.0):
        raise ValueError(
            f"mapping.robot_radius is {spec.robot_radius}, not a positive number of metres"
        )
