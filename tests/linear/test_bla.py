"""The best linear approximation: exact on linear data, stable on any, and what it refuses."""

import itertools
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import reference
import scipy.linalg
from reference import System, random_system

from lfrtorch._support.types import Array
from lfrtorch.data.excitation import multisine
from lfrtorch.data.metrics import rms
from lfrtorch.data.records import Channel, Record, Scaler, Start
from lfrtorch.linear import minima
from lfrtorch.linear.bla import estimate_bla, refined_near
from lfrtorch.linear.frf import estimate_frf
from lfrtorch.linear.model import LinearModel
from lfrtorch.linear.requirements import steady_state

pytestmark = pytest.mark.numeric

OMEGA = np.linspace(0.01, 3.1, 50)
U0, Y0 = np.array([3.0, -1.0]), np.array([-7.0, 20.0])


def record_of(
    system: System, start: Start, *, T: int = 400, offset: bool = False, noise: float = 0.0
) -> Record:
    """Record under white noise of zero mean, at the operating point before it."""
    nu, ny = system[3].shape[1], system[3].shape[0]
    u = np.random.default_rng(0).normal(size=(T, nu))
    u -= u.mean(axis=0)
    e = noise * np.random.default_rng(1).normal(size=(T, ny))
    y = reference.dlsim(system, u) if start == "zero" else reference.periodic_response(system, u)
    if offset:
        u, y = u + U0[:nu], y + Y0[:ny]
    return Record(u, y + e, 10.0, start)


def frf_error(model: LinearModel, system: System) -> float:
    """Largest error over the frequencies, relative to the largest gain."""
    G = reference.frf(system, OMEGA)
    return float(np.abs(model.frf(OMEGA * model.fs / 2 / np.pi) - G).max() / np.abs(G).max())


def normalised(model: LinearModel, record: Record) -> System:
    """The model's matrices between signals of unit deviation."""
    s = Scaler.of([record])
    C, D = model.C / s.y_scale[:, None], model.D / s.y_scale[:, None] * s.u_scale
    return model.A, model.B * s.u_scale, C, D


# --- linear data ----------------------------------------------------------------------------

# The fit is exact, so that what is left is rounding: eps times the gain of the slowest pole, 10,
# and the condition of the parameters, 1e3 at order 6, is 1e-12.
EXACT = 1e-10


@pytest.mark.parametrize("start", ["zero", "periodic"])
@pytest.mark.parametrize("offset", [True, False])
@pytest.mark.parametrize(
    ("nx", "nu", "ny"), [(1, 1, 1), (2, 2, 2), (3, 1, 1), (6, 1, 1), (6, 2, 2)]
)
def test_linear_system_is_recovered(nx: int, nu: int, ny: int, offset: bool, start: Start):
    system = random_system(nx, nu, ny)
    model = estimate_bla(record_of(system, start, offset=offset), nx, offset=offset)
    assert frf_error(model, system) < EXACT
    # u has its mean to some eps of its largest samples.
    np.testing.assert_allclose(model.u_offset, offset * U0[:nu], rtol=1e-12)
    np.testing.assert_allclose(model.y_offset, offset * Y0[:ny], rtol=EXACT)


def test_records_of_several_lengths_and_starts_are_fitted_together():
    system = random_system(3)
    records = [record_of(system, "zero", T=150), record_of(system, "periodic", T=100)]
    assert frf_error(estimate_bla(records, 3, offset=False), system) < EXACT


def test_unknown_start_state_is_left_to_the_skipped_samples():
    system = random_system(3)
    u = np.random.default_rng(0).normal(size=(900, 1))
    record = Record(u[200:], reference.dlsim(system, u)[200:], 10.0, skip=250)
    # The start state is forgotten to 0.9^250 = 4e-12.
    assert frf_error(estimate_bla(record, 3), system) < 1e-9


def test_all_poles_at_the_origin():
    A, B, C = np.eye(3, k=-1), np.eye(3, 1), np.array([[0.0, 0.5, 1.0]])
    system = A, B, C, np.zeros((1, 1))
    assert frf_error(estimate_bla(record_of(system, "zero"), 3), system) < EXACT


