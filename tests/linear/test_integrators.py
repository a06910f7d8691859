"""Integrators in a linear model: exact poles at 1, the system's response, and its precision."""

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
from scipy.signal import butter, freqz, lfilter

from lfrtorch._support.types import Array
from lfrtorch.data.records import Channel, Record
from lfrtorch.fitting.starts import initialise
from lfrtorch.linear import bla
from lfrtorch.linear.bla import estimate_bla
from lfrtorch.linear.frf import FRF, estimate_frf
from lfrtorch.linear.integrators import differenced_response, whitening_pole
from lfrtorch.linear.model import LinearModel
from lfrtorch.linear.order_scan import scan_orders

pytestmark = pytest.mark.numeric

T, FS = 400, 10.0
EXACT = 1e-9  # as in test_bla.py, times the integrators' gain
OMEGA = np.geomspace(0.01, 3.0, 30)
LAG = np.array([1.0, -0.9])


def filtered(u: Array, integrators: int, *, feedthrough: bool = False) -> Array:
    """A lag and integrators of the columns of u (T, n)."""
    a = LAG
    for _ in range(integrators):
        a = np.convolve(a, [1.0, -1.0])
    b = np.zeros(len(a))
    b[-1], b[0 if feedthrough else -2] = 0.02, 0.1
    return np.asarray(lfilter(b, a, u, axis=0))


def response(integrators: int, *, feedthrough: bool = False) -> Array:
    z = np.exp(1j * OMEGA)
    first = z ** (integrators + 1) if feedthrough else z
    return (0.1 * first + 0.02) / ((z - 0.9) * (z - 1) ** integrators)


def record(integrators: int = 1, *, noise: float = 0.0, load: float = 0.0, **more) -> Record:
    rng = np.random.default_rng(0)
    u = rng.standard_normal((T, 1))
    y = filtered(u, integrators)
    return Record(u + load, y + 3.0 + noise * rng.standard_normal((T, 1)), FS, **more)


def error(model: LinearModel, expected: Array, below: float = np.inf) -> float:
    """Largest relative error of the response at the frequencies OMEGA below a limit."""
    relative = np.abs(model.frf(OMEGA * FS / 2 / np.pi)[:, 0, 0] / expected - 1)
    return float(relative[below > OMEGA].max())


@pytest.mark.parametrize(("integrators", "start"), [(1, "zero"), (2, "estimated")])
def test_a_system_that_integrates_is_recovered(integrators: Literal[1, 2], start):
    data = record(integrators, start=start, load=0.5)
    model = estimate_bla(data, integrators + 1, integrators=integrators)
    assert np.sum(model.poles == 1.0) == integrators
    assert error(model, response(integrators)) < EXACT
    assert model.u_offset == pytest.approx(0.5, abs=EXACT)
    np.testing.assert_allclose(model.simulate(data), data.y, atol=1e-6)


def carriage(*, load: float = 0.0, noise: float = 0.0, **more: Any) -> Record:
    """Position and speed under a force that also tilts what measures the speed."""
    rng = np.random.default_rng(0)
    u = rng.standard_normal(T)
    speed = lfilter([0.0, 0.1], LAG, u)
    y = np.column_stack([lfilter([0.0, 0.1], [1.0, -1.0], speed) + 3.0, speed + 0.05 * u])
    return Record(u + load, y + noise * rng.standard_normal(y.shape), FS, **more)


HOLES = np.ones(T, dtype=bool)
HOLES[[5, 6, *range(100, 120), 250, T - 1]] = False


def with_holes(data: Record) -> Record:
    """A record whose outputs say nothing of it in holes."""
    return replace(data, y=np.where(HOLES[:, None], data.y, np.nan), valid=HOLES)


def clipped(data: Record) -> Record:
    """A record whose first output shows a half of its travel."""
    limits = np.full((2, data.y.shape[1]), [[-np.inf], [np.inf]])
    limits[:, 0] = np.quantile(data.y[:, 0], [0.25, 0.75])
    return replace(data, y=np.clip(data.y, *limits), limits=limits)


@pytest.mark.parametrize(
    ("integrators", "nx", "start", "lost"),
    [
        (1, 1, "zero", with_holes),
        (1, 1, "estimated", clipped),
        (1, 2, "zero", clipped),
        (1, 2, "estimated", with_holes),
        (2, 3, "zero", with_holes),
        (2, 3, "estimated", clipped),
    ],
)
def test_a_system_that_integrates_is_recovered_from_the_outputs_that_are_known(
    integrators: Literal[1, 2], nx: int, start, lost
):
    data = record(integrators, start=start, load=0.5)
    if nx == 1:  # an integrator alone
        data = replace(data, y=lfilter([0.0, 0.1], [1.0, -1.0], data.u - 0.5, axis=0))
    model = estimate_bla(lost(data), nx, integrators=integrators)
    expected = response(integrators) if nx > 1 else 0.1 / (np.exp(1j * OMEGA) - 1)
    assert error(model, expected) < EXACT
    np.testing.assert_allclose(model.simulate(data), data.y, atol=1e-6)
    assert model.fit is not None
    assert model.fit.rmse < EXACT


