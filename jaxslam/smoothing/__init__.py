"""Batch smoothing: `smooth_trial` for short trials, `smooth_log` for a long log; see README.md."""

from jaxslam.smoothing.dense import smooth_trial as smooth_trial
from jaxslam.smoothing.numbering import NumberedLandmarks as NumberedLandmarks
from jaxslam.smoothing.numbering import number_landmarks as number_landmarks
from jaxslam.smoothing.problem import LandmarkPrior as LandmarkPrior
from jaxslam.smoothing.problem import SmoothingProblem as SmoothingProblem
from jaxslam.smoothing.problem import SmoothingResult as SmoothingResult
from jaxslam.smoothing.problem import build_problem as build_problem
from jaxslam.smoothing.sparse import smooth_log as smooth_log
