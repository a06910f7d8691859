"""What an iteration allocates, counted tensor by tensor."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from reference import random_cell, random_model
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils._python_dispatch import TorchDispatchMode

from lfrtorch.data.records import Record, Start
from lfrtorch.engine import linearised, sensitivity
from lfrtorch.least_squares import jacobian, output_rows
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.problem import Problem

pytestmark = pytest.mark.numeric


class Allocations(TorchDispatchMode):
    """Bytes of all storages alive that were made inside, and their peak."""

    def __init__(self) -> None:
        super().__init__()
        self.alive: dict[int, tuple[StorageWeakRef, int]] = {}
        self.peak = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        made = func(*args, **(kwargs or {}))
        for tensor in made if isinstance(made, tuple | list) else (made,):
            if isinstance(tensor, torch.Tensor):
                storage = tensor.untyped_storage()
                ref = StorageWeakRef(storage)
                self.alive[ref.cdata] = ref, storage.nbytes()
        self.alive = {key: (ref, n) for key, (ref, n) in self.alive.items() if not ref.expired()}
        self.peak = max(self.peak, sum(n for _, n in self.alive.values()))
        return made


def peak_of_an_iteration(
    T: int, start: Start, nn: int = 15, lines: NDArray | None = None
) -> tuple[int, int]:
    """Bytes, and parameters of the model: Bouc-Wen's sizes."""
    model = random_model(random_cell(1, 1, 3, 2, 1, nn))
    noise = np.random.default_rng(0).normal(size=(2, T, 1))
    record = Record(noise[0], noise[1], model.fs, start, line_weight=lines)
    problem = Problem.of(model, record)
    optimiser = LevenbergMarquardt()
    state = optimiser.init(problem, problem.theta)
    with Allocations() as allocations:
        optimiser.step(problem, state)
    return allocations.peak, model.parameter_count


@pytest.mark.slow
def test_iteration_over_a_million_samples_stays_below_half_a_gigabyte():
    peak, parameters = peak_of_an_iteration(1_000_000, "zero")
    assert 8 * 1_000_000 * parameters > 700e6  # what the Jacobian alone would take
    assert peak < 400e6


@pytest.fixture
def blocks(monkeypatch: pytest.MonkeyPatch) -> int:
    """Bytes of blocks that are 8 times shorter than usual: a record is long that is short."""
    monkeypatch.setattr(linearised, "PASS", 2048)
    monkeypatch.setattr(sensitivity, "PASS", 2048)
    monkeypatch.setattr(sensitivity, "KEPT", 8192)
    monkeypatch.setattr(sensitivity, "BLOCK", 1024)
    monkeypatch.setattr(jacobian, "CACHED_BYTES", 1 << 24)
    return 8 * 2048 * 20 * 30  # of neurons and derivatives, whatever the record's length


T = 45_000
ROWS = 8 * T * 75  # bytes of all columns but those of the gauge, and of the residual
SIGNALS = 8 * T * 40  # 20 or so doubles a sample (x, z, w, y, r, a trial), and as many again


def test_memory_of_a_long_record_does_not_depend_on_the_number_of_neurons(blocks: int):
    few, many = (peak_of_an_iteration(T, "zero", nn)[0] for nn in (15, 30))
    assert max(jacobian.CACHED_BYTES, SIGNALS + blocks) < ROWS  # which are too many to be kept
    assert many - few < blocks
    assert few < SIGNALS + blocks


def test_rows_by_spectral_line_are_held_once(blocks: int):
    samples = 8192
    plain, _ = peak_of_an_iteration(samples, "periodic")
    peak, _ = peak_of_an_iteration(samples, "periodic", lines=np.ones(samples // 2 + 1))
    copies = 4 * 8 * samples * output_rows.SPECTRA  # the columns, their spectra, and real again
    assert peak < plain + copies


@pytest.mark.slow
def test_memory_of_a_long_periodic_record(blocks: int):
    peak, _ = peak_of_an_iteration(T, "periodic")
    assert peak < SIGNALS + blocks