@pytest.mark.parametrize("lost", [with_holes, clipped])
def test_a_position_that_is_not_always_known_integrates_beside_its_speed(lost):
    data = carriage()
    model = estimate_bla(lost(data), 2, integrators=[1, 0])
    assert np.sum(model.poles == 1.0) == 1
    np.testing.assert_allclose(model.simulate(data), data.y, atol=1e-6)


@pytest.mark.parametrize("start", ["zero", "estimated"])
@pytest.mark.parametrize("load", [0.0, 2.0])
def test_a_position_integrates_beside_its_speed(start, load: float):
    data = carriage(load=load, start=start)
    model = estimate_bla(data, 2, integrators=[1, 0])
    np.testing.assert_allclose(np.sort(model.poles.real), [0.9, 1.0], atol=EXACT)
    assert np.sum(model.poles == 1.0) == 1
    np.testing.assert_allclose(model.simulate(data), data.y, atol=1e-6)
    np.testing.assert_allclose(model.D.ravel(), [0.0, 0.05], atol=EXACT)
    assert model.u_offset == pytest.approx(load, abs=EXACT)


def test_the_same_number_behind_each_output_is_one_number():
    one, each = (estimate_bla(record(noise=0.1), 2, integrators=n) for n in (1, [1]))
    assert np.array_equal(one.A, each.A)
    twice = Record(record().u, np.hstack([record().y, record(noise=0.1).y]), FS)
    one, each = (estimate_bla(twice, 3, integrators=n, max_iter=0) for n in (1, [1, 1]))
    assert np.array_equal(one.A, each.A)


def test_standard_errors_beside_an_output_that_does_not_integrate():
    model = estimate_bla(carriage(noise=0.01, start="estimated"), 2, integrators=[1, 0])
    assert model.covariance is not None
    parts = [m.size for m in (model.A, model.B, model.C, model.D)]
    assert model.covariance.shape == (sum(parts), sum(parts))
    _, _, of_C, of_D = np.split(np.sqrt(np.diag(model.covariance)), np.cumsum(parts)[:-1])
    np.testing.assert_array_equal(of_C.reshape(model.C.shape) > 0, [[False, False], [True, False]])
    np.testing.assert_array_equal(of_D > 0, [False, True])


@pytest.mark.parametrize(
    ("integrators", "message", "more"),
    [
        ([2, 0], "two are for all outputs or none", {}),
        ([1, 0, 0], "a list with one of them for each of 2 output", {}),
        ([1, 3], "give 0, 1 or 2", {}),
        ([1, 0], "a response has the same behind each output", {"refine": "frequency"}),
        ([0, 1], "integrators are for refine", {"refine": "prediction"}),
    ],
)
def test_lists_that_cannot_be(integrators, message: str, more: dict[str, Any]):
    with pytest.raises(ValueError, match=message):
        estimate_bla(carriage(), 2, integrators=integrators, **more)


def test_orders_that_hold_them_are_scanned():
    data = carriage(noise=0.01)
    scan = scan_orders(data, [1, 2, 3], validation=data, integrators=[1, 0])
    assert scan.orders[0] <= 2
    assert all(np.sum(model.poles == 1.0) == 1 for model in scan.models)


def in_motion(constant: float, samples: int) -> tuple[Record, Array, Array]:
    """A record cut in mid-motion, about a constant input, its noise, and the response."""
    begin, b, a = 300, [0.0, 0.3, 0.1], np.poly([1.0, 0.98])
    u, e = np.random.default_rng(1).standard_normal((2, begin + samples))
    y = lfilter(b, a, u) + 0.03 * e
    data = Record(u[begin:] + constant, y[begin:] + 5.0, FS, start="estimated")
    return data, 0.03 * e[begin:], freqz(b, a, OMEGA)[1]


@pytest.mark.parametrize("constant", [0.0, 3.0])
def test_a_constant_input_and_a_start_in_mid_motion(constant: float):
    """The filter's start is a parameter: it takes up neither the constant nor the motion."""
    data, noise, expected = in_motion(constant, 200)
    model = estimate_bla(data, 2, integrators=1)
    assert error(model, expected) < 0.05
    assert np.std(data.y - model.simulate(data)) < 1.05 * np.std(noise)
    assert model.u_offset == pytest.approx(constant, abs=1e-3)


