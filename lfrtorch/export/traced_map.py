"""Graph of ONNX of a static map without equations, compared with the map."""

from __future__ import annotations

import inspect
import io
import warnings
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from torch.nn import Module

from lfrtorch._support.errors import InputError
from lfrtorch._support.optional import imported

OPSET = 17
"""Version of the ONNX operators, of 2022, which every runtime since then can read."""

IR = 8
"""Version of the file format that belongs to these operators."""

_SAMPLES = (1, 5, 64)
"""Batch sizes for which the graph is compared with the map."""


def traced(static: Module, nz: int) -> Any:
    """Graph z (n, nz) -> w (n, nw) of a map; refuse a map whose values the graph does not give."""
    onnx = imported("onnx", "onnx")
    generator = torch.Generator().manual_seed(0)
    file: Any = io.BytesIO()  # torch.onnx.export accepts this, although its type hints do not
    static = deepcopy(static).eval()
    z = torch.randn(max(_SAMPLES), nz, generator=generator, dtype=torch.float64)
    # Since torch 2.9 the default is another exporter, which needs one more package.
    older: dict[str, Any]
    older = {"dynamo": False} if "dynamo" in inspect.signature(torch.onnx.export).parameters else {}
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            torch.onnx.export(
                static, (z,), file, input_names=["z"], output_names=["w"],
                opset_version=OPSET, dynamic_axes={"z": {0: "n"}, "w": {0: "n"}}, **older,
            )  # fmt: skip
    except Exception as error:  # errors of many classes, depending on its forward
        raise _refused(static, f"torch.onnx.export says: {error}") from None
    if any("Python boolean" in str(one.message) for one in said):
        raise _refused(static, "Its forward branches in Python on values; use torch.where.")
    model = onnx.load_from_string(file.getvalue())
    run = imported("onnx.reference", "onnx").ReferenceEvaluator(model).run
    # Largest standard deviation of the inputs; z has about unit size.
    for scale, count in zip(np.linspace(3.0, 0.0, len(_SAMPLES) + 1), _SAMPLES, strict=False):
        point = float(scale) * z[:count]
        with torch.no_grad():
            expected = static(point).numpy()
        (found,) = run(None, {"z": point.numpy()})
        size = max(1.0, np.abs(np.nan_to_num(expected)).max())
        # Largest error of the graph, relative to 1 and to the largest w.
        if found.shape != expected.shape or not np.allclose(
            found, expected, rtol=0, atol=1e-11 * size, equal_nan=True
        ):
            raise _refused(
                static,
                "The graph computes other numbers than its forward in float64. Some options of "
                "layers have single precision in ONNX: a slope of 0.01, not one of 1/64.",
            )
    return model


def _refused(static: Module, why: str) -> InputError:
    return InputError(
        f"the static map {type(static).__name__}, a class of your own, has no graph of ONNX: its "
        f"forward must be made of torch's functions.\n{why}"
    )
