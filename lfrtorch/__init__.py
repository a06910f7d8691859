"""Identification of nonlinear LFR state-space models from input-output data.

records -> estimate_bla -> initialise or inference -> fit -> simulate, save, load
records -> estimate_frf, scan_orders -> estimate_bla -> simulate, save, to_scipy
"""

from importlib.metadata import version

from lfrtorch import datasets, distributed
from lfrtorch.adam import Adam
from lfrtorch.average import average
from lfrtorch.bla import estimate_bla
from lfrtorch.cell import LFRCell
from lfrtorch.datasets.files import load_records
from lfrtorch.frf import FRF, estimate_frf
from lfrtorch.inference import inference
from lfrtorch.initialise import initialise
from lfrtorch.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.lfr import LFR
from lfrtorch.linear_model import LinearFit, LinearModel
from lfrtorch.metrics import nrmse, rmse
from lfrtorch.model import Model, load
from lfrtorch.multisine import multisine
from lfrtorch.multistart import fit_starts
from lfrtorch.nonlinearity import Network, Polynomial
from lfrtorch.order import OrderScan, scan_orders
from lfrtorch.records import Channel, Record, Scaler
from lfrtorch.resume import Snapshots
from lfrtorch.sizes import SizeSearch, search_sizes
from lfrtorch.stream import simulate_blocks
from lfrtorch.trainer import FitResult, fit

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
