"""Studies: variants of a robot, its building and its filter, compared over many trials."""

from typing import TYPE_CHECKING

from jaxslam.core.lazy import lazy_names

if TYPE_CHECKING:
    from jaxslam.study.outcomes import Outcomes as Outcomes
    from jaxslam.study.outcomes import compare as compare
    from jaxslam.study.outcomes import failures_by_place as failures_by_place
    from jaxslam.study.outcomes import summarise as summarise
    from jaxslam.study.rare_failures import rare_failure as rare_failure
    from jaxslam.study.reporting import report as report
    from jaxslam.study.runner import Variant as Variant
    from jaxslam.study.runner import run as run
    from jaxslam.study.runner import run_timed as run_timed
    from jaxslam.study.trial_parameters import TrialErrors as TrialErrors
    from jaxslam.study.trials_from_noise import TrialsFromNoise as TrialsFromNoise
    from jaxslam.study.wording import findings as findings

__getattr__, __all__ = lazy_names(  # noqa: PLE0604
    __name__,
    {
        "jaxslam.study.outcomes": "Outcomes compare failures_by_place summarise",
        "jaxslam.study.rare_failures": "rare_failure",
        "jaxslam.study.reporting": "report",
        "jaxslam.study.runner": "Variant run run_timed",
        "jaxslam.study.trial_parameters": "TrialErrors",
        "jaxslam.study.trials_from_noise": "TrialsFromNoise",
        "jaxslam.study.wording": "findings",
    },
)
