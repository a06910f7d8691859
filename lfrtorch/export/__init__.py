"""Export of models as programs of other tools, in physical units."""

from lfrtorch.export.c_source import c_source
from lfrtorch.export.casadi_function import casadi_function, casadi_observer, casadi_reach
from lfrtorch.export.control_system import control_system, python_source
from lfrtorch.export.fmu import write_fmu
from lfrtorch.export.matlab_function import matlab_function
from lfrtorch.export.onnx_graph import onnx_models
from lfrtorch.export.targets import TARGETS, write
from lfrtorch.export.torch_program import torch_modules

__all__ = [
    "TARGETS",
    "c_source",
    "casadi_function",
    "casadi_observer",
    "casadi_reach",
    "control_system",
    "matlab_function",
    "onnx_models",
    "python_source",
    "torch_modules",
    "write",
    "write_fmu",
]
