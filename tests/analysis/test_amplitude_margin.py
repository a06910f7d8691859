"""How much louder than its data a model may be driven."""

import numpy as np
import pytest
import torch

import lfrtorch
from lfrtorch.analysis.amplitude_margin import largest_stable_amplitude
from lfrtorch.data.records import Record


@pytest.mark.numeric
def test_a_model_that_runs_away_on_louder_inputs_is_found():
    """x+ = u + c x³ stays bounded under a constant u below 2 / (3 √(3 c)), here 1.3."""
    square = np.repeat(np.tile([1.0, -1.0], 5), 60)
    record = Record(square, np.roll(square, 1))
    model = lfrtorch.initialise(
        lfrtorch.estimate_bla(record, nx=1), record, nz=1, nw=1, static=lfrtorch.Polynomial(1, 1, 3)
    )
    cell = model.lfr.cell
    assert isinstance(cell.static, lfrtorch.Polynomial)
    with torch.no_grad():
        for weight in cell.parameters():
            weight.zero_()
        for weight in (cell.Bu, cell.Bw, cell.Cy, cell.Cz):
            weight.fill_(1.0)
        cell.static.C[0, -1] = (2 / (3 * 1.3)) ** 2 / 3
    assert largest_stable_amplitude(model, [record]) == 1.25
    with torch.no_grad():
        cell.static.C.zero_()
    assert largest_stable_amplitude(model, [record]) == 2.0
