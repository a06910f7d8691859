"""Integrators in a linear model: exact poles at 1, the system's response, and its precision."""

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
from scipy.signal import lfilter

from lfrtorch._support.types import Array
from lfrtorch.fitting.starts import initialise
from lfrtorch.linear.bla import estimate_bla
from lfrtorch.linear.frf import estimate_frf
from lfrtorch.linear.integrators import differenced_response, whitening_pole
from lfrtorch.linear.model import LinearModel
from lfrtorch.linear.order_scan import scan_orders
from lfrtorch.records import Record

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


def error(model: LinearModel, expected: Array) -> float:
    """Largest relative error of the response at all frequencies."""
    return float(np.abs(model.frf(OMEGA * FS / 2 / np.pi)[:, 0, 0] / expected - 1).max())


@pytest.mark.parametrize(("integrators", "start"), [(1, "zero"), (2, "estimated")])
def test_a_system_that_integrates_is_recovered(integrators: Literal[1, 2], start):
    data = record(integrators, start=start, load=0.5)
    model = estimate_bla(data, integrators + 1, integrators=integrators)
    assert np.sum(model.poles == 1.0) == integrators
    assert error(model, response(integrators)) < EXACT
    assert model.u_offset == pytest.approx(0.5, abs=EXACT)
    np.testing.assert_allclose(model.simulate(data), data.y, atol=1e-6)


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


def test_a_response_that_integrates():
    u = np.tile(np.random.default_rng(0).standard_normal((300, 1)), (3, 1))
    u -= u.mean()
    e = 0.01 * np.random.default_rng(1).standard_normal(u.shape)
    frf = estimate_frf(Record(u[300:], (filtered(u, 1) + e)[300:], FS, "periodic", period=300))
    model = estimate_bla(frf, 2, integrators=1)
    assert np.sum(model.poles == 1.0) == 1
    assert error(model, response(1)) < 0.02
    f = frf.frequencies[5:50]
    once = estimate_bla(differenced_response(frf, 1, feedthrough=False), 1, weight="noise")
    factor = np.abs(np.exp(2j * np.pi * f / FS) - 1)[:, None, None]
    np.testing.assert_allclose(factor * model.frf_std(f), once.frf_std(f), rtol=1e-6)


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
        ({"integrators": 2, "nx": 1}, "raise nx"),
        ({"integrators": 1, "refine": "prediction"}, "integrators are for refine"),
    ],
)
def test_refused(options: dict[str, Any], said: str):
    with pytest.raises(ValueError, match=said):
        estimate_bla(record(), options.pop("nx", 2), **options)


def test_a_steady_state_is_refused():
    data = record(start="periodic")
    with pytest.raises(ValueError, match="no steady state of its own"):
        estimate_bla(data, 2, integrators=1)


def test_a_note_asks_for_integrators():
    u = np.random.default_rng(0).standard_normal(1000)
    data = Record(u, lfilter([0, 1], np.poly([1.0, 0.5]), u), start="estimated")
    (said,) = [note for note in notes_of(data) if note.startswith("output")]
    assert said == "output 'y' integrates: use integrators=1 for exact poles at z = 1."
    assert notes_of(data, integrators=1) == ()
    leaky = replace(data, y=lfilter([0, 1, 0.2], np.convolve(LAG, [1, -0.3]), data.u, axis=0))
    assert notes_of(leaky) == ()


def notes_of(data: Record, **options: Any) -> tuple[str, ...]:
    fit = estimate_bla(data, 2, max_iter=0, **options).fit
    assert fit is not None
    return fit.notes
