"""The scan over orders finds the one that was planted, and says what it rests on."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import reference
from reference import System, random_system
from scipy.signal import lfilter

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.records import Channel, Record, Start
from lfrtorch.linear import order_fits, order_scan
from lfrtorch.linear.bla import estimate_bla
from lfrtorch.linear.frf import estimate_frf
from lfrtorch.linear.model import LinearFit, LinearModel
from lfrtorch.linear.order_scan import OrderScan, memory_of, scan_orders
from lfrtorch.linear.subspace import SpectralSubspace

pytestmark = pytest.mark.numeric


def record_of(system: System, seed: int, noise: float = 0.1, T: int = 600) -> Record:
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(T, 1))
    y = reference.periodic_response(system, u)
    return Record(u, y + noise * y.std() * rng.normal(size=y.shape), 10.0, "periodic")


ORDERS = range(1, 5)
PLANTED = random_system(3, seed=4)


@pytest.fixture(scope="module")
def scan() -> OrderScan:
    return scan_orders(record_of(PLANTED, 0), ORDERS)


def fake(monkeypatch: pytest.MonkeyPatch, models: Sequence[LinearModel]):
    """The fits of a scan are those models, whatever the data, and validation is trusted."""
    of_order = {model.nx: model for model in models}
    monkeypatch.setattr(order_scan, "estimate_bla", lambda data, nx, **_: of_order[nx])
    monkeypatch.setattr(order_scan.OrderFits, "of", lambda *_: None)


def with_errors(monkeypatch: pytest.MonkeyPatch, errors: Callable[[LinearModel], Array]):
    """Validation finds these errors of a model, sample by sample, whatever the records."""
    monkeypatch.setattr(order_scan, "_errors", lambda _records, _scale, model: [errors(model)])


def model_of(nx: int, rmse: float, nu: int = 1, ny: int = 1) -> LinearModel:
    sizes = ("u", nu), ("y", ny)
    inputs, outputs = (tuple(Channel(f"{s}{i}") for i in range(n)) for s, n in sizes)
    fit = LinearFit("simulation", rmse, 1, "converged", 0.0, (), ())
    matrices = random_system(nx, nu, ny)
    return LinearModel(*matrices, 10.0, np.zeros(nu), np.zeros(ny), inputs, outputs, fit=fit)


@pytest.mark.parametrize("validated", [True, False])
def test_planted_order_is_chosen(validated: bool, scan: OrderScan, monkeypatch):
    if validated:
        fake(monkeypatch, scan.models)
        scan = scan_orders(record_of(PLANTED, 0), ORDERS, validation=record_of(PLANTED, 1))
    assert scan.orders == (1, 2, 3, 4)
    assert scan.validated is validated
    assert scan.chosen == 3
    assert scan.best is scan.models[2]
    # What is left at the true order is the noise, a tenth of the output.
    assert scan.scores[2] == pytest.approx(0.1, rel=0.1)
    assert scan.scores[0] > 2 * scan.scores[2]


def test_work_grows_with_the_orders_that_are_tried_and_not_with_the_highest(monkeypatch):
    asked, made = [], order_fits.spectral_subspaces

    def noted(*spectra: Any) -> list[SpectralSubspace]:
        asked.append(spectra[-1])
        return made(*spectra)

    monkeypatch.setattr(order_fits, "spectral_subspaces", noted)
    few, many = (scan_orders(record_of(PLANTED, 0), range(1, most)) for most in (13, 1001))
    assert few.scores == many.scores
    assert max(asked) == 12


def test_score_on_validation_is_the_relative_simulation_error(monkeypatch):
    """Of all records together, without the samples skipped, each output by its own rms."""
    model = model_of(2, 0.1, 2, 2)
    fake(monkeypatch, [model])
    rng = np.random.default_rng(0)
    judges = [
        Record(rng.normal(size=(T, 2)), rng.normal(size=(T, 2)) * [1.0, 50.0], 10.0, skip=skip)
        for T, skip in ((40, 7), (60, 0))
    ]
    found = scan_orders(judges, [2], validation=judges)
    scale = np.concatenate([r.y for r in judges]).std(axis=0)
    errors = [((r.y - model.simulate(r)) / scale)[r.skip :] for r in judges]
    expected = np.sqrt(np.mean(np.concatenate(errors) ** 2))
    # The mean of 186 squares.
    assert found.scores[0] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("scores", "chosen"),
    [
        ((0.2, 0.1009, 0.1), 2),  # within 1 % of the best
        ((0.2, 0.1011, 0.1), 3),
        ((0.1009, 0.1, 0.1), 1),
        ((0.1, 0.2, 0.3), 1),
    ],
)
def test_lowest_order_within_the_margin_of_the_best_is_chosen(scores, chosen, monkeypatch):
    """Of validation; a description length has a term for the order as it is."""
    record = record_of(PLANTED, 0)
    fake(monkeypatch, [model_of(nx + 1, score) for nx, score in enumerate(scores)])
    # Of the same size everywhere, whatever the block.
    with_errors(monkeypatch, lambda model: np.full((100, 1), model.fit.rmse))  # pyright: ignore
    assert scan_orders(record, [1, 2, 3], validation=record).chosen == chosen
    monkeypatch.setattr(order_scan, "description_length", lambda rmse, *_: rmse)
    assert scan_orders(record, [1, 2, 3]).chosen == int(np.argmin(scores)) + 1


def test_order_within_one_standard_error_of_the_best_is_chosen(monkeypatch):
    """The difference of the squares, block by block, is what counts."""
    record, models = record_of(PLANTED, 0), [model_of(nx, 0.1) for nx in (1, 2)]
    fake(monkeypatch, models)
    blocks = np.repeat(np.arange(10.0), 10)[:, None]

    def errors_with(spread):
        squares = {1: 1.05 + spread * (blocks - 4.5), 2: np.ones_like(blocks)}
        return lambda model: np.sqrt(squares[model.nx])

    with_errors(monkeypatch, errors_with(0.06))  # 0.05 is 0.9 standard errors
    assert scan_orders(record, [1, 2], validation=record).chosen == 1
    with_errors(monkeypatch, errors_with(0.04))
    assert scan_orders(record, [1, 2], validation=record).chosen == 2


def test_description_length_counts_parameters_and_equations(monkeypatch):
    """M^(p / 2M) times the error, by its numbers."""
    fake(monkeypatch, [model_of(3, 0.25, 2, 3)])
    p = 3 * (2 + 3) + 2 * 3  # an order has nx (nu + ny) beside its coordinates
    noise = np.random.default_rng(0).normal(size=(100, 5))
    u, y = noise[:, :2], noise[:, 2:]
    records = [Record(u, y, 10.0, skip=10), Record(u[:70], y[:70], 10.0)]
    M = (90 + 70) * 3
    expected = 0.25 * M ** (p / (2 * M))
    assert scan_orders(records, [3]).scores[0] == pytest.approx(expected, rel=1e-12)
    free = [replace(record, start="estimated") for record in records]
    more = p + 2 * 3  # a state of each record
    expected = 0.25 * M ** (more / (2 * M))
    assert scan_orders(free, [3]).scores[0] == pytest.approx(expected, rel=1e-12)
    lines = estimate_frf(Record(u, y, 10.0))
    apart = estimate_frf(Record(u, y, 10.0), lines=[12, 37])
    for frf, least, most in ((lines, 4, 8), (apart, 1, 1)):
        M = 2 * len(frf.frequencies) * 3 * 2  # real and imaginary part of every entry
        at = [0.25 * (M / s) ** (p * s / (2 * M)) for s in (most, least)]
        # Windows of 21 lines share them; a line in 21 is independent.
        assert at[1] * (1 - 1e-9) <= scan_orders(frf, [3]).scores[0] <= at[0] * (1 + 1e-9)


def test_the_same_periods_again_change_no_length():
    once = record_of(PLANTED, 0, T=128)
    thrice = Record(np.tile(once.u, (3, 1)), np.tile(once.y, (3, 1)), 10.0, "periodic", period=128)
    short, long = (scan_orders(record, [2, 3]).scores for record in (once, thrice))
    np.testing.assert_allclose(short, long, rtol=1e-6)


@pytest.mark.parametrize(("start", "skip"), [("periodic", 0), ("estimated", 100)])
def test_noise_of_periods_is_fitted_in_all_models_of_a_scan(start: Start, skip: int):
    """Of each order the error fitted is that of a full estimate, whose period is a mean."""
    once = record_of(PLANTED, 0, noise=0.0, T=100)
    u, y = (np.tile(signal, (3, 1)) for signal in (once.u, once.y))
    y = y + 0.3 * y.std() * np.random.default_rng(1).normal(size=y.shape)
    record = Record(u, y, 10.0, start, period=100, skip=skip)
    fit, full = scan_orders(record, [2, 3]).models[0].fit, estimate_bla(record, 2).fit
    assert fit is not None
    assert full is not None
    assert fit.rmse == pytest.approx(full.rmse, rel=1e-3)


def test_start_states_count_as_parameters():
    records = [replace(driven(seed, 60)[20:], start="estimated", skip=0) for seed in range(3)]
    model, length = order_fits.OrderFits.of(records, 3, {}).fit(3)  # pyright: ignore[reportOptionalMemberAccess]
    assert model.fit is not None
    p, M = 3 * (1 + 1 + 3) + 1, 3 * 39  # of each record the mean is an offset
    # The error that is shown is from the most probable states.
    assert length == pytest.approx(model.fit.rmse * M ** (p / (2 * M)), rel=0.02)


@pytest.mark.slow
def test_start_states_of_short_records_count():
    """Ten records, of which eight are fitted: without their states the highest order is chosen."""
    records = [
        replace(driven(seed, 150, 0.2)[100:], start="estimated", skip=0) for seed in range(10)
    ]
    assert scan_orders(records, range(2, 7)).chosen == 3


@pytest.mark.slow
def test_lines_that_share_windows_are_fewer_equations():
    assert [scan_orders(estimate_frf(driven(s)), range(2, 6)).chosen for s in (0, 1)] == [3, 3]


def test_response_can_be_scanned():
    records = [record_of(PLANTED, seed, noise=0.02, T=200) for seed in range(4)]
    assert scan_orders(estimate_frf(records), (1, 3, 4)).chosen == 3


def test_orders_that_the_data_do_not_reach_for_are_left_out():
    u = np.random.default_rng(0).normal(size=60)
    # 4 (nx + 1) samples a window, 2 rows for each: enough columns up to order 4.
    found = scan_orders(Record(u, np.roll(u, 1)), range(1, 20), refine="prediction", max_iter=0)
    assert found.orders == (1, 2, 3, 4)
    with pytest.raises(ValueError, match="needs one of"):
        estimate_bla(Record(u, np.roll(u, 1)), len(found.orders) + 1)


def test_table_has_a_line_an_order_and_marks_the_chosen(scan: OrderScan):
    head, _, *lines = scan.table().splitlines()
    assert head.split()[:3] == ["nx", "fitted", "MDL"]
    assert [line.split()[0] for line in lines] == ["1", "2", "3", "4"]
    assert [line.split()[0] for line in lines if line.endswith("chosen")] == ["3"]
    assert scan.singular_values == scan.models[-1].fit.singular_values  # pyright: ignore[reportOptionalMemberAccess]
    # Of the largest order: the planted three stand out of the noise.
    assert scan.singular_values[2] > 2 * scan.singular_values[3]


def test_orders_are_fitted_once_and_in_their_order(monkeypatch):
    asked: list[int] = []

    def fit(_data: Record, nx: int, **_: object) -> LinearModel:
        asked.append(nx)
        return model_of(nx, 0.1)

    monkeypatch.setattr(order_scan, "estimate_bla", fit)
    monkeypatch.setattr(order_scan.OrderFits, "of", lambda *_: None)
    found = scan_orders(record_of(PLANTED, 0), (3, 1, 2, 3))
    assert asked == [1, 2, 3]
    assert found.orders == (1, 2, 3)


def test_orders_must_be_given():
    record = record_of(random_system(1), 0)
    with pytest.raises(ValueError, match="orders is empty"):
        scan_orders(record, [])
    with pytest.raises(ValueError, match="orders is 0; give a whole number of at least 1"):
        scan_orders(record, [0, 1])
    frf = estimate_frf(record)
    with pytest.raises(ValueError, match="hold a FRF where a record is expected"):
        scan_orders(record, [1], validation=frf)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="constant in all records"):
        scan_orders(Record(np.ones(100), np.ones(100)), [1, 2])


# --- which orders, and on what ------------------------------------------------------------------


def driven(seed: int, T: int = 400, noise: float = 0.05) -> Record:
    """The planted system from rest."""
    A, B, C, D = PLANTED
    rng = np.random.default_rng(seed)
    u, x, y = rng.normal(size=(T, 1)), np.zeros(3), np.zeros((T, 1))
    for k in range(T):
        y[k] = C @ x + D @ u[k]
        x = A @ x + B @ u[k]
    return Record(u, y + noise * y.std() * rng.normal(size=y.shape), 10.0, skip=20)


def test_each_order_is_told_and_the_scan_ends_where_orders_bring_nothing():
    lines: list[str] = []
    found = scan_orders(driven(0), range(1, 13), validation=driven(1, 800), watch=lines.append)
    assert found.chosen == 3
    assert found.notes == ()
    assert found.orders == tuple(range(1, 7))
    assert [line.split(":")[0] for line in lines] == [f"order {nx}" for nx in found.orders]
    assert "validation 0.05" in lines[2]
    # The model chosen is the full estimate.
    assert found.best.fit is not None
    assert found.best.fit.rmse == pytest.approx(estimate_bla(driven(0), 3).fit.rmse)  # pyright: ignore[reportOptionalMemberAccess]


def test_an_order_that_the_input_cannot_carry_is_left_out():
    """A multisine of two lines excites four directions, and a model of order 2 has five."""
    t = np.arange(400)
    u = np.sin(2 * np.pi * t / 20) + np.sin(2 * np.pi * t / 8)
    record = Record(u, np.convolve(u, [0.0, 1.0, 0.5])[:400], 10.0, skip=20)
    found = scan_orders(record, range(1, 7))
    assert found.orders == (1,)
    assert found.notes[0].startswith("orders from 2 on are left out: the input excites 4 of the 5")


@pytest.mark.slow
def test_an_order_that_leaves_nothing_but_integrators_is_left_out():
    record = driven(0, 300)
    position = Record(record.u, np.cumsum(record.y, axis=0), 10.0, start="estimated", skip=20)
    found = scan_orders(position, [1, 2, 3], integrators=2, max_iter=0)
    assert found.orders == (2, 3)


def part(record: Record, end: int, skip: int) -> Record:
    """A record cut in time: it is simulated from the beginning and scored after ``skip``."""
    return replace(record[:end], start="estimated", skip=skip)


@pytest.mark.parametrize("why", ["short", pytest.param("unlike", marks=pytest.mark.slow)])
def test_a_poor_validation_part_is_replaced_by_folds_over_all(why: str):
    record = driven(0, 700)
    train, validation = part(record, 300, 20), part(record, 340 if why == "short" else 700, 300)
    if why == "unlike":  # a load that comes late
        y = validation.y + 0.5 * validation.y.std() * (np.arange(700) >= 300)[:, None]
        validation = replace(validation, y=y)
    lines: list[str] = []
    found = scan_orders(train, range(1, 5), validation=validation, watch=lines.append)
    reason = {"short": "validation has 40 scored samples", "unlike": "the linear error on val"}
    assert found.notes[0].startswith(reason[why])
    assert len(found.notes[0]) <= 160 - len("note: ")
    crossed = [line for line in lines if "cross-validation" in line]
    assert [line.split(":")[0] for line in crossed] == [f"order {nx}" for nx in found.orders]
    if why == "short":
        assert found.chosen == 3
        assert found.scores[2] == pytest.approx(0.05, rel=0.1)


def test_parts_are_unlike_if_the_order_that_fits_best_says_so():
    """A resonance turns its sign, and order 1, which does not follow it, errs on both alike."""
    u = np.random.default_rng(0).normal(size=600)
    slow, resonance = lfilter([0, 1], [1, -0.5], u), lfilter([0, 0, 0.6], [1, 0, 0.49], u)
    y = slow + np.where(np.arange(600) < 300, 1.0, -0.6) * resonance
    record = Record(u, y + 0.05 * np.random.default_rng(1).normal(size=600), 10.0)
    train, validation = part(record, 300, 20), part(record, 600, 300)
    note, *_ = scan_orders(train, [1, 3], validation=validation).notes
    assert note.startswith("the linear error on validation is")


def test_cross_validation_leaves_out_orders_that_fit_no_better():
    models = [model_of(nx, rmse) for nx, rmse in enumerate((0.5, 0.2, 0.199, 0.21, 0.19), start=1)]
    assert order_scan._worthwhile(models) == [1, 2, 5]


def test_folds_score_each_sample_once_from_its_whole_record():
    record = driven(0, 500)
    train, validation, other = part(record, 300, 20), part(record, 500, 300), driven(1, 200)
    model = estimate_bla(train, 3)
    folds = order_scan._Folds([train, other], [validation], 3, {})
    assert len(folds._left_out) == 5
    scored = [np.zeros(500, int), np.zeros(200, int)]
    for fold in folds._left_out:
        for counts, (first, last) in zip(scored, fold, strict=True):
            counts[first:last] += 1
    assert [counts[:20].sum() for counts in scored] == [0, 0]
    assert all((counts[20:] == 1).all() for counts in scored)
    errors = folds.errors(model)
    assert sum(map(len, errors)) == 480 + 180
    assert np.concatenate(errors).std() == pytest.approx(0.05, rel=0.1)


def test_the_memory_is_that_of_the_response_and_not_of_its_slowest_pole():
    channels = (Channel("s"),)

    def model(poles: list[float], gains: list[float]) -> LinearModel:
        n, zero = len(poles), np.zeros(1)
        A, B, C = np.diag(poles), np.ones((n, 1)), np.array([gains])
        return LinearModel(A, B, C, np.zeros((1, 1)), 1.0, zero, zero, channels, channels)

    alone = memory_of(model([0.95], [1.0]), 2000)
    assert alone == pytest.approx(-1.0 / np.log(0.95), rel=0.1)
    assert memory_of(model([0.95, 0.9999], [1.0, 1e-4]), 2000) == pytest.approx(alone, rel=0.1)
    assert memory_of(model([0.95, 0.9999], [1.0, 1.0]), 2000) > 20 * alone
    assert memory_of(model([0.0], [1.0]), 2000) == 1.0


def test_an_order_beyond_the_block_rows_of_the_lines_cannot_be_started():
    """Six lines make 72 equations for the 71 unknowns of order 13, and four block rows."""
    system, u = random_system(3, 2, 3), np.random.default_rng(0).normal(size=(2, 14, 2))
    records = [
        Record(x, reference.periodic_response(system, x), start="periodic", name=f"r{r}")
        for r, x in enumerate(u)
    ]
    with pytest.raises(InputError, match="no stable linear model of order 13"):
        scan_orders(estimate_frf(records), [13])