@pytest.mark.slow
def test_records_that_begin_at_rest_and_in_mid_motion():
    moving, noise, expected = in_motion(2.0, 400)
    u = np.random.default_rng(2).standard_normal(500)
    y = lfilter([0.0, 0.3, 0.1], np.poly([1.0, 0.98]), u) + 5.0
    model = estimate_bla([Record(u + 2.0, y, FS), moving], 2, integrators=1)
    assert error(model, expected) < 0.02
    assert model.y_offset == pytest.approx(5.0, abs=0.05)
    assert np.std(moving.y - model.simulate(moving)) < 1.05 * np.std(noise)


def test_nothing_but_an_integrator_about_any_input():
    u, e = np.random.default_rng(1).standard_normal((2, 500))
    data = Record(u + 3.0, lfilter([0.0, 0.5], [1.0, -1.0], u) + 0.05 * e, start="estimated")
    model = estimate_bla(data, 1, integrators=1)
    assert (model.C @ model.B).item() == pytest.approx(0.5, rel=0.01)
    assert model.u_offset == pytest.approx(3.0, abs=1e-3)


@pytest.mark.parametrize(
    ("integrators", "b"), [(2, [0.0, 0.5, 0.5]), (1, [0.25, 0.25]), (2, [0.25, 0.5, 0.25])]
)
def test_an_input_that_acts_on_every_integrator(integrators: Literal[1, 2], b: list[float]):
    """A mass under a held force, 0.5 (z + 1) / (z - 1)², and Tustin's integrators."""
    rng, a = np.random.default_rng(0), np.poly([1.0] * integrators)
    u = lfilter(*butter(2, [0.01, 0.6], "bandpass"), rng.standard_normal(T))
    y = lfilter(b, a, u) + 1e-4 * rng.standard_normal(T)
    data = Record(u, y, FS, start="estimated")
    model = estimate_bla(data, integrators, integrators=integrators)
    assert (model.poles == 1.0).all()
    assert error(model, freqz(b, a, OMEGA)[1], below=2.0) < 1e-3


def test_a_fit_that_simulates_worse_is_not_returned(monkeypatch: pytest.MonkeyPatch):
    best = estimate_bla(record(noise=0.1), 2, integrators=1, max_iter=2)
    fits, placed = [], bla.placed

    def spoilt(*args: Any, **options: Any) -> LinearModel:
        fits.append(placed(*args, **options))
        assert fits[-1].fit is not None
        return replace(fits[-1], fit=replace(fits[-1].fit, rmse=float(len(fits))))

    monkeypatch.setattr(bla, "placed", spoilt)
    kept = estimate_bla(record(noise=0.1), 2, integrators=1, max_iter=2)
    assert len(fits) > 1
    assert (kept.A == fits[0].A).all()
    assert (kept.A != best.A).any()


def test_a_reference_is_no_hindrance_to_a_fit_by_simulation():
    data = record(noise=0.1, reference=np.zeros((T, 1)), start="estimated")
    model = estimate_bla(data, 1, integrators=1, refine="simulation")
    assert np.sum(model.poles == 1.0) == 1


@pytest.mark.slow
def test_an_input_that_acts_at_once():
    u = np.random.default_rng(0).standard_normal(T)
    y = lfilter([0.1, 0.02], np.convolve(LAG, [1, -1]), u)
    model = estimate_bla(Record(u, y, FS), 2, integrators=1)
    z = np.exp(1j * OMEGA)
    assert error(model, z * (0.1 * z + 0.02) / ((z - 0.9) * (z - 1))) < EXACT
    assert not estimate_bla(Record(u, y, FS), 2, integrators=1, feedthrough=False).D.any()


def test_nothing_but_integrators():
    u = np.random.default_rng(0).standard_normal((T, 2))
    y = lfilter([0, 1], [1, -1], u @ [[1.0, 0.2], [0.0, -2.0]], axis=0)
    model = estimate_bla(Record(u, y, FS), 2, integrators=1)
    assert (model.poles == 1.0).all()
    np.testing.assert_allclose(model.simulate(Record(u, y, FS)), y, atol=1e-9)


def test_each_output_has_its_own():
    u = np.random.default_rng(0).standard_normal((200, 2))
    y = filtered(u, 1) @ [[1.0, 0.5], [0.0, 2.0]] + 100.0
    model = estimate_bla(Record(u, y, FS, start="estimated"), 4, integrators=1)
    G = model.frf(OMEGA * FS / 2 / np.pi)
    expected = response(1)[:, None, None] * np.array([[1.0, 0.0], [0.5, 2.0]])
    np.testing.assert_allclose(G, expected, atol=EXACT * np.abs(expected).max())


