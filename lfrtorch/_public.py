"""The public names at once; ``__init__.py`` imports each with the first use of it."""

from lfrtorch import analysis, datasets, distributed, export, reporting

# data
from lfrtorch.data.dataset import Dataset, Published
from lfrtorch.data.excitation import multisine
from lfrtorch.files.load import load_records
from lfrtorch.data.records import Channel, Record, Scaler

# the linear model
from lfrtorch.linear.bla import estimate_bla
from lfrtorch.linear.frf import FRF, estimate_frf
from lfrtorch.linear.model import LinearFit, LinearModel
from lfrtorch.linear.order_scan import OrderScan, scan_orders

# the nonlinear model
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.lfr import LFR
from lfrtorch.maps.network import Network
from lfrtorch.maps.polynomial import Polynomial
from lfrtorch.maps.static_map import StaticMap
from lfrtorch.model.extended_kalman_filter import NoiseCovariance
from lfrtorch.model.known import Known, Parameter, State
from lfrtorch.model.loading import load
from lfrtorch.model.model import Model, simulate_blocks

# fits
from lfrtorch.fitting.forgetting import Memory, forgets
from lfrtorch.fitting.means import mean_model
from lfrtorch.fitting.multistart import fit
from lfrtorch.fitting.next_experiment import Experiment, next_experiment
from lfrtorch.fitting.noise_estimate import estimate_noise
from lfrtorch.fitting.refit import refit
from lfrtorch.fitting.choice import Choice, choose_sizes
from lfrtorch.fitting.snapshots import Snapshots
from lfrtorch.fitting.starts import initialise
from lfrtorch.fitting.trainer import FitResult
from lfrtorch.fitting.update import Update, update
from lfrtorch._support.reasons import Reason
from lfrtorch.least_squares.adam import Adam
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt

# the whole job
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.observer import Observer
from lfrtorch.job import identify
from lfrtorch.reporting.preview import Preview, preview
from lfrtorch.reporting.run import Run

# scores
from lfrtorch.data.metrics import nrmse, rmse

# errors
from lfrtorch._support.errors import InputError, LfrtorchError

__all__ = [
    "FRF",
    "LFR",
    "Adam",
    "Channel",
    "Choice",
    "Dataset",
    "Experiment",
    "FitResult",
    "InputError",
    "Known",
    "LFRCell",
    "LevenbergMarquardt",
    "LfrtorchError",
    "LinearFit",
    "LinearModel",
    "Memory",
    "Model",
    "Network",
    "NoiseCovariance",
    "Observer",
    "OrderScan",
    "Parameter",
    "Polynomial",
    "Preview",
    "Published",
    "Reason",
    "Record",
    "Run",
    "Scaler",
    "Settings",
    "Snapshots",
    "State",
    "StaticMap",
    "Update",
    "analysis",
    "choose_sizes",
    "datasets",
    "distributed",
    "estimate_bla",
    "estimate_frf",
    "estimate_noise",
    "export",
    "fit",
    "forgets",
    "identify",
    "initialise",
    "load",
    "load_records",
    "mean_model",
    "multisine",
    "next_experiment",
    "nrmse",
    "preview",
    "refit",
    "reporting",
    "rmse",
    "scan_orders",
    "simulate_blocks",
    "update",
]
