"""Identification of nonlinear LFR state-space models from input-output data.

records -> estimate_bla -> initialise or inference -> fit -> simulate, save, load
records -> estimate_frf, scan_orders -> estimate_bla -> simulate, save, to_scipy
"""

from importlib.metadata import version

from lfrtorch import datasets, distributed
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.nonlinearity import Network, Polynomial
from lfrtorch.excitation import multisine
from lfrtorch.files.load import load_records
from lfrtorch.fitting.inference import inference
from lfrtorch.fitting.means import average
from lfrtorch.fitting.multistart import fit_starts
from lfrtorch.fitting.size_search import SizeSearch, search_sizes
from lfrtorch.fitting.snapshots import Snapshots
from lfrtorch.fitting.starts import initialise
from lfrtorch.fitting.trainer import FitResult, fit
from lfrtorch.least_squares.adam import Adam
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.linear.bla import estimate_bla
from lfrtorch.linear.frf import FRF, estimate_frf
from lfrtorch.linear.model import LinearFit, LinearModel
from lfrtorch.linear.order_scan import OrderScan, scan_orders
from lfrtorch.metrics import nrmse, rmse
from lfrtorch.model import Model, load, simulate_blocks
from lfrtorch.records import Channel, Record, Scaler

__version__ = version("lfrtorch")

__all__ = [
    "FRF",
    "LFR",
    "Adam",
    "Channel",
    "FitResult",
    "LFRCell",
    "LevenbergMarquardt",
    "LinearFit",
    "LinearModel",
    "Model",
    "Network",
    "OrderScan",
    "Polynomial",
    "Record",
    "Scaler",
    "SizeSearch",
    "Snapshots",
    "average",
    "datasets",
    "distributed",
    "estimate_bla",
    "estimate_frf",
    "fit",
    "fit_starts",
    "inference",
    "initialise",
    "load",
    "load_records",
    "multisine",
    "nrmse",
    "rmse",
    "scan_orders",
    "search_sizes",
    "simulate_blocks",
]