def test_a_model_is_refined_without_samples_that_are_left_out():
    """From the model of all samples, of outputs in other units and about other means."""
    A, B, C, D = random_system(2, 1, 2)
    system = A, B, C * [[1.0], [1e3]], D * [[1.0], [1e3]]
    record = record_of(system, "zero", T=300, offset=True)
    wrong = np.where(np.arange(300)[:, None] < 200, record.y, record.y[::-1])
    valid = np.broadcast_to(np.arange(300)[:, None] < 200, wrong.shape)
    part = replace(record, y=wrong, valid=valid)
    rough = estimate_bla(replace(record, y=record.y * [1.2, 0.9]), 2, max_iter=0)
    refined = refined_near(rough, [part])
    errors = record.errors(refined.simulate(record))[200:]
    assert np.all(np.abs(errors).max(axis=0) < 1e-6 * np.std(record.y, axis=0))
    unstable = replace(refined, A=refined.A * 1.1 / np.abs(refined.poles).max())
    assert refined_near(unstable, [part]) is unstable


def test_a_model_that_integrates_is_made_anew_without_samples_that_are_left_out():
    rng = np.random.default_rng(0)
    u, speed, y = rng.standard_normal(600), np.zeros(600), np.zeros(600)
    for k in range(599):
        speed[k + 1] = 0.8 * speed[k] + 0.3 * u[k]
        y[k + 1] = y[k] + speed[k]
    valid = np.abs(np.arange(600) - 275) > 75
    wrong = Record(u, np.where(valid, y, y + 20.0), start="estimated")
    seen = estimate_bla(wrong, 2, integrators=1)
    refined = refined_near(seen, [replace(wrong, valid=valid)])
    assert np.isclose(refined.poles, 1.0, rtol=0.0, atol=1e-12).sum() == 1
    true = Record(u, y, start="estimated", skip=50)
    apart, near = (rms(true.errors(model.simulate(true))) for model in (seen, refined))
    assert near < 1e-6 < apart


def test_small_and_large_units_change_nothing():
    system = random_system(3)
    record = record_of(system, "periodic", offset=True)
    scaled = Record(1e6 * record.u, 1e-9 * record.y, record.fs, "periodic")
    A, B, C, D = system
    assert frf_error(estimate_bla(scaled, 3), (A, B, 1e-15 * C, 1e-15 * D)) < EXACT


@pytest.mark.parametrize("refine", ["simulation", "prediction"])
def test_units_of_each_channel_scale_the_noise_model_and_the_deviations(refine):
    """By powers of two, which leave the rounding alone."""
    record = record_of(random_system(2, 2, 2), "zero", T=200, offset=True, noise=0.3)
    by_u, by_y = np.array([0.25, 8.0]), np.array([512.0, 0.5])
    scaled = replace(record, u=by_u * record.u, y=by_y * record.y)
    plain, other = (estimate_bla(r, 2, refine=refine, max_iter=2) for r in (record, scaled))
    frequencies = np.array([0.5, 2.0, 4.5])
    for size, wanted in ((other.frf, plain.frf), (other.frf_std, plain.frf_std)):
        expected = wanted(frequencies) * by_y[:, None] / by_u
        np.testing.assert_allclose(size(frequencies), expected, rtol=1e-9)
    assert (other.frf_std(frequencies) > 0).all()
    np.testing.assert_allclose(other.u_offset, by_u * plain.u_offset, rtol=1e-9)
    np.testing.assert_allclose(other.y_offset, by_y * plain.y_offset, rtol=1e-9)
    if refine == "prediction":
        S = plain.innovation_covariance
        assert plain.K is not None
        assert other.K is not None
        assert S is not None
        assert other.innovation_covariance is not None
        np.testing.assert_allclose(other.K, plain.K / by_y, rtol=1e-9)
        np.testing.assert_allclose(other.innovation_covariance, by_y[:, None] * S * by_y, rtol=1e-9)


# --- any data -------------------------------------------------------------------------------

T = 120
NOISE = np.random.default_rng(1).normal(size=(2, T))
TIME, ONE = np.arange(T), np.ones((1, 1))
ANY_DATA = {
    "noise": (NOISE[0], NOISE[1]),
    "integrator": (NOISE[0], np.cumsum(NOISE[0])),
    "unstable": (NOISE[0], reference.dlsim((1.02 * ONE, ONE, ONE, 0 * ONE), NOISE[0])),
    "gain": (NOISE[0], 2 * NOISE[0]),
    "delay": (NOISE[0], np.roll(NOISE[0], 3)),
    "second order": (NOISE[0], reference.dlsim(random_system(2), NOISE[0])),
    "sine": (np.sin(0.3 * TIME), np.cos(0.3 * TIME)),
    "oscillator": (NOISE[0], np.sin(0.3 * TIME)),
    "ramp": (TIME, TIME),
    "step": (np.minimum(TIME, 1), 1 - 0.9**TIME),
}


