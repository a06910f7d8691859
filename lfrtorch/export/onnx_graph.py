"""Export to graphs of ONNX in float64: one sample, and a whole simulation."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np
from torch.nn import Module

from lfrtorch._support.errors import InputError
from lfrtorch._support.optional import imported
from lfrtorch._support.types import Array
from lfrtorch.export.equations import Equations, equations
from lfrtorch.export.traced_map import IR, OPSET, traced
from lfrtorch.linear.model import LinearModel
from lfrtorch.maps.operations import Formula
from lfrtorch.maps.written import Written
from lfrtorch.model.model import Model


def onnx_models(model: Model | LinearModel, name: str = "model") -> tuple[Any, Any]:
    """Export a model as two graphs of ONNX, in float64 and physical units.

    The first is one sample, (x, u) -> (x_next, y). The second is a simulation, (x0, u) ->
    (x_end, y), by the operator Scan over the samples. Both take several states and inputs at once,
    along the first axis. The metadata have the sampling frequency, and names, units and offsets of
    the channels as JSON.

    Args:
        model: the model to export.
        name: name of the graphs.

    Shape:
        sample: x (n, nx), u (n, nu) -> x_next (n, nx), y (n, ny);
        simulation: x0 (n, nx), u (n, T, nu) -> x_end (n, nx), y (n, T, ny).

    A static map without equations goes through ``torch.onnx.export``, which traces its ``forward``.

    Returns:
        Two ``onnx.ModelProto``.

    Raises:
        ValueError: onnx is not installed, a static map without equations that cannot be traced, or
            a name that is not an identifier.

    Example:
        >>> sample, simulation = lfrtorch.export.onnx_models(model, "actuator")
        >>> [one.name for one in sample.graph.input], [one.name for one in simulation.graph.output]
        (['x', 'u'], ['x_end', 'y'])
    """
    e = equations(model, name, _own)
    nx, nu, ny = (e.sizes[size] for size in ("nx", "nu", "ny"))
    graph = Graph(imported("onnx", "onnx"), e.arrays)
    e.sample(graph, "x", "u")

    def sample(called: str) -> Any:
        """x, u -> x_next, y."""
        ends = {"x": ["n", nx], "u": ["n", nu]}, {"x_next": ["n", nx], "y": ["n", ny]}
        return graph.of(called, graph.nodes, *ends, graph.constants.values())

    # x0, u -> x_end, y, with the sample as the body of a Scan over the axis of time.
    scan = graph.onnx.helper.make_node(
        "Scan", ["x0", "u"], ["x_end", "y"], body=sample(f"{name}_sample"),
        num_scan_inputs=1, scan_input_axes=[1], scan_output_axes=[1],
    )  # fmt: skip
    ends = {"x0": ["n", nx], "u": ["n", "T", nu]}, {"x_end": ["n", nx], "y": ["n", "T", ny]}
    simulation = graph.of(name, [scan], *ends)
    return graph.model(sample(name), e), graph.model(simulation, e)


def _own(static: Module, nz: int) -> Written:
    """Trace a map without equations."""

    def of(graph: Any, z: str) -> str:
        return graph.spliced(traced(static, nz), "f_", z)

    return Written("", {}, of)


_NAMES = {
    "add": "Add", "sub": "Sub", "mul": "Mul", "div": "Div", "neg": "Neg", "pow": "Pow",
    "relu": "Relu", "sigmoid": "Sigmoid", "abs": "Abs", "sign": "Sign", "maximum": "Max",
    "minimum": "Min", "where": "Where", "lt": "Less", "le": "LessOrEqual", "gt": "Greater",
    "ge": "GreaterOrEqual", "and": "And", "or": "Or", "not": "Not",
} | {
    name: name.capitalize() for name in (
        "sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh"
    )
}  # fmt: skip
"""Operations of formulas as operators."""


Ends = Mapping[str, Sequence[int | str]]
"""Signals of a graph with their shapes."""


class Graph:
    """Graph of nodes and constants that becomes a model of ONNX."""

    def __init__(self, onnx: Any, arrays: Mapping[str, Array]) -> None:
        self.onnx, self.arrays = onnx, arrays
        self.nodes: list[Any] = []
        self.constants: dict[str, Any] = {}

    def deviation(self, u: str) -> str:
        """u - u_offset."""
        return self.node("Sub", u, self.constant("u_offset", self.arrays["u_offset"]), to="v")

    def total(self, to: str, terms: Mapping[str, str], offset: str = "") -> str:
        """Sum of matrices times signals, which are rows, and perhaps an offset."""
        constant = [self.constant(offset, self.arrays[offset])] if offset else []
        products = [self.product(M, signal) for M, signal in terms.items()]
        return self.node("Sum", *products, *constant, to=to)

    def product(self, M: str, signal: str) -> str:
        """Add the product of an array and a signal, which is a row."""
        return self.node("MatMul", signal, self.constant(M, self.arrays[M].T))

    def affine(self, W: str, v: str, b: str = "") -> str:
        """Affine map W v + b."""
        found = self.product(W, v)
        return self.node("Add", found, self.constant(b, self.arrays[b])) if b else found

    def each(self, sigma: Formula, v: str) -> str:
        """Apply a scalar function to every entry of v."""
        return self.evaluated(sigma, [v])[0]

    def table(self, formula: Formula, v: str) -> str:
        """Apply a table of operations to the entries of v."""
        entries = self.split("Split", v, to=[f"z{j}" for j in range(formula.inputs)], axis=-1)
        nothing = self.node("Mul", entries[0], self.number(0.0))
        varying: set[int] = set()  # rows that depend on v; constant rows are shorter
        for place, row in enumerate(formula.rows):
            if row.name == "input" or varying.intersection(row.operands):
                varying.add(place)
        results = [
            w if place in varying else self.node("Add", w, nothing)
            for w, place in zip(self.evaluated(formula, entries), formula.results, strict=True)
        ]
        return self.node("Concat", *results, axis=-1)

    def evaluated(self, formula: Formula, v: list[str]) -> list[str]:
        """Evaluate a table of operations on columns or on rows."""
        if any(row.name == "atan2" for row in formula.rows):
            raise InputError("ONNX has no operator for atan2, which the map calls; use atan.")

        def softplus(v: str) -> str:  # not every runtime has the operator in float64
            near = self.node("Exp", self.node("Neg", self.node("Abs", v)))
            rest = self.node("Log", self.node("Add", near, self.number(1.0)))
            return self.node("Add", self.node("Relu", v), rest)

        apply: dict[str, Any] = {name: partial(self.node, own) for name, own in _NAMES.items()}
        return formula.evaluated(v, {**apply, "softplus": softplus}, self.number)

    def number(self, value: float) -> str:
        """Add a number as a constant; return its name."""
        return self.constant(f"number_{value!r}", np.array([[value]]))

    def constant(self, name: str, value: Array) -> str:
        """Add a constant; return its name."""
        self.constants[name] = self.onnx.numpy_helper.from_array(np.ascontiguousarray(value), name)
        return name

    def node(self, operator: str, *inputs: str, to: str = "", **options: Any) -> str:
        """Add a node; return the name of its output."""
        return self.split(operator, *inputs, to=[to or f"v{len(self.nodes)}"], **options)[0]

    def split(self, operator: str, *inputs: str, to: list[str], **options: Any) -> list[str]:
        """Add a node with several outputs; return their names."""
        self.nodes.append(self.onnx.helper.make_node(operator, inputs, to, **options))
        return to

    def spliced(self, model: Any, prefix: str, z: str) -> str:
        """Add the nodes of a graph from z to w, with a prefix to their names; return w's name."""
        added = self.onnx.compose.add_prefix(model, prefix).graph
        self.node("Identity", z, to=f"{prefix}z")
        self.nodes += added.node
        self.constants |= {one.name: one for one in added.initializer}
        return f"{prefix}w"

    def of(
        self, name: str, nodes: Sequence[Any], inputs: Ends, outputs: Ends, constants: Any = ()
    ) -> Any:
        """A graph whose inputs and outputs are of float64."""
        kind, value = self.onnx.TensorProto.DOUBLE, self.onnx.helper.make_tensor_value_info
        ends = ([value(n, kind, s) for n, s in side.items()] for side in (inputs, outputs))
        return self.onnx.helper.make_graph(nodes, name, *ends, [*constants])

    def model(self, graph: Any, e: Equations) -> Any:
        """A graph with its operators' version and the metadata."""
        model = self.onnx.helper.make_model(
            graph,
            ir_version=IR,
            opset_imports=[self.onnx.helper.make_opsetid("", OPSET)],
            producer_name="lfrtorch",
            producer_version=version("lfrtorch"),
            doc_string="\n".join(e.about()),
        )
        described = {key: json.dumps(value) for key, value in e.description().items()}
        self.onnx.helper.set_model_props(model, described)
        return model
