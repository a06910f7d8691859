"""Points where a model has values but no derivatives: no step and no standard error there."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from lfrtorch._support.tables import number
from lfrtorch.data.records import Record
from lfrtorch.maps.linearised import linearise_map
from lfrtorch.model.model import Model


@torch.no_grad()
def infinite_slope(model: Model, records: Sequence[Record]) -> str:
    """Name the first slope of the static map along the records that is not finite; "" if none."""
    cell = model.lfr.cell
    static, phi = cell.map, cell.weights().phi
    for record in records:
        signals = model.signals(record)
        at = linearise_map(static, signals.z, phi, static.code)
        every = torch.cat([at.J, at.by_weight()], -1)[0]
        if not signals.w.isfinite().all() or every.isfinite().all():
            continue
        k, i, j = (~every.isfinite()).nonzero()[0].tolist()
        of, by, at = f"w{i + 1}", f"z{j + 1}", signals.z[0, k]
        value = "" if j >= cell.nz else number(float(at[j]))
        if (known := static.known) is not None and i < known.nw:
            states, inputs = known.physics.states, [u.name for u in model.inputs]
            of = [*(f"the next {name}" for name in states), *(y.name for y in model.outputs)][i]
            if j < known.nz:
                by = [*states, *inputs][j]
                value = number(float(known.of_z[j, 0] + known.of_z[j, 1] * at[j]))
        by = "a parameter" if j >= cell.nz else f"{by}, which is {value}"
        return (
            f"the derivative of {of} is not finite in sample {k} of record '{record.name}', by "
            f"{by}; keep roots, logarithms and divisions off 0 (clamp(min=1e-6), torch.where)"
        )
    return ""
