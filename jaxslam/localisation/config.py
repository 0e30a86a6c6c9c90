"""Options of localisation, and the records that pass between its stages."""

from typing import NamedTuple

from jaxslam.core.scan import Scan
from jaxslam.core.types import Array
from jaxslam.matching import checks
from jaxslam.matching.place_index import PlaceIndex, PlaceSpec, check_place_spec


class LocaliseSpec(NamedTuple):
    """Options of localisation; static under jit.

    Attributes:
        place: Of the index of the map and of the search in it.
        num_hypotheses: H, poses that are tracked at once.
        gates: [m] largest distance of a point from its wall in tracking, iteration by iteration.
        point_std: [m] of a point's distance from its wall. Much larger than that of a range, as
            the errors of neighbouring points are correlated.
        odometry_std_floor: [m], [rad] least std of the odometry from scan to scan.
        odometry_slip: Its std as fractions of distance and of turn.
        start_std: [m], [rad] std of a pose that the search finds.
        given_std: [m], [rad] std of a pose that is given at the start.
        window_scans: W, scans that a search looks for together, joined by odometry.
        window_distance: [m], [rad] motion from one of them to the next; also that motion from
            which on a scan is as much evidence as one that is alone.
        score_weight: Log likelihood of a score of 1 against one of 0.
        memory: Share of the log likelihood that is kept from one such motion to the next.
        nowhere_score: Score of being at a place that the map does not show.
        path_windows: Such motions that the mean score of a path is of, at most.
        max_log_odds: Largest difference of two log weights; who has less is given up.
        given_log_odds: Log odds of a pose that is given at the start.
        found_log_odds: Log odds of a pose that the search finds against the best one that is
            tracked, where they explain the last scans equally well: if that was found just now, and
            if it has been tracked for 10 m or more, as few robots are carried.
        lost_score: Score below which the best hypothesis does not explain a scan.
        lost_scans: Scans after which a lost robot that does not move is looked for again.
        search_share: Share of the path since the pose was found after which the map is searched
            again,
        search_distance: [m] but no less and no more than these.
        search_block: Robots of a batch that are looked for at once.
    """

    place: PlaceSpec = PlaceSpec(num_candidates=6)
    num_hypotheses: int = 8
    gates: tuple[float, ...] = (0.5, 0.35, 0.2, 0.15, 0.1)
    point_std: float = 0.1
    odometry_std_floor: tuple[float, float] = (0.02, 0.01)
    odometry_slip: tuple[float, float] = (0.05, 0.05)
    start_std: tuple[float, float] = (0.2, 0.05)
    given_std: tuple[float, float] = (0.4, 0.2)
    window_scans: int = 6
    window_distance: tuple[float, float] = (0.5, 0.5)
    score_weight: float = 40.0
    memory: float = 0.9
    nowhere_score: float = 0.55
    path_windows: float = 20.0
    max_log_odds: float = 20.0
    given_log_odds: float = 10.0
    found_log_odds: tuple[float, float] = (-4.0, -10.0)
    lost_score: float = 0.5
    lost_scans: int = 10
    search_share: float = 0.25
    search_distance: tuple[float, float] = (0.5, 10.0)
    search_block: int = 8


class PlaceMap(NamedTuple):
    """What localisation needs of a map.

    Attributes:
        places: Index: where its walls are, and where a robot may stand.
        free: (G, H) bool, cells of its grid that the map saw to be free, away from walls.
        range_max: () [m] reach of the scanner that made it; what a robot sees beyond is not used.
    """

    places: PlaceIndex
    free: Array
    range_max: Array


class Hypotheses(NamedTuple):
    """Where the robot may be; H of them.

    Attributes:
        poses: (H, 3) [m, m, rad] map frame.
        cov: (H, 3, 3) their covariances, if they are right.
        log_weight: (H,) log likelihood; -inf where there is no hypothesis.
        score: (H,) mean score of the last scans.
        path_score: (H,) mean score since it was found, of `path_windows` at most.
        windows: (H,) evidence of that mean, in windows.
        driven: (H,) [m] since it was found.
    """

    poses: Array
    cov: Array
    log_weight: Array
    score: Array
    path_score: Array
    windows: Array
    driven: Array


class Window(NamedTuple):
    """Scans of the last few metres, W - 1 of them; a slot that is not used has no hit.

    Attributes:
        scans: [W - 1].
        poses: (W - 1, 3) [m, m, rad] in the frame of the scan that came last.
        used: (W - 1,) bool.
        num_added: () int32.
    """

    scans: Scan
    poses: Array
    used: Array
    num_added: Array


class LocaliseState(NamedTuple):
    """What is known of a robot after some scans.

    Attributes:
        hypotheses: Where it may be.
        nowhere: () log likelihood of being where the map does not show.
        window: Its scans of the last few metres.
        lost: () bool, whether no hypothesis explained the last scan.
        searched_distance: () [m] driven since the last search.
        searched_scans: () int32 scans since then.
    """

    hypotheses: Hypotheses
    nowhere: Array
    window: Window
    lost: Array
    searched_distance: Array
    searched_scans: Array


class LocaliseInfo(NamedTuple):
    """Result for one scan.

    Attributes:
        pose: (3,) [m, m, rad] of the scanner, map frame: the most likely one.
        cov: (3, 3) its covariance, if it is right.
        probability: () that the pose is within `RIGHT` of the true one, rather too low.
        log_odds: () of the pose against all other hypotheses.
        score: () mean score of the pose over the last scans.
        scan_score: () its score of this scan.
        path_score: () mean score since the pose was found.
        windows: () evidence of that mean, in windows.
        driven: () [m] since the pose was found.
        num_hypotheses: () int32.
        searched: () bool, whether the map was searched at this scan.
    """

    pose: Array
    cov: Array
    probability: Array
    log_odds: Array
    score: Array
    scan_score: Array
    path_score: Array
    windows: Array
    driven: Array
    num_hypotheses: Array
    searched: Array


def check_localise_spec(spec: LocaliseSpec) -> None:
    """Check the options of localisation.

    Raises:
        ValueError: One is out of range; the message names it.
    """
    checks.check_static("spec", spec, LocaliseSpec)
    check_place_spec(spec.place)
    for field in ("num_hypotheses", "window_scans", "lost_scans", "search_block"):
        checks.check_at_least(f"spec.{field}", getattr(spec, field), 1)
    checks.check_at_least("spec.window_scans", spec.window_scans, 2)
    checks.check_positive("spec.point_std", spec.point_std)
    checks.check_at_least("spec.path_windows", spec.path_windows, 1)
    pairs = "odometry_std_floor start_std given_std window_distance search_distance"
    for field in (*pairs.split(), "gates"):
        for value in getattr(spec, field):
            checks.check_positive(f"spec.{field}", value)
    for field in ("score_weight", "max_log_odds", "search_share"):
        checks.check_positive(f"spec.{field}", getattr(spec, field))
    if not 0.0 <= spec.memory <= 1.0:
        raise ValueError(f"spec.memory is {spec.memory}, not 0 to 1")
