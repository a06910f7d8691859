"""Export to programs of torch in float32: TorchScript and ``torch.export``, batches of systems."""

from __future__ import annotations

import io
import json
import warnings
from collections.abc import Mapping
from copy import deepcopy
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from lfrtorch._support.errors import InputError
from lfrtorch.export.equations import Equations, equations
from lfrtorch.linear.model import LinearModel
from lfrtorch.maps.operations import OPERATIONS, Formula
from lfrtorch.maps.written import Written
from lfrtorch.model.model import Model

_EXAMPLES = 3
"""Number of systems in the batch that is traced; a program takes batches of any size."""


def torch_modules(model: Model | LinearModel, name: str = "model") -> tuple[Any, Any, Any]:
    """Export a model as programs of torch in float32 and physical units, which need torch alone.

    The first is TorchScript: (x, u) -> (x_next, y) of one sample, and its method ``simulate``,
    (x0, u) -> (x_end, y), of a sequence. Its attributes are ``x_rest``, the state at rest, and
    ``fs``. The others are programs of ``torch.export`` for a sample and for a sequence. All take
    several systems at once, along the first axis, on any device.

    Args:
        model: the model to export.
        name: name of the model.

    Shape:
        sample: x (n, nx), u (n, nu) -> x_next (n, nx), y (n, ny);
        sequence: x0 (n, nx), u (n, T, nu) -> x_end (n, nx), y (n, T, ny).

    A static map without equations takes part as the module that it is.

    Returns:
        A ``torch.jit.ScriptModule`` and two ``torch.export.ExportedProgram``.

    Raises:
        ValueError: a static map that torch cannot trace, or a name that is not an identifier.

    Example:
        >>> script, sample, sequence = lfrtorch.export.torch_modules(model)
        >>> x, y = script(torch.zeros(5, 1), torch.ones(5, 1))  # five systems
        >>> x_end, y = script.simulate(torch.zeros(5, 1), torch.ones(5, 100, 1))
        >>> y.shape
        torch.Size([5, 100, 1])
    """
    e = equations(model, name, _own)
    cell = model.to_model().lfr.cell
    step = _Step(e, cell.static if cell.map.written is None else None).eval()
    x, u = (torch.zeros(_EXAMPLES, e.sizes[size]) for size in ("nx", "nu"))
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")  # torch deprecates TorchScript
            traced: Any = torch.jit.trace(step, (x, u))
            script = torch.jit.script(_Sequence(traced, e))
            n, T = torch.export.Dim("n"), torch.export.Dim("T", min=2)
            sample = torch.export.export(step, (x, u), dynamic_shapes=({0: n}, {0: n}))
            u = u.unsqueeze(1).repeat(1, _EXAMPLES, 1)
            sequence = torch.export.export(
                _Scan(sample.module()), (x, u), dynamic_shapes=({0: n}, {0: n, 1: T})
            )
    except Exception as error:  # errors of many classes, depending on the map's forward
        raise InputError(
            f"the static map {type(cell.static).__name__} cannot be traced by torch: its forward "
            f"must be made of torch's functions.\n{error}"
        ) from None
    return script, sample, sequence


def torch_files(model: Model | LinearModel, name: str) -> dict[str, str | bytes]:
    """The programs as files: TorchScript, and those of ``torch.export``."""
    script, *programs = torch_modules(model, name)
    described = json.dumps(equations(model, name, _own).description(), indent=2)
    found: dict[str, str | bytes] = {}
    file = io.BytesIO()
    torch.jit.save(script, file, _extra_files={"channels.json": described})
    found[f"{name}.pt"] = file.getvalue()
    for end, program in zip((".pt2", "_simulate.pt2"), programs, strict=True):
        file = io.BytesIO()
        torch.export.save(program, file, extra_files={"channels.json": described})
        found[f"{name}{end}"] = file.getvalue()
    return found


def _own(static: nn.Module, nz: int) -> Written:
    """A map without equations: the module itself."""
    return Written("", {}, lambda language, z: language.own(z))


class _Step(nn.Module):
    """One sample of a model; also the language in which its equations are evaluated."""

    def __init__(self, e: Equations, own: nn.Module | None) -> None:
        super().__init__()
        self.equations = e
        self.own = None if own is None else deepcopy(own).float().requires_grad_(False)
        for name, array in e.arrays.items():
            self.register_buffer(name, torch.tensor(array, dtype=torch.float32))

    def forward(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """x_next and y."""
        return self.equations.sample(self, x, u)

    def deviation(self, u: Tensor) -> Tensor:
        """u - u_offset."""
        return u - self.get_buffer("u_offset")

    def total(self, to: str, terms: Mapping[str, Tensor], offset: str = "") -> Tensor:
        """Sum of matrices times signals, which are rows, and perhaps an offset."""
        found = sum(v @ self.get_buffer(M).mT for M, v in terms.items())
        return found + self.get_buffer(offset) if offset else torch.as_tensor(found)

    def affine(self, W: str, v: Tensor, b: str = "") -> Tensor:
        """W v + b."""
        found = v @ self.get_buffer(W).mT
        return found + self.get_buffer(b) if b else found

    def each(self, sigma: Formula, v: Tensor) -> Tensor:
        """Apply a scalar function to every entry of v."""
        return sigma.evaluated([v], OPERATIONS, partial(_constant, v))[0]

    def table(self, formula: Formula, v: Tensor) -> Tensor:
        """Apply a table of operations to the entries of v."""
        entries = v.unbind(-1)
        found = formula.evaluated(entries, OPERATIONS, partial(_constant, entries[0]))
        return torch.stack(found, -1)


def _constant(like: Tensor, number: float) -> Tensor:
    """A constant for each system, on whatever device the program runs."""
    return like.clamp(number, number)


class _Sequence(nn.Module):
    """A sample and a sequence, as TorchScript understands them."""

    def __init__(self, step: nn.Module, e: Equations) -> None:
        super().__init__()
        self.step, self.fs = step, float(e.fs)
        self.register_buffer("x_rest", torch.tensor(e.x_rest, dtype=torch.float32))

    def forward(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """x_next and y."""
        return self.step(x, u)

    @torch.jit.export
    def simulate(self, x0: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """x_end and y of a sequence."""
        x, found = x0, []
        for k in range(u.shape[1]):
            x, y = self.step(x, u[:, k])
            found.append(y)
        return x, torch.stack(found, 1)


class _Scan(nn.Module):
    """A sequence, as ``torch.export`` understands it."""

    def __init__(self, step: nn.Module) -> None:
        super().__init__()
        self.step = step

    def forward(self, x0: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """x_end and y."""
        from torch._higher_order_ops.scan import scan

        x, y = scan(self.step, x0, u.transpose(0, 1), dim=0)
        return x, y.transpose(0, 1)