def test_noise_of_the_output_costs_no_precision():
    """A fit to the difference alone has the error 1 in the slow part."""
    noise = 0.3
    model = estimate_bla(record(noise=noise, start="estimated"), 2, integrators=1)
    slow = model.frf(OMEGA[:5] * FS / 2 / np.pi)[:, 0, 0] / response(1)[:5]
    assert np.abs(slow - 1).max() < 0.02 * noise
    left = record(noise=noise).y - model.simulate(record(noise=noise, start="estimated"))
    assert np.std(left) < 1.02 * noise


@pytest.mark.slow
def test_errors_that_the_system_integrates():
    """A fit to the output follows their drift; the fast part is then anything."""
    data = record(start="estimated")
    walk = np.cumsum(np.random.default_rng(5).standard_normal((T, 1)), axis=0)
    model = estimate_bla(replace(data, y=data.y + 0.1 * walk), 2, integrators=1)
    assert error(model, response(1)) < 0.25


def test_whitening():
    e = np.random.default_rng(0).standard_normal((20000, 1))
    for n, pole in ((1, 0.0), (1, 0.7), (2, 0.5)):
        coloured = e
        for _ in range(n):
            coloured = lfilter([1, -pole], [1], coloured, axis=0)
        assert whitening_pole([coloured], n) == pytest.approx(pole, abs=0.05)
    assert whitening_pole([np.cumsum(e, axis=0)], 1) == 0.0
    filtered_twice = lfilter(np.poly([0.5, 0.5]), np.poly([0.8, 0.8]), e, axis=0)
    assert whitening_pole([filtered_twice], 2, pole=0.8) == pytest.approx(0.5, abs=0.05)


def test_a_response_that_integrates():
    u = np.tile(np.random.default_rng(0).standard_normal((300, 1)), (3, 1))
    u -= u.mean()
    e = 0.01 * np.random.default_rng(1).standard_normal(u.shape)
    frf = estimate_frf(Record(u[300:], (filtered(u, 1) + e)[300:], FS, "periodic", period=300))
    model = estimate_bla(frf, 2, integrators=1)
    assert np.sum(model.poles == 1.0) == 1
    assert error(model, response(1)) < 0.02
    f = frf.frequencies[5:50]
    once = estimate_bla(differenced_response(frf, 1), 1, weight="noise")
    factor = np.abs(np.exp(2j * np.pi * f / FS) - 1)[:, None, None]
    np.testing.assert_allclose(factor * model.frf_std(f), once.frf_std(f), rtol=1e-6)


def test_a_response_of_a_mass_with_a_lag():
    b, a = [0.0, 0.05, 0.19, 0.04], np.poly([0.6, 1.0, 1.0])
    f, none, one = np.arange(1, 200) * FS / 400, np.zeros(1), (Channel("u"),)
    G = freqz(b, a, 2 * np.pi * f / FS)[1][:, None, None]
    frf = FRF(f, G, FS, none, none, one, one, None, None, 1, 1, "robust")
    assert error(estimate_bla(frf, 3, integrators=2), freqz(b, a, OMEGA)[1]) < EXACT


def test_states_have_unit_deviation_and_start_a_nonlinear_model():
    data = record(start="estimated", noise=0.1)
    linear = estimate_bla(data, 2, integrators=1)
    states = linear.to_model().simulate(data)
    model = initialise(linear, data, nz=1, nw=1, nn=3)
    np.testing.assert_allclose(model.simulate(data), states, atol=1e-8)
    assert np.abs(model.lfr.cell.A.detach().numpy()).max() < 3


@pytest.mark.slow
def test_orders_below_the_integrators(tmp_path):
    data = record(2, start="estimated", noise=0.1)
    scan = scan_orders(data, [1, 2, 3], integrators=2)
    assert scan.orders == (2, 3)
    saved = LinearModel.load(scan.best.save(tmp_path / "model"))
    assert (saved.A == scan.best.A).all()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"integrators": 3}, "give 0, 1 or 2"),
        ({"integrators": [1, 0]}, "a list with one of them for each of 1 output"),
        ({"integrators": 2, "nx": 1}, "raise nx"),
        ({"integrators": 1, "refine": "prediction"}, "integrators are for refine"),
        ({"integrators": 1, "nx": 1, "refine": "frequency"}, "a fit to a response takes one more"),
    ],
)
def test_refused(options: dict[str, Any], said: str):
    with pytest.raises(ValueError, match=said):
        estimate_bla(record(), options.pop("nx", 2), **options)


def test_a_steady_state_is_refused():
    data = record(start="periodic")
    with pytest.raises(ValueError, match="no steady state of its own"):
        estimate_bla(data, 2, integrators=1)