POOR_IN_PERIODS = ("integrator", "unstable", "sine", "oscillator", "step")
"""What is no steady state, or has few lines."""


@pytest.mark.parametrize(
    ("data", "nx", "start"),
    [
        *((data, 2, "zero") for data in ANY_DATA),
        *((data, 5, "periodic") for data in POOR_IN_PERIODS),
        *(pytest.param(data, 2, "periodic", marks=pytest.mark.slow) for data in ANY_DATA),
        *(pytest.param(data, 6, "zero", marks=pytest.mark.slow) for data in ANY_DATA),
    ],
)
def test_model_of_any_data_is_stable(data: str, nx: int, start: Start):
    record = Record(*ANY_DATA[data], start=start)
    model = estimate_bla(record, nx, max_iter=10)
    assert np.abs(model.poles).max() < 1
    assert np.isfinite(model.simulate(record)).all()
    # B = D = 0 is among the candidates.
    assert np.std(record.y - model.simulate(record)) < 1.01 * np.std(record.y)


# --- coordinates ----------------------------------------------------------------------------


def test_states_have_unit_deviation():
    record = record_of(random_system(4, 2, 2), "periodic", noise=0.1)  # the refinement moves it
    model = estimate_bla(record, 4)
    states_as_outputs = model.A, model.B, np.eye(4), np.zeros((4, 2))
    states = reference.periodic_response(states_as_outputs, record.u - model.u_offset)
    np.testing.assert_allclose(states.std(axis=0), np.ones(4), rtol=1e-9)


def test_balanced_gramians_are_diagonal_and_alike():
    record = record_of(random_system(5, 2, 2), "periodic", noise=0.1)
    A, B, C, _ = normalised(estimate_bla(record, 5), record)
    P = scipy.linalg.solve_discrete_lyapunov(A, B @ B.T)
    Q = scipy.linalg.solve_discrete_lyapunov(A.T, C.T @ C)
    for gramian in (P, Q):
        correlation = gramian / np.sqrt(np.outer(np.diag(gramian), np.diag(gramian)))
        np.testing.assert_allclose(correlation, np.eye(5), atol=1e-8)
    hankel = np.sqrt(np.diag(P) * np.diag(Q))  # the scaling of the states cancels
    assert np.all(np.diff(hankel) < 0)
    np.testing.assert_allclose(hankel**2, np.sort(np.linalg.eigvals(P @ Q).real)[::-1], rtol=1e-8)


# --- refusals -------------------------------------------------------------------------------


def some_input(T: int = 300) -> Array:
    return np.random.default_rng(5).normal(size=(T, 2))


def refused(message: str, record: Record | list[Record], nx: int = 2, **options):
    with pytest.raises(ValueError, match=re.escape(message)):
        estimate_bla(record, nx, **options)


def test_constant_signals_are_named():
    u, y = some_input(100).T
    channels = {"inputs": (Channel("force"), Channel("valve")), "outputs": (Channel("speed"),)}
    refused("signal 'valve' is constant in all", Record(np.c_[u, 0 * u + 3], y, **channels))
    refused("signal 'speed' is constant in all", Record(np.c_[u, y], 0 * y, **channels))


def test_record_that_is_too_short():
    u = some_input(35)[:, 0]  # 2 · 2 (nx + 1) (nu + ny + 1) = 36
    refused("(s) has 35 samples; order nx=2 with 1 input(s) and 1 output(s) needs", Record(u, u))
    refused(" needs one of 36, or many shorter ones", Record(u, u))
    u = some_input(36)[:, 0]
    assert np.abs(estimate_bla(Record(u, u), 2).poles).max() < 1


def test_many_short_records_do():
    system, rng = random_system(2), np.random.default_rng(4)
    records: list[Record] = []
    for _ in range(6):
        u = rng.normal(size=(20, 1))
        records.append(Record(u, reference.dlsim(system, u)))
    assert frf_error(estimate_bla(records, 2, offset=False), system) < 1e-8
    refused("the longest of 2 record(s) has 13 samples", [r[:13] for r in records[:2]])


