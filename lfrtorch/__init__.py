"""Identification of nonlinear LFR state-space models from input-output data.

dataset, settings -> identify -> run: the whole job in one call, or step by step:
records -> estimate_bla -> initialise -> fit -> simulate, save, load
records -> estimate_frf, scan_orders -> estimate_bla -> simulate, save, to_scipy
"""

import typing as _typing
from importlib import import_module as _import_module
from importlib.metadata import version as _version

from lfrtorch._support.moved import MOVED as _MOVED
from lfrtorch._support.moved import install as _install

if _typing.TYPE_CHECKING:
    from lfrtorch._public import *  # noqa: F403
    from lfrtorch._public import __all__ as __all__

__version__ = _version("lfrtorch")
_install()


_ROOMS = ("analysis", "datasets", "distributed", "export", "reporting")
_NAMES = {
    "data.dataset": "Dataset Published",
    "data.excitation": "multisine",
    "files.load": "load_records",
    "data.records": "Channel Record Scaler",
    "linear.bla": "estimate_bla",
    "linear.frf": "FRF estimate_frf",
    "linear.model": "LinearFit LinearModel",
    "linear.order_scan": "OrderScan scan_orders",
    "engine.cell": "LFRCell",
    "engine.lfr": "LFR",
    "maps.network": "Network",
    "maps.polynomial": "Polynomial",
    "maps.static_map": "StaticMap",
    "model.extended_kalman_filter": "NoiseCovariance",
    "model.known": "Known Parameter State",
    "model.loading": "load",
    "model.model": "Model simulate_blocks",
    "fitting.forgetting": "Memory forgets",
    "fitting.means": "mean_model",
    "fitting.multistart": "fit",
    "fitting.next_experiment": "Experiment next_experiment",
    "fitting.noise_estimate": "estimate_noise",
    "fitting.refit": "refit",
    "fitting.choice": "Choice choose_sizes",
    "fitting.snapshots": "Snapshots",
    "fitting.starts": "initialise",
    "fitting.trainer": "FitResult",
    "fitting.update": "Update update",
    "_support.reasons": "Reason",
    "least_squares.adam": "Adam",
    "least_squares.levenberg_marquardt": "LevenbergMarquardt",
    "fitting.settings": "Settings",
    "fitting.observer": "Observer",
    "job": "identify",
    "reporting.preview": "Preview preview",
    "reporting.run": "Run",
    "data.metrics": "nrmse rmse",
    "_support.errors": "InputError LfrtorchError",
}
_HOME = {name: module for module, names in _NAMES.items() for name in names.split()}
"""The module of each public name, in the order of ``_public.py``."""


if not _typing.TYPE_CHECKING:  # a checker would take every name for one of these
    __all__ = [*_ROOMS, *_HOME]  # noqa: PLE0604 (names of the tables)

    def __getattr__(name: str) -> object:
        """Import a public name's module when it is asked for: a record needs no torch."""
        if name in _ROOMS or name in _MOVED:
            return _import_module(f"lfrtorch.{name}")
        if name in _HOME:
            return getattr(_import_module(f"lfrtorch.{_HOME[name]}"), name)
        raise AttributeError(f"module 'lfrtorch' has no attribute '{name}'")

    def __dir__() -> list[str]:
        own = (name for name in globals() if name.startswith("__"))
        return sorted({*own, *__all__})
