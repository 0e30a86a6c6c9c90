"""Parameters of a model tuned by gradient, Q and R of the filter above all; see README.md here.

`standard_errors` here is the module; `jaxslam.standard_errors` is its function.
"""

from jaxslam.tuning.ekf_data import EkfSequence as EkfSequence
from jaxslam.tuning.ekf_data import stack_sequences as stack_sequences
from jaxslam.tuning.ekf_model import ekf_model as ekf_model
from jaxslam.tuning.fitting import gradients as gradients
from jaxslam.tuning.fitting import tune as tune
from jaxslam.tuning.fitting import values as values
from jaxslam.tuning.losses import BY_NAME as BY_NAME
from jaxslam.tuning.losses import Loss as Loss
from jaxslam.tuning.losses import WeightedLoss as WeightedLoss
from jaxslam.tuning.losses import innovation_nll as innovation_nll
from jaxslam.tuning.losses import pose_mse as pose_mse
from jaxslam.tuning.losses import pose_nll as pose_nll
from jaxslam.tuning.model import Model as Model
from jaxslam.tuning.model import run_model as run_model
from jaxslam.tuning.optimizers import default_optimizer as default_optimizer
from jaxslam.tuning.optimizers import lbfgs_backtracking as lbfgs_backtracking
from jaxslam.tuning.optimizers import newton as newton
from jaxslam.tuning.parameters import param_names as param_names
from jaxslam.tuning.prediction import ClosureNll as ClosureNll
from jaxslam.tuning.prediction import NisConsistency as NisConsistency
from jaxslam.tuning.prediction import PredictionNll as PredictionNll
from jaxslam.tuning.prediction import closure_nll as closure_nll
from jaxslam.tuning.prediction import nis_consistency as nis_consistency
from jaxslam.tuning.prediction import prediction_nll as prediction_nll
from jaxslam.tuning.priors import Prior as Prior
from jaxslam.tuning.slam_model import slam_model as slam_model
from jaxslam.tuning.standard_errors import StandardErrors as StandardErrors
from jaxslam.tuning.transforms import CHOLESKY as CHOLESKY
from jaxslam.tuning.transforms import POSITIVE as POSITIVE
from jaxslam.tuning.transforms import REAL as REAL
from jaxslam.tuning.transforms import Transform as Transform
from jaxslam.tuning.transforms import bounded as bounded
from jaxslam.tuning.transforms import real as real
from jaxslam.tuning.tune_state import TuneResult as TuneResult
from jaxslam.tuning.tune_state import TuneState as TuneState
