"""The command `jaxslam run LOG`."""

from pathlib import Path
from typing import Annotated, Literal

import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

from jaxslam.cli import report, summaries
from jaxslam.cli.options import check_range, enable_caches, name_errors, read_params, stopwatch
from jaxslam.core.measurement import Measurement
from jaxslam.core.scan import Scan
from jaxslam.core.se2_np import relative
from jaxslam.evaluation import log_errors
from jaxslam.filtering.config import confirmed
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import lidar
from jaxslam.io import readers, tum
from jaxslam.io.output import folder
from jaxslam.io.relations import read
from jaxslam.pipeline import episodes, offline
from jaxslam.pipeline.config import MAX_LANDMARKS, Config
from jaxslam.pipeline.offline import SlamResult
from jaxslam.pipeline.online import ChunkResult, SlamState
from jaxslam.viz import animation
from jaxslam.viz.rerun_view import RerunView


def run(
    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="LOG")],
    reference: Path | None = None,
    relations: Path | None = None,
    odometry: Literal["scan", "wheels"] = "scan",
    smooth: bool = True,
    noise: Path | None = None,
    scan_topic: str | None = None,
    odometry_topic: str | None = None,
    scan: int | None = None,
    animate: bool = False,
    view: Literal["live", "file"] | None = None,
    out: Path = Path("out"),
) -> None:
    """Run SLAM on a laser log.

    Writes metrics.json, trajectory.tum, path.png and errors.png; the topological map as map.geojson
    and, with the extra [graph], map.graphml; an occupancy grid as map.yaml and map.pgm, for
    map_server and `jaxslam map`; and the pose graph graph.g2o, for batch optimisers. The pose of
    the first scan is the origin of the map.

    Args:
        log: CARMEN log, ROS bag, g2o pose graph with scans, or NumPy file; `killian` is the log
            that the extra [data] installs.
        reference: Reference trajectory to evaluate with: a TUM file with the log's clock.
        relations: Verified relative poses to evaluate with, with the log's clock.
        odometry: Scan matching fused with wheel odometry (scan), or wheel odometry alone (wheels).
        smooth: Batch-smooth the trajectory and landmarks, with loop closures; --no-smooth writes
            the online estimates.
        noise: File of the noise parameters of the filter (Q and R); by default cautious ones.
        scan_topic: Topic of the laser scans in a bag; by default the one with most messages.
        odometry_topic: Topic of the odometry or of the transforms in a bag; by default the one
            with most messages.
        scan: Number of a scan, from 0, whose local Voronoi diagram is drawn: scan.png.
        animate: Write an animation of the run: run.gif.
        view: Show the run in the rerun viewer while it is processed (live), or write run.rrd for it
            (file); needs the extra [view].
        out: Folder for the results.
    """
    laser_log = readers.read(log, scan_topic=scan_topic, odometry_topic=odometry_topic)
    times = laser_log.times
    known = None if reference is None else tum.read(reference)
    verified = None if relations is None else read(relations)
    scan_matching = odometry == "scan"
    noise_params = read_params(noise, NoiseParams.for_laser_log(match_scans=scan_matching))
    if scan is not None:
        check_range("--scan", scan, 0, len(times) - 1)
    config = episodes.laser_log_config([laser_log])._replace(
        filter=episodes.laser_log_config([laser_log]).filter._replace(
            max_landmarks=MAX_LANDMARKS,
        ),
    )
    odom_poses = relative(laser_log.odom_poses[0], laser_log.odom_poses)
    with name_errors(f"{reference or ''}"):
        dead_reckoning = log_errors.errors_against(laser_log, odom_poses, known, None)
    with name_errors(f"{relations or ''}"):
        dead_reckoning |= log_errors.errors_against(laser_log, odom_poses, None, verified)
    increments = episodes.odometry_increments(odom_poses)
    scans = lidar.to_scan(config.frontend.lidar, jnp.asarray(laser_log.ranges, float))
    with folder(out) as out_dir:
        enable_caches()
        size = f"{len(times)} scans of {config.frontend.lidar.num_beams} beams"
        print(f"{log}: {size}{laser_log.source}", flush=True)
        with stopwatch() as seconds:
            viewer = None
            if view is not None:
                file = out_dir / "run.rrd" if view == "file" else None
                viewer = RerunView(config, times, scans, file)
            result = _run_slam(
                config,
                noise_params,
                increments,
                scans,
                aligned=scan_matching,
                smooth=smooth,
                viewer=viewer,
            )
            poses = result.poses
        numbers = {
            "scans": len(poses),
            "skipped_lines": laser_log.num_skipped,
            "mended": laser_log.odometry_repairs,
            "odometry": odometry,
            "path_length_m": log_errors.path_length(poses if scan_matching else odom_poses),
            "landmarks": int(np.sum(confirmed(config.filter, result.belief))),
            "matches": float(np.mean(np.sum(np.asarray(result.info.used), axis=1))),
            "closures": len(result.loop_closures.first) if result.loop_closures else 0,
            "seconds": seconds,
        }
        trajectories, error = {"odometry": odom_poses}, None
        online_poses = np.asarray(result.info.pose, np.float64)
        if known is not None:
            trajectories["reference"] = log_errors.reference_in_map(times, poses, known)
            error = log_errors.errors_since_start(times, online_poses, known)
            numbers["nees"] = log_errors.mean_nees_per_dof(error, np.asarray(result.info.pose_cov))
        if dead_reckoning:
            numbers |= log_errors.errors_against(laser_log, poses, known, verified)
            if smooth:
                numbers["filter"] = log_errors.errors_against(
                    laser_log, online_poses, known, verified
                )
            numbers["dead_reckoning"] = dead_reckoning
        report.write_results(out_dir, numbers, times, result)
        inputs = Measurement(
            jnp.asarray(increments, float), result.features, scan_match=result.scan_matches
        )
        config = config._replace(
            filter=config.filter._replace(
                max_landmarks=result.belief.num_seen.size,
            ),
        )
        report.write_maps(out_dir, config, noise_params, result, inputs, scans)
        report.draw(out_dir, config, result, trajectories, error, scans=scans)
        if scan is not None:
            report.draw_scan(out_dir / "scan.png", config, scans, scan)
        if animate:
            gif = out_dir / "run.gif"
            animation.animate_run(gif, config, noise_params, inputs, scans, poses, odom_poses)
    summaries.print_summary(numbers, f"{len(poses)} scans of {log}", out)


def _run_slam(
    config: Config,
    noise: NoiseParams,
    increments: np.ndarray,
    scans: Scan,
    *,
    aligned: bool,
    smooth: bool,
    viewer: RerunView | None,
) -> SlamResult:
    """Run SLAM on a log, with a progress bar."""
    with tqdm(total=len(increments), unit="scan", desc="compiling", mininterval=0.2) as bar:

        def show_progress(mapper: SlamState, part: ChunkResult) -> None:
            done = bar.n + len(part.info.finite) == len(increments)
            bar.set_description("smoothing" if done and smooth else "mapping", refresh=False)
            num_landmarks = int(np.sum(confirmed(config.filter, mapper.belief)))
            bar.set_postfix_str(f"{num_landmarks} landmarks", refresh=False)
            bar.update(len(part.info.finite))
            if viewer is not None:
                viewer.watch(mapper, part)

        result = offline.run_slam(
            config,
            noise,
            jnp.zeros(3),
            increments,
            scans,
            match_scans=aligned,
            smooth=smooth,
            callback=show_progress,
        )
    if viewer is not None:
        viewer.end(result)
    return result