@pytest.mark.parametrize("start", ["estimated", "given"])
def test_start_state_is_fitted(start):
    """A record that begins in the middle of another, whatever coordinates its state is in."""
    system = random_system(3)
    u = np.random.default_rng(0).normal(size=(200, 1))
    x0 = np.ones(3) if start == "given" else None
    record = Record(u[50:], reference.dlsim(system, u)[50:], start=start, x0=x0)
    bla = estimate_bla(record, 3, offset=False, max_iter=20)
    assert frf_error(bla, system) < 1e-8
    np.testing.assert_allclose(bla.simulate(record), record.y, rtol=0, atol=1e-8)


# --- orders, channels and bands -------------------------------------------------------------

# "FRF to 1e-8" on the excited lines. Order 12 from a tenth of the axis leaves 1e-11 and less.
BANDS = {"all": (0.0, 1.0), "a third": (0.05, 0.4), "a tenth": (0.0, 0.1)}


def excited(
    system: System, band: tuple[float, float], *, T: int = 1024, R: int = 3
) -> list[Record]:
    """Steady-state records of multisines that excite only a part of the frequency axis."""
    nu, first, last = system[3].shape[1], *(np.array(band) * T / 2)
    records = []
    for seed in range(R):
        rng = np.random.default_rng([seed, 5])
        U = np.zeros((T // 2 + 1, nu), dtype=complex)
        lines = np.arange(max(1, round(first)), round(last))
        U[lines] = np.exp(2j * np.pi * rng.random((len(lines), nu)))
        u = np.fft.irfft(U, T, axis=0)
        records.append(Record(u, reference.periodic_response(system, u), 10.0, "periodic"))
    return records


def cases_of_a_part() -> list:
    """Every order, number of channels and band, of which a few are fast."""
    fast = {
        (1, 1, 1, "a third"), (2, 2, 1, "a tenth"), (5, 3, 3, "a tenth"), (8, 2, 1, "a third"),
        (12, 1, 1, "a tenth"), (12, 2, 1, "all"),
    }  # fmt: skip
    every = itertools.product((1, 2, 5, 8, 12), ((1, 1), (2, 1), (3, 3)), BANDS)
    cases = [(nx, nu, ny, band) for nx, (nu, ny), band in every]
    return [pytest.param(*c, marks=() if c in fast else pytest.mark.slow) for c in cases]


@pytest.mark.parametrize(("nx", "nu", "ny", "band"), cases_of_a_part())
def test_linear_system_is_recovered_from_a_part_of_the_axis(nx: int, nu: int, ny: int, band: str):
    system = random_system(nx, nu, ny)
    low, high = BANDS[band]
    model = estimate_bla(excited(system, BANDS[band], R=nu), nx)
    omega = np.linspace(max(low, 1 / 512) * np.pi, (high - 1 / 512) * np.pi, 200)
    G = reference.frf(system, omega)
    error = np.abs(model.frf(omega * model.fs / 2 / np.pi) - G).max() / np.abs(G).max()
    assert error < 1e-8
    assert np.abs(model.poles).max() < 1


@pytest.mark.parametrize(
    ("nx", "nu", "ny"),
    [(12, 1, 1), *(pytest.param(*s, marks=pytest.mark.slow) for s in ((9, 3, 3), (12, 3, 3)))],
)
def test_high_orders_are_recovered_from_signals(nx: int, nu: int, ny: int):
    system = random_system(nx, nu, ny)
    model = estimate_bla(record_of(system, "zero", T=1500), nx, offset=False)
    assert frf_error(model, system) < 1e-8


# --- feedthrough ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("refine", "start"),
    [
        *itertools.product(("simulation", "prediction"), ("zero", "periodic")),
        ("frequency", "zero"),  # one periodic experiment of two inputs gives no response
    ],
)
def test_without_feedthrough(refine, start: Start):
    A, B, C, D = random_system(3, 2, 2)
    record = record_of((A, B, C, 0 * D), start, T=600 if refine == "frequency" else 300)
    # Without noise any predictor is as good, and the search for one goes on.
    model = estimate_bla(record, 3, refine=refine, feedthrough=False, max_iter=20)
    assert not model.D.any()
    # The response by local polynomials has a bias of the order of (their window)³.
    limit = 0.05 if refine == "frequency" else 1e-8
    assert frf_error(model, (A, B, C, 0 * D)) < limit


def test_data_under_feedback_are_predicted_without_bias():
    """u = r - 0.5 y: a regulator that acts at once, around a first-order system with noise."""
    T, rng = 10_000, np.random.default_rng(8)
    x, u, y = 0.0, np.zeros(T), np.zeros(T)
    for k, (r, e) in enumerate(rng.normal(size=(T, 2))):
        y[k] = x + e
        u[k] = r - 0.5 * y[k]
        x = 0.9 * x + 0.3 * u[k] + 0.4 * e
    model = estimate_bla(Record(u, y), 1, refine="prediction", feedthrough=False)
    # About 1 / √10000 = 1 %, four of them.
    assert model.poles[0].real == pytest.approx(0.9, abs=0.04)
    assert float(model.C[0, 0] * model.B[0, 0]) == pytest.approx(0.3, abs=0.04)
    biased = estimate_bla(Record(u, y), 1, refine="prediction")
    assert abs(float(biased.D[0, 0])) > 0.1


# --- nonparametric responses ----------------------------------------------------------------


def noisy(system: System, *, R: int, P: int, noise: float = 0.05, T: int = 256) -> list[Record]:
    """R realisations of P periods with noise in the output."""
    records = []
    for record in excited(system, (0.0, 1.0), T=T, R=R):
        y = np.tile(record.y, (P, 1))
        rng = np.random.default_rng([len(records), 9])
        y = y + noise * rng.normal(size=y.shape) + 4.0
        records.append(Record(np.tile(record.u, (P, 1)) + 1.0, y, 10.0, "periodic", period=T))
    return records


def test_response_is_fitted_with_its_operating_point():
    system = random_system(3, 2, 2)
    records = noisy(system, R=2, P=1, noise=0.0)
    frf = estimate_frf(records)
    for model in (estimate_bla(frf, 3), estimate_bla(records, 3, refine="frequency")):
        assert frf_error(model, system) < 1e-9
        np.testing.assert_allclose(model.u_offset, np.ones(2), rtol=1e-12)  # a mean
        y = model.simulate(records[0])
        np.testing.assert_allclose(y, records[0].y, atol=1e-8)
        assert model.fit is not None
        assert model.fit.criterion == "frequency"


def test_weighted_error_of_a_true_model_is_one():
    """Where the variances are those of the errors, only they are left."""
    system = random_system(2)
    frf = estimate_frf(noisy(system, R=20, P=1))
    model = estimate_bla(frf, 2, weight="total")
    assert model.fit is not None
    # 127 lines, 254 real residuals: 1 / √(2 · 254) = 4.4 %; smoothing and 19 degrees of freedom
    # of the variances add about as much.
    assert model.fit.rmse == pytest.approx(1.0, abs=0.25)


def test_weights_decide():
    """Lines without weight are not fitted; a variance that is not known cannot weigh."""
    system = random_system(2)
    frf = estimate_frf(noisy(system, R=3, P=2, noise=0.0))
    wrong = replace(frf, G=np.where(np.arange(len(frf.G))[:, None, None] < 60, frf.G, 7.0))
    weight = np.where(np.arange(len(frf.G))[:, None, None] < 60, 1.0, 0.0)
    assert frf_error(estimate_bla(wrong, 2, weight=weight), system) < 1e-8
    assert frf_error(estimate_bla(wrong, 2), system) > 0.1
    with pytest.raises(ValueError, match="weight has shape"):
        estimate_bla(frf, 2, weight=weight[1:])
    with pytest.raises(ValueError, match="weight is 0 everywhere; give some lines a positive"):
        estimate_bla(frf, 2, weight=0 * weight)
    with pytest.raises(ValueError, match="weight is 'all'; use 'total'"):
        estimate_bla(frf, 2, weight="all")  # pyright: ignore[reportArgumentType]
    once = estimate_frf(noisy(system, R=1, P=1))
    for name in ("total", "noise"):
        with pytest.raises(ValueError, match=f"the {name} variance of the response is not known"):
            estimate_bla(once, 2, weight=name)


def test_what_a_response_does_not_know_is_said():
    system = random_system(2)

    def notes(R: int, P: int) -> str:
        fit = estimate_bla(estimate_frf(noisy(system, R=R, P=P)), 2).fit
        assert fit is not None
        return " ".join(fit.notes)

    assert "noise: not available from one period" in notes(1, 1)
    assert "total: not available" in notes(1, 3)
    assert notes(3, 3) == ""


@pytest.mark.slow
@pytest.mark.parametrize("refine", ["simulation", "frequency"])
def test_standard_deviation_of_the_response_is_that_of_many_fits(refine):
    """60 times periodic data with coloured noise, which changes from line to line."""
    system, frequencies = random_system(1), np.array([0.3, 1.0, 2.5])
    found, predicted = [], []
    clean = excited(system, (0.0, 1.0), T=128, R=2)
    for seed in range(60):
        rng = np.random.default_rng([seed, 11])
        records = []
        for record in clean:
            e = rng.normal(size=record.y.shape)
            e = 0.05 * (e + 0.8 * np.roll(e, 1, axis=0))
            records.append(replace(record, y=record.y + e))
        model = estimate_bla(records, 1, refine=refine)
        found.append(model.frf(frequencies)[:, 0, 0])
        predicted.append(model.frf_std(frequencies)[:, 0, 0] ** 2)
    variance = np.mean(np.abs(found - np.mean(found, axis=0)) ** 2, axis=0)
    # A complex mean square over 60 draws deviates by at most √(2 / 60) = 18 %: four of them.
    np.testing.assert_allclose(np.mean(predicted, axis=0), variance, rtol=0.73)


# --- what a fit says of itself --------------------------------------------------------------


def notes_of(record: Record | list[Record], nx: int, **options) -> str:
    fit = estimate_bla(record, nx, **options).fit
    assert fit is not None
    return " ".join(fit.notes)


def test_fit_is_described():
    record = record_of(random_system(2), "zero", noise=0.1)
    model = estimate_bla(record, 2)
    fit = model.fit
    assert fit is not None
    error = (record.y - model.simulate(record))[:, 0]
    # The constant fitted takes their mean off.
    assert fit.rmse == pytest.approx(error.std() / record.y.std(), rel=1e-9)
    assert fit.criterion == "simulation"
    assert fit.reason.startswith("converged")
    assert 0 < fit.iterations < 200
    assert fit.notes == ()
    # Two of many singular values stand out: the order.
    s = np.array(fit.singular_values)
    assert 0.1 < s[0] <= 1.0
    assert s[1] > 5 * s[2]


def test_constant_that_a_response_leaves_out_is_the_mean_of_the_errors_that_count():
    """Records of other lengths and levels: the response has the mean of their means."""
    system, records = random_system(2, 2, 2), []
    for record in noisy(system, R=2, P=1, noise=0.0):
        P = 1 + 2 * len(records)
        u, y = np.tile(record.u, (P, 1)), np.tile(record.y, (P, 1)) + 3.0 * len(records)
        records.append(Record(u, y, 10.0, "periodic", period=len(record.u)))
    model = estimate_bla(records, 2, refine="frequency")
    errors = np.concatenate([r.y - model.simulate(r) for r in records])
    # The mean of some hundred numbers of size 10; the levels have the mean 9 / 4, not 3 / 2.
    np.testing.assert_allclose(errors.mean(axis=0), np.zeros(2), rtol=0, atol=1e-11)
    np.testing.assert_allclose(model.y_offset, np.full(2, 4.0 + 9 / 4), rtol=0, atol=1e-8)


def test_error_of_periodic_records_is_that_of_their_deviations():
    """Records of other levels, which no constant makes up for: they count, relative to the rms."""
    record = record_of(random_system(2), "periodic", noise=0.1)
    records = [record, replace(record, y=record.y + 1.0)]
    model = estimate_bla(records, 2)
    errors = np.concatenate([r.y - model.simulate(r) for r in records])
    spread = np.concatenate([r.y for r in records]).std()
    np.testing.assert_allclose(errors.mean(), 0.0, rtol=0, atol=1e-11)
    assert model.fit is not None
    assert model.fit.rmse == pytest.approx(errors.std() / spread, rel=1e-9)
    assert errors.std() > 0.5


def test_search_that_was_cut_short_says_so():
    record = record_of(random_system(4), "periodic", noise=0.5)
    notes = notes_of(record, 3, max_iter=1)
    assert "stopped after 1 iterations: use estimate_bla(max_iter=2)" in notes
    assert "stopped" not in notes_of(record, 3, max_iter=0)


def test_order_above_what_the_data_carry():
    record = record_of(random_system(2), "periodic")
    assert "order 5 is above what the data carry" in notes_of(record, 5, offset=False)
    assert "try nx=2" in notes_of(record, 5, offset=False)
    assert notes_of(record, 2) == ""


def test_static_data_carry_no_order():
    for seed in range(3):
        u = np.random.default_rng(seed).normal(size=300)
        note = notes_of(Record(u, 2.0 * u, start="periodic"), 2)
        assert note.startswith("order 2 is above what the data carry: the subspace has 0 ")
        assert "unstable" not in note


def test_unstable_data():
    u = np.random.default_rng(0).normal(size=300)
    y = reference.dlsim((1.03 * ONE, ONE, ONE, 0 * ONE), u)
    assert "come from an unstable system" in notes_of(Record(u, y), 1, max_iter=3)


def test_model_that_explains_nothing():
    swapped = Record(NOISE[1], NOISE[0])
    assert "the model explains little: 9" in notes_of(swapped, 2, max_iter=3)
    system = random_system(2)
    assert "explains little" not in notes_of(record_of(system, "zero", noise=0.1), 2)


def test_start_has_no_covariance_and_says_why_it_ended():
    model = estimate_bla(record_of(random_system(2), "zero", noise=0.1), 2, max_iter=0)
    assert model.covariance is None
    assert model.fit is not None
    assert model.fit.reason == "maximum number of iterations"


def test_narrow_input():
    record = Record(*ANY_DATA["sine"])
    notes = notes_of(record, 2, max_iter=0)
    assert "the input is too narrow: it excites 3 of the 5 directions" in notes


def test_fewer_lines_than_unknowns():
    N = 64
    u = np.cos(2 * np.pi * np.arange(N) * 5 / N) + np.cos(2 * np.pi * np.arange(N) * 9 / N)
    record = Record(u, np.roll(u, 1), start="periodic")
    refused("2 excited line(s) make 4 equations; order nx=2 with 1 input(s) and 1 output", record)
    refused("has 5 unknowns: excite more lines, or lower nx.", record)


def test_error_and_data_must_go_together():
    record = record_of(random_system(1), "periodic")
    for nx in (0, -1):
        refused(f"nx is {nx}; give a whole number of at least 1", record, nx)
    refused("refine is 'output'; give 'simulation', 'prediction'", record, refine="output")
    refused("weight is for a response only: use refine='frequency'.", record, weight="noise")
    with pytest.raises(ValueError, match="refine is 'simulation', an error of records"):
        estimate_bla(estimate_frf(record), 1, refine="simulation")


class Race:
    """A problem whose candidates are known by their costs; which of them are searched?"""

    def __init__(self, minimum: float | None = None, *, large: bool = False) -> None:
        self.minimum, self.large, self.searched = minimum, large, list[float]()

    def most_candidates(self, nx: int) -> int:
        return 10

    def many(self, nx: int) -> bool:
        return self.large

    def search(self, matrices: float) -> SimpleNamespace:
        self.searched.append(matrices)
        cost = matrices if self.minimum is None else self.minimum
        search = SimpleNamespace(state=SimpleNamespace(cost=cost))
        search.advance = lambda *_: search
        return search

    def improbability(self, search: SimpleNamespace) -> float:
        return -search.state.cost

    def refined(self, search: SimpleNamespace) -> float:
        return search.state.cost


@pytest.mark.parametrize(
    ("race", "costs", "max_iter", "searched"),
    [
        (Race(), (1.0, 1.0005, 2.0, 9.9, 10.1, 50.0), 100, [1.0, 2.0, 9.9]),  # alike, hopeless
        (Race(), (1.0, 2.0, 9.9), minima.FIRST_STEPS, [1.0]),  # no steps to compare them
        (Race(minimum=0.5), (1.0, 2.0, 3.0, 4.0, 5.0), 100, [1.0, 2.0, 3.0]),  # all in one minimum
        (Race(large=True), (1.0, 1.02, 1.1, 1.3, 1.5, 1.7, 1.9), 100, [1.0, 1.1, 1.3, 1.5]),
    ],
)
def test_candidates_that_can_win_are_searched(
    race: Race, costs: tuple[float, ...], max_iter: int, searched: list[float], monkeypatch
):
    monkeypatch.setattr(minima, "search_from", lambda problem, matrices: problem.search(matrices))
    estimate: Any = SimpleNamespace(A=[0])
    field: Any = [minima.Candidate(cost, estimate, cast(Any, cost)) for cost in costs]
    _, found = minima.best_minimum(cast(Any, race), field, max_iter)
    assert race.searched == searched
    if not race.large and race.minimum is None:
        assert found == searched[-1]  # the most probable one, of the largest cost here


def settling_records(*, drift: float = 0.0) -> tuple[Record, Record]:
    """Five periods from rest, of which the first is the transient, and the last four of them."""
    rng, N, P = np.random.default_rng(0), 256, 5
    system = random_system(3, seed=2)
    u = np.tile(rng.normal(size=(N, 1)), (P, 1))
    y = reference.dlsim(system, u) + drift * np.linspace(0.0, 1.0, N * P)[:, None]
    y = y + 0.01 * y.std() * rng.normal(size=y.shape)
    steady = Record(u[N:], y[N:], start="periodic", period=N)
    return Record(u, y, period=N, skip=N), steady


def test_periods_after_the_transient_are_fitted_in_steady_state():
    whole, steady = settling_records()
    found, expected = estimate_bla(whole, 3), estimate_bla(steady, 3)
    np.testing.assert_allclose(found.poles, expected.poles, rtol=1e-9)


def test_rounded_periods_of_fewer_records_than_inputs_are_fitted():
    """Files round: two periods of two inputs differ, and one record has no two experiments."""
    rng, system = np.random.default_rng(0), random_system(2, 2, seed=2)
    u = np.tile(rng.normal(size=(256, 2)), (3, 1))
    y = reference.dlsim(system, u)[256:]
    u = u[256:] + 1e-7 * rng.normal(size=(512, 2))
    model = estimate_bla(Record(u, y, 10.0, "periodic", period=256), 2)
    assert frf_error(model, system) < 1e-4


def test_drift_is_no_steady_state():
    assert steady_state([settling_records()[0]]) is not None
    assert steady_state([settling_records(drift=30.0)[0]]) is None


# --- weights --------------------------------------------------------------------------------


def periods_of(system: System, distortion: float, seed: int) -> list[Record]:
    """Two realisations of two periods, noise 1e-3, and a cubic of the output."""
    design = multisine(128, realisations=2, seed=seed)
    records = []
    for u in design.u:
        y = reference.periodic_response(system, u)
        y = np.tile(y + distortion * y**3, (2, 1))
        y += 1e-3 * np.random.default_rng(seed).normal(size=y.shape)
        records.append(Record(np.tile(u, (2, 1)), y, 10.0, "periodic", period=128))
    return records


def test_deviation_of_a_fit_weighted_by_noise_counts_distortion():
    """The square mean of 10 deviations over that of the errors; the noise alone explains 1e-2."""
    system, f = random_system(2), np.array([0.5, 2.0, 4.0])
    models = [
        estimate_bla(estimate_frf(periods_of(system, 0.3, seed)), 2, weight="noise")
        for seed in range(10)
    ]
    errors = np.array([model.frf(f) for model in models])
    spread = np.mean(np.abs(errors - errors.mean(axis=0)) ** 2)
    known = np.mean([model.frf_std(f) ** 2 for model in models])  # pyright: ignore[reportOptionalOperand]
    assert 0.6 < np.sqrt(known / spread) < 1.6  # 30 numbers tell it to 0.2


@pytest.mark.parametrize(
    ("distortion", "nx", "weight", "cause"),
    [
        (0.3, 2, "noise", ": nonlinear distortion or too low an order"),
        (0.0, 1, "total", "total standard deviation: too low an order"),
        (0.0, 2, "noise", None),
        (0.0, 2, "total", None),
        (0.3, 2, "total", None),
        (0.3, 2, None, None),
    ],
)
def test_note_on_errors_far_above_their_deviation(distortion, nx, weight, cause):
    frf = estimate_frf(periods_of(random_system(2), distortion, 0))
    fit = estimate_bla(frf, nx, weight=weight).fit
    assert fit is not None
    notes = [note for note in fit.notes if "the error is" in note]
    assert len(notes) == (cause is not None)
    assert cause is None or cause in notes[0]


def test_a_random_record_with_a_good_model_has_no_note():
    frf = estimate_frf(record_of(random_system(3), "zero", noise=0.1))
    assert estimate_bla(frf, 3).fit.notes == frf.notes  # pyright: ignore[reportOptionalMemberAccess]
