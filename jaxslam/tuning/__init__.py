"""Noise parameters (Q and R) tuned by gradient; see README.md here.

The function `standard_errors` is in the module of the same name.
"""

from jaxslam.tuning.fitting import gradients as gradients
from jaxslam.tuning.fitting import tune as tune
from jaxslam.tuning.fitting import values as values
from jaxslam.tuning.losses import BY_NAME as BY_NAME
from jaxslam.tuning.losses import Loss as Loss
from jaxslam.tuning.losses import WeightedLoss as WeightedLoss
from jaxslam.tuning.losses import innovation_nll as innovation_nll
from jaxslam.tuning.losses import pose_mse as pose_mse
from jaxslam.tuning.losses import pose_nll as pose_nll
from jaxslam.tuning.optimizers import default_optimizer as default_optimizer
from jaxslam.tuning.optimizers import lbfgs_backtracking as lbfgs_backtracking
from jaxslam.tuning.parameters import param_names as param_names
from jaxslam.tuning.standard_errors import StandardErrors as StandardErrors
from jaxslam.tuning.tune_state import TuneResult as TuneResult
from jaxslam.tuning.tune_state import TuneState as TuneState
