"""How good topological maps are for going places, and how true, beside other graphs.

graphs of logs in --data, of map_server maps in --maps, and of simulated buildings with wide halls:
    grid, merged       what `jaxslam run` makes, with `MappingSpec.topology` of either name
    map                what `jaxslam map` makes of the occupancy map
    thinning, brushfire  peers, of the same occupancy map (`peer_roadmaps`)
each measured by routes between random places (`route_measures`) and as SWAGGER evaluates its graphs
(`waypoint_measures`).

plans: random floor plans are driven through and mapped; the branches of the map, without arcs
through open space, are compared with the Voronoi graph of the walls (`plan_graph`): by its rules
(`strict`), and by the best of such as differ by no more than its tolerances (`within`).
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from tqdm import tqdm

from experiments import (
    common,
    hall_plans,
    log_folder,
    peer_roadmaps,
    plan_drives,
    plan_graph,
    route_measures,
    waypoint_measures,
)
from experiments.common import Numbers
from experiments.ground_truth import without_padding
from experiments.plan_agreement import agreement, branches_of
from experiments.roadmaps import Ground, Roadmap
from experiments.topology_picture import draw, picture_of
from jaxslam.core.caches import enable_caches
from jaxslam.core.maps import OccupancyMap
from jaxslam.core.scan import Scan
from jaxslam.io import ros_map
from jaxslam.mapping.config import MappingSpec
from jaxslam.mapping.grid_topology import extract_topology
from jaxslam.pipeline import log_input, mapping_stage
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.results import SlamResult
from jaxslam.simulation import floor_plans

NAME = "topology"
ROBOT_RADIUS = 0.2  # [m]
GRID, MERGED = MappingSpec("grid", ROBOT_RADIUS), MappingSpec("merged")
LEAST_AREA = 8.0  # [m^2] The log with the most rooms as large as this is drawn.
HALL_SPACING, PLAN_SPACING = 4.0, 1.5  # [m] between the places that a drive visits


class Subject(NamedTuple):
    """An occupancy map and the graphs of it.

    Attributes:
        kind: "log", "map" or "hall".
        name: Of the log, map or building.
        occupancy: The map by which graphs are measured.
        poses: (T, 2) [m] where the robot was; None if there was none.
        roadmaps: Graphs by method.
    """

    kind: str
    name: str
    occupancy: OccupancyMap
    poses: np.ndarray | None
    roadmaps: dict[str, Roadmap]


def of_run(kind: str, name: str, config: Config, scans: Scan, merged: SlamResult) -> Subject:
    """Both graphs of a run whose topological map is the merged one."""
    grid = mapping_stage.with_maps(config._replace(mapping=GRID), scans, merged, None)
    poses = grid.poses[np.isfinite(grid.poses[:, 0]), :2]
    own = {"grid": grid.topological_map, "merged": merged.topological_map}
    roadmaps = {method: Roadmap.of_map(graph) for method, graph in own.items()}
    assert grid.occupancy is not None
    return Subject(kind, name, grid.occupancy, poses, roadmaps)


def of_logs(folder: Path | None) -> Iterator[Subject]:
    """The logs of a folder, each run once."""
    logs = log_folder.find_logs(folder, installed=False) if folder else []
    for name, log in zip(log_folder.unique_names(logs), logs, strict=True):
        given = log_input.from_laser_log(log.laser_log)
        given = given._replace(config=given.config._replace(mapping=MERGED))
        yield of_run("log", name, given.config, given.scans, log_input.run(given))


def of_maps(folder: Path | None) -> Iterator[Subject]:
    """The map_server maps of a folder."""
    for path in sorted(folder.rglob("*.yaml")) if folder else ():
        grid = ros_map.read(path)
        found = extract_topology(
            grid.occupied,
            grid.free,
            resolution=grid.resolution,
            origin=grid.origin,
            robot_radius=ROBOT_RADIUS,
        )
        yield Subject("map", path.stem, grid, None, {"map": Roadmap.of_map(found.graph)})


def of_halls(seed: int) -> Iterator[Subject]:
    """Buildings with wide halls, driven through."""
    for name, walls in hall_plans.BUILDINGS.items():
        log = plan_drives.drive(seed, walls(), spacing=HALL_SPACING)
        yield of_run("hall", name, *_mapped(log))


def _mapped(log: plan_drives.PlanLog) -> tuple[Config, Scan, SlamResult]:
    config, result = plan_drives.mapped(log)
    return config, log.scans, result


def rows_of(subject: Subject, seed: int, num_routes: int) -> list[Numbers]:
    """A row of measures for each graph of a subject, those of the peers too."""
    ground = Ground.of_map(subject.occupancy, ROBOT_RADIUS)
    rng = np.random.default_rng(seed)
    if subject.poses is None:
        places = route_measures.free_places(rng, ground, num_routes)
    else:
        places = route_measures.choose_places(rng, subject.poses, num_routes)
    by = route_measures.shortest_paths(ground, places)
    roadmaps = dict(subject.roadmaps)
    for name, peer in peer_roadmaps.available().items():
        roadmaps[name] = peer(ground, ROBOT_RADIUS)
    return [
        {
            "kind": subject.kind,
            "name": subject.name,
            "method": method,
            **route_measures.measure(by, roadmap),
            "waypoints": waypoint_measures.measure(
                np.random.default_rng(seed), ground, roadmap, num_routes
            ),
        }
        for method, roadmap in roadmaps.items()
    ]


def plan_row(number: int) -> Numbers:
    """How much of the graph of a random floor plan a map has that was made on a drive."""
    walls = without_padding(np.asarray(floor_plans.floor_plan(jax.random.key(number)).walls))
    log = plan_drives.drive(number, walls, spacing=PLAN_SPACING)
    config, merged = plan_drives.mapped(log)
    mapped = mapping_stage.with_maps(config._replace(mapping=GRID), log.scans, merged, None)
    found = branches_of(mapped.topological_map, plan_drives.to_world(log, mapped))
    ridges = plan_graph.branches(walls)
    scores = [
        score_of(plan_graph.plan_graph(ridges, log.truth[0, :2], rules), found)
        for rules in plan_graph.variants()
    ]
    within = min(scores, key=errors_of)
    return {"plan": number, "scans": len(log.truth), "strict": scores[0], "within": within}


def score_of(true: plan_graph.PlanGraph, found: plan_graph.PlanGraph) -> Numbers:
    """Numbers of the nodes and arcs of a plan, of a map, and of those in both."""
    same = agreement(true, found)
    return {
        "true_nodes": len(true.xy),
        "nodes": len(found.xy),
        "nodes_found": int(np.sum(same.node >= 0)),
        "true_arcs": len(true.ends),
        "arcs": len(found.ends),
        "arcs_found": int(np.sum(same.arc >= 0)),
        "node_errors_m": same.error[same.node >= 0],
        "missed": true.xy[same.node < 0],
        "spurious": found.xy[~np.isin(np.arange(len(found.xy)), same.node)],
    }


def errors_of(score: Numbers) -> int:
    """Number of nodes and arcs that are missed or spurious."""
    return sum(
        score[f"true_{kind}"] + score[kind] - 2 * score[f"{kind}_found"]
        for kind in ("nodes", "arcs")
    )


def totals_of(scores: list[Numbers]) -> Numbers:
    """Shares over all plans."""
    if not scores:
        return {}
    keys = ("true_nodes", "nodes", "nodes_found", "true_arcs", "arcs", "arcs_found")
    total = {key: sum(score[key] for score in scores) for key in keys}
    errors = np.concatenate([score["node_errors_m"] for score in scores])
    return {
        "plans": len(scores),
        "true_nodes": total["true_nodes"],
        "true_arcs": total["true_arcs"],
        "nodes_found": total["nodes_found"] / max(total["true_nodes"], 1),
        "arcs_found": total["arcs_found"] / max(total["true_arcs"], 1),
        "nodes_spurious": 1.0 - total["nodes_found"] / max(total["nodes"], 1),
        "arcs_spurious": 1.0 - total["arcs_found"] / max(total["arcs"], 1),
        "node_error_median_m": float(np.median(errors)),
        "node_error_worst_m": float(errors.max()),
    }


def compute(
    seed: int, data: Path | None, maps: Path | None, num_plans: int, num_routes: int
) -> Numbers:
    """The rows of all graphs and plans, and what is drawn of one log."""
    rows, pictures = [], {}
    for source in (of_logs(data), of_maps(maps), of_halls(seed)):
        for subject in source:
            found = rows_of(subject, seed, num_routes)
            for row in found:
                print(line_of(row), flush=True)
            rows += found
            if subject.poses is not None:
                pictures[subject.name] = picture_of(
                    subject.occupancy, subject.roadmaps["grid"], ROBOT_RADIUS
                )
    numbers = range(1000 * seed, 1000 * seed + num_plans)
    plans = [plan_row(number) for number in tqdm(numbers, unit="plan", leave=False)]
    drawn = max(
        (row for row in rows if row["method"] == "merged"),
        key=lambda row: (row["kind"] == "log", _large_rooms(pictures[row["name"]])),
    )
    return {
        "seed": seed,
        "robot_radius_m": ROBOT_RADIUS,
        "graphs": rows,
        "plans": plans,
        "plan_totals": {
            how: totals_of([plan[how] for plan in plans]) for how in ("strict", "within")
        },
        "drawn": {"name": drawn["name"], **pictures[drawn["name"]]},
    }


def _large_rooms(drawn: Numbers) -> int:
    return sum(room["area_m2"] >= LEAST_AREA for room in drawn["rooms"])


def line_of(row: Numbers) -> str:
    """One line on a graph."""
    detours = (row[key] for key in ("detour_median", "detour_p90"))
    median, most = ("-" if x is None else f"{x:.2f}" for x in detours)
    waypoints = row["waypoints"]
    return (
        f"{row['kind']:4} {row['name']:14} {row['method']:9} nodes {row['nodes']:4} arcs "
        f"{row['arcs']:4} parts {row['parts']:3} lonely {row['lonely']:2} blocked "
        f"{row['blocked']:.2%} reach {row['reach']:.3f} covered {row['covered']:.3f} routed "
        f"{row['routed']:.3f} detour {median} {most} free arcs "
        f"{waypoints.get('collision_free', 0.0):.3f}"
    )


def main(argv: list[str] | None = None) -> int:
    """Run the experiment from the command line."""
    given = common.parse(__doc__, argv, data="", maps="", plans=8, routes=300)
    enable_caches()
    data, maps = (log_folder.checked_folder(name) for name in (given.data, given.maps))
    numbers = compute(given.seed, data, maps, given.plans, given.routes)
    for how, totals in numbers["plan_totals"].items():
        print(f"plans, {how}:", ", ".join(f"{key} {value:.3f}" for key, value in totals.items()))
    common.save(given.out, NAME, numbers, draw)
    return 0


if __name__ == "__main__":
    raise SystemExit(common.report_errors(NAME)(main)())
