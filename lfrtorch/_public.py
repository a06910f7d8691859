"""The public names: the first that is asked for imports them all, and torch with them."""

from lfrtorch import datasets, distributed, reporting

# errors
from lfrtorch._support.errors import InputError, LfrtorchError
from lfrtorch._support.reasons import Reason

# data
from lfrtorch.dataset import Dataset, Published

# the nonlinear model
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.nonlinearity import Network, Polynomial
from lfrtorch.excitation import multisine
from lfrtorch.files.load import load_records

# fits
from lfrtorch.fitting.inference import infer
from lfrtorch.fitting.means import mean_model
from lfrtorch.fitting.multistart import fit

# the whole job
from lfrtorch.fitting.settings import Settings, SizesSearch
from lfrtorch.fitting.size_search import SizeSearch, search_sizes
from lfrtorch.fitting.snapshots import Snapshots
from lfrtorch.fitting.starts import initialise
from lfrtorch.fitting.trainer import FitResult
from lfrtorch.job import identify
from lfrtorch.least_squares.adam import Adam
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt

# the linear model
from lfrtorch.linear.bla import estimate_bla
from lfrtorch.linear.frf import FRF, estimate_frf
from lfrtorch.linear.model import LinearFit, LinearModel
from lfrtorch.linear.order_scan import OrderScan, scan_orders

# scores
from lfrtorch.metrics import nrmse, rmse
from lfrtorch.model import Model, load, simulate_blocks
from lfrtorch.records import Channel, Record, Scaler
from lfrtorch.reporting.run import Run

__all__ = [
    "FRF",
    "LFR",
    "Adam",
    "Channel",
    "Dataset",
    "FitResult",
    "InputError",
    "LFRCell",
    "LevenbergMarquardt",
    "LfrtorchError",
    "LinearFit",
    "LinearModel",
    "Model",
    "Network",
    "OrderScan",
    "Polynomial",
    "Published",
    "Reason",
    "Record",
    "Run",
    "Scaler",
    "Settings",
    "SizeSearch",
    "SizesSearch",
    "Snapshots",
    "datasets",
    "distributed",
    "estimate_bla",
    "estimate_frf",
    "fit",
    "identify",
    "infer",
    "initialise",
    "load",
    "load_records",
    "mean_model",
    "multisine",
    "nrmse",
    "reporting",
    "rmse",
    "scan_orders",
    "search_sizes",
    "simulate_blocks",
]
