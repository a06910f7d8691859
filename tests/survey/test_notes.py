"""What hurts is said, and nothing is said of measurements that were made well."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat
from scipy.signal import butter, lfilter, sosfilt

from lfrtorch._support.types import Array
from lfrtorch.data.records import Channel, Record
from lfrtorch.datasets import boucwen, parwh, silverbox, wiener_hammerstein
from lfrtorch.survey.measurement import survey_measurement
from lfrtorch.survey.notes import examine, notes_on

pytestmark = pytest.mark.numeric

T = 5000
NOISE = 0.01


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def u(rng):
    return rng.standard_normal(T)


def found(u, y, fs=None, **more) -> dict[str, str]:
    """Notes by the first word of their kind."""
    u, y = (np.asarray(a).reshape(len(y), -1) for a in (u, y))
    return {
        kind.split()[0]: text for kind, text in examine(survey_measurement(u, y, fs, **more), u, y)
    }


def lag(u: Array, pole: float = 0.9, noise: float = NOISE) -> Array:
    """A first-order system of gain 1 with a delay of one sample, and noise."""
    y = lfilter([0, 1 - pole], [1, -pole], u)
    return y + noise * y.std() * np.random.default_rng(1).standard_normal(len(y))


def resonance(u: Array) -> Array:
    return lfilter([0, 1], np.poly(0.97 * np.exp([0.3j, -0.3j])).real, u)


# --- systems of every kind are fine, and swapped ones are not -----------------------------------

SYSTEMS: dict[str, Callable[[Array], Array]] = {
    "static": lambda u: 2 * u,
    "first order": lag,
    "noisy": lambda u: lag(u, noise=1.0),
    "resonance": resonance,
    "feed-through": lambda u: u + lag(u),
    "high pass": lambda u: lfilter([1, -1], [1, -0.5], u),
    "difference": lambda u: lfilter([1, -1], [1], u),
    "integrator": lambda u: lfilter([0, 1], [1, -1], u),
    "non-minimum phase": lambda u: lfilter([1, -1.2], [1, -0.8], u),
    "cubic": lambda u: lag(u + 0.3 * u**3),
    "saturation": lambda u: np.tanh(2 * lag(u, 0.5)),
}
REVERSED = ("first order", "noisy", "resonance", "non-minimum phase", "cubic", "saturation")
"""Exchanged signals show in these: the others have feed-through, or no memory that would tell."""


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize("coloured", [False, True])
def test_nothing_is_said_of_usual_systems(system, coloured, u):
    if coloured:
        u = sosfilt(butter(3, 0.3, output="sos"), u)
    y = SYSTEMS[system](u)
    y = y + NOISE * y.std() * np.random.default_rng(2).standard_normal(T)
    assert set(found(u, y)) == ({"integrates"} if system == "integrator" else set())
    assert ("swapped" in found(y, u)) == (system in REVERSED) or coloured


def test_an_integrator_fed_through_is_not_swapped(u):
    assert set(found(lfilter([1, -1], [1], u), u)) <= {"integrates"}


def test_feedback_is_not_swapped(rng):
    r, e = rng.standard_normal((2, T))
    u, y, x = np.zeros(T), np.zeros(T), 0.0
    for k in range(T):
        y[k] = x + 0.05 * e[k]
        u[k] = r[k] - 2 * y[k]
        x = 0.9 * x + 0.1 * u[k]
    assert found(u, y) == {}


def test_several_channels(rng):
    u = rng.standard_normal((T, 3))
    y = np.column_stack([lag(u[:, 0]) + lag(u[:, 1], 0.8), resonance(u[:, 2])])
    assert found(u, y) == {}
    assert set(found(y, u)) == {"swapped"}


@pytest.mark.parametrize("pole", [0.5, 0.9, 0.97])
def test_short_records_raise_no_alarm(pole):
    for seed, samples in enumerate((300, 400, 500, 700, 1000)):
        u = np.random.default_rng(seed).standard_normal(samples)
        assert found(u, lag(u, pole, noise=0.1)) == {}


# --- each note, and what is near it and fine -----------------------------------------------------


def test_missing(u):
    y = lag(u)
    y[100:105] = np.nan
    assert "'y1' misses 5 of 5000 samples, up to 5 in a row" in found(u, y)["missing"]
    assert "no values at all" in found(u, np.full(T, np.nan))["missing"]


def test_constant(u):
    y = lag(u)
    both = np.column_stack([u, np.full(T, 3.0)])
    assert "input 'u2' is constant at 3: it tells nothing, unless" in found(both, y)["constant"]
    assert "output 'y1' is constant" in found(u, np.ones(T))["constant"]
    assert "'y2' is constant at 3" in found(np.empty((T, 0)), both)["constant"]


def test_an_input_that_differs_between_records_is_not_left_out(u):
    records = [Record(np.column_stack([u, np.full(T, v)]), v * lag(u)) for v in (0.5, 1.0, 2.0)]
    assert notes_on(records) == []
    assert "constant at 0.5" in notes_on(records[:1])[0]
    assert "and 1 more: input 'u2' is constant" in notes_on([records[0], records[0]])[0]


def test_an_input_that_moves_in_skipped_samples_alone_is_not_left_out():
    u = np.zeros(T)
    u[10:14] = 5.0
    assert notes_on(Record(u, lag(u, 0.99), skip=20)) == []


def test_a_step_at_the_first_sample_is_not_left_out():
    u = np.full(T, 7.0)
    said = found(u, lag(u))["constant"]
    assert "put samples from before the step in front" in said
    assert "leave it out" not in said


def step(at: int, pole: float = 0.9, noise: float = NOISE) -> tuple[Array, Array]:
    u = np.where(np.arange(T) < at, 0.0, 1.0)
    return u, lag(u, pole, noise)


def test_a_step_response_is_not_cut_off():
    said = found(*step(500))
    assert "no input or output moves in 90 % of the record (samples 525 to" in said["still"]
    slow = found(*step(500, pole=0.9995))  # is on its way in the whole record
    assert "still" not in slow


def test_input_at_rest(u):
    u[1000:3000] = 0.5
    said = found(u, lag(u))
    assert set(said) == {"still"}
    assert "moves in 40 % of the record (samples 1025 to 3000)" in said["still"]
    u[1000:3000] += 1e-3 * np.random.default_rng(3).standard_normal(2000)  # as measured
    assert set(found(u, lag(u))) == {"still"}


def test_inputs_that_move_in_turn_do_not_rest(u):
    first = np.where(np.arange(T) < T / 2, u, 0)
    assert found(np.column_stack([first, u - first]), lag(u)) == {}


def test_an_input_of_growing_amplitude_does_not_rest(u):
    u = u * np.linspace(0, 1, T)
    assert found(u, lag(u)) == {}


def test_clipped_output(u):
    y = lag(u)
    said = found(u, np.minimum(y, 0.4))
    assert set(said) == {"clipped"}
    share = 100 * np.mean(y >= 0.4)
    assert f"largest value 0.4 in {np.sum(y >= 0.4)} samples ({share:.2g} %)" in said["clipped"]
    assert "smallest value -0.4" in found(u, np.maximum(y, -0.4))["clipped"]


def test_steps_of_a_converter_are_not_clipped_but_coarse():
    t = np.arange(T)
    u = np.sin(0.03 * t) + np.sin(0.11 * t) + np.sin(0.23 * t) + np.sin(0.31 * t) + np.sin(0.4 * t)
    y = lag(u, 0.5, noise=0)
    said = found(u, np.round(y / 0.2) * 0.2)
    assert set(said) == {"coarse"}
    assert "in steps of 0.2" in said["coarse"]
    assert "rms error of about 0.058" in said["coarse"]
    assert found(u, np.round(y / 0.02) * 0.02) == {}


@pytest.mark.parametrize("noise", [0.0, NOISE])
def test_what_rests_is_not_clipped(noise: float):
    """Before a step, after one, and between pulses, exactly or in steps of a converter."""
    u, y = step(500, noise=noise)
    y[:500] = 0.0
    assert "clipped" not in found(u, y)
    assert "clipped" not in found(u, np.round(y, 2))
    pulses = np.where(np.arange(T) % 500 < 40, 1.0, 0.0)
    assert "clipped" not in found(pulses, np.round(lag(pulses, noise=noise), 1 if noise else 4))


def test_levels_that_are_held_may_be_clipped():
    u = np.repeat(np.random.default_rng(0).uniform(-1, 1, T // 50), 50)
    assert "clipped" in found(u, np.minimum(lag(u), 0.5))


@pytest.mark.parametrize("value", [-9999.0, 999.9])
def test_marks_for_missing_values(value: float, u):
    y = lag(u)
    y[[100, 700, 701, 2000, 3000]] = value
    said = found(u, y)
    assert set(said) == {"mark"}
    assert f"is exactly {value:g} in 5 samples, at 100, 700, 701, 2000, 3000" in said["mark"]
    assert "empty these cells" in said["mark"]
    v = u.copy()
    v[[5, 900, 901]] = value
    assert "fill these cells" in found(v, lag(u))["mark"]


def test_a_frozen_sensor(u):
    for samples in (30, 60, 120):
        y = lag(u)
        y[2000 : 2000 + samples] = y[2000]
        said = found(u, y)
        assert set(said) == {"frozen"}
        assert f"in samples 2000 to {1999 + samples}, while the input moves" in said["frozen"]


def test_a_dropout_to_zero(u):
    for offset in (0.0, 2.0, 6.0):  # inside, at the end of and outside the output's range
        y = lag(u) / 0.23 + offset
        y[2000:2020] = 0.0
        assert "stays exactly at 0 in samples 2000 to 2019" in found(u, y)["frozen"]


def test_an_output_at_rest_with_its_input_is_not_stuck(u):
    u[1000:1900] = 0.0
    y = np.round(lag(u, 0.5, noise=0), 4)
    assert not {"frozen", "clipped"} & {*found(u, y)}


def test_binary_input(u):
    assert "two values only" in found(np.sign(u), lag(np.sign(u)))["binary"]
    levels = np.round(2 * u)
    assert found(levels, lag(levels)) == {}


@pytest.mark.parametrize(("count", "narrow"), [(1, True), (3, True), (20, False)])
def test_few_frequencies(count, narrow):
    f = np.linspace(0.01, 0.4, count + 1)[1:]
    u = np.cos(2 * np.pi * np.outer(np.arange(T), f) + np.arange(count) ** 2).sum(axis=1)
    said = found(u, lag(u))
    assert set(said) == ({"narrow"} if narrow else set())
    assert not narrow or f"excites {count} frequenc" in said["narrow"]


def test_narrow_band(u):
    narrow = sosfilt(butter(4, [0.3, 0.305], "bandpass", output="sos"), u)
    said = found(narrow, lag(narrow), 100.0)
    assert "excites 14.9" in said["narrow"]
    assert " to 15.3" in said["narrow"]


def test_oversampled(u):
    slow = sosfilt(butter(4, 0.008, output="sos"), u)
    said = found(slow, lag(slow, 0.99, noise=0), 1000.0)
    assert set(said) == {"oversampled"}
    assert "Hz, fs / " in said["oversampled"]
    factor = int(said["oversampled"].split("Decimate by ")[1].split()[0])
    assert f"unless modes above {500 / factor:.3g} Hz" in said["oversampled"]
    faster = sosfilt(butter(4, 0.1, output="sos"), u)
    assert found(faster, lag(faster, noise=0)) == {}


@pytest.mark.parametrize("skip", [0, 7])
def test_inputs_that_a_slow_clock_holds(skip: int, rng):
    """Those at which the inputs change are among the ones to keep."""
    u = np.repeat(lfilter([0.2], [1, -0.8], rng.standard_normal(T // 20)), 20)
    (said,) = notes_on(Record(u, lag(u, 0.98), fs=1000.0, skip=skip))
    assert said.startswith("the inputs change every 20 samples only")
    assert f"one sample in 5, sample {20 if skip else 0} among them" in said
    assert "unless modes above 100 Hz matter" in said


@pytest.mark.parametrize("pole", [0.5, 0.9])
def test_steps_to_levels_are_no_slow_clock(pole: float, rng):
    """The output settles within a step, or steps last for times of their own."""
    levels = rng.uniform(-1, 1, T // 50)
    even = np.repeat(levels, 50)
    assert "held" not in found(even, lag(even, pole))
    uneven = np.repeat(levels, rng.integers(30, 70, len(levels)))
    assert "held" not in found(uneven, lag(uneven, 0.99))


def test_periods(u):
    period = 3000
    u = np.resize(u[:period], T)
    assert "1.67 periods of 3000 samples" in found(u, lag(u), period=period)["periods"]
    assert found(u, lag(u), period=T) == {}
    assert found(u, lag(u), period=2500) == {}


def test_inputs_that_are_the_same(u):
    said = found(np.column_stack([u, 3 - 2 * u]), lag(u))
    assert "'u1' and 'u2' carry the same signal (correlation -1.0000)" in said["same"]


def test_short(u):
    assert found(u[:200], lag(u[:200]))["short"].startswith("200 samples are few")
    (note,) = notes_on(Record(u[:200], lag(u[:200]), skip=20))
    assert note.startswith("180 samples after the 20 that are skipped are few")
    assert set(found(u[:3], u[:3])) == {"short"}


@pytest.mark.parametrize("delay", [7, 37, 200])
def test_delay(delay, u):
    y = lag(np.concatenate([np.zeros(delay), u[: T - delay]]))
    said = found(u, y, 50.0)
    assert set(said) == {"delay"}
    assert f"dead time of about {delay} samples ({delay / 50:.3g} s) from input" in said["delay"]
    assert "swapped" in found(y, u)


@pytest.mark.parametrize("share", [1.0, 0.6])
@pytest.mark.parametrize("hold", [1, 20])
def test_a_dead_time_is_the_same_in_a_part_of_the_record(share: float, hold: int):
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1, 1, 2000 // hold), hold)
    y = lag(lfilter([0.2], [1, -0.8], np.concatenate([np.zeros(10), u[:-10]])), 0.9, 0.02)
    part = slice(0, round(2000 * share))
    assert "dead time of about 10 samples" in found(u[part], y[part])["delay"]


def test_a_slow_system_has_no_delay(u):
    for noise in (1e-3, NOISE, 0.1):
        assert found(u, lag(lag(lag(u, 0.95, 0), 0.95, 0), 0.95, noise)) == {}


@pytest.mark.parametrize("kind", ["lines", "levels", "ramps"])
def test_a_slow_resonance_under_a_smooth_input_has_no_dead_time(kind: str):
    """It rises unseen in the noise, or the input's past tells its present."""
    rng, k = np.random.default_rng(0), np.arange(3000)
    lines = np.zeros(1501, complex)
    lines[1:375] = np.exp(2j * np.pi * rng.random(374))
    u = {
        "lines": 30 * np.fft.irfft(lines, 3000),
        "levels": np.repeat(rng.uniform(-1, 1, 60), 50),
        "ramps": np.interp(k, k[::200], rng.uniform(-1, 1, 15)),
    }[kind]
    pole = 0.03 * (-0.1 + 1j * np.sqrt(0.99))
    a = np.poly(np.exp([pole, np.conj(pole)])).real
    for noise in (0.0, 0.05):
        y = lfilter([0, 1, 1], a, u)
        y += noise * y.std() * np.random.default_rng(1).standard_normal(3000)
        assert "delay" not in found(u, y)


def test_drift(u):
    y, line = lag(u), np.linspace(0, 1, T)
    assert "drifts by 1" in found(u, y + line)["drift"]
    assert found(u, y + 0.1 * line) == {}
    assert found(u + line, lag(u + line)) == {}  # its cause is the input's


@pytest.mark.parametrize("scale", [1.0, 1e-9])
def test_a_gain_that_changes(scale: float, u):
    y = lag(np.tanh(u)) + 3.0
    for gain in (0.5, 2.0):
        said = found(scale * u, np.where(np.arange(T) < 2000, y, gain * y) / scale)
        assert set(said) == {"gain"}
        sample = int(said["gain"].split("sample ")[1].split()[0])
        assert abs(sample - 2000) < 50
        ratio = float(said["gain"].split(" times")[0].split()[-1])
        assert ratio == pytest.approx(gain, rel=0.1)


def test_a_gain_that_depends_on_the_level_does_not_change(u):
    for level in (0.5, 2.0):
        v = 0.3 * u + np.where(np.arange(T) < T / 2, 0.0, level)
        assert "gain" not in found(v, lag(np.exp(v)))
    louder = np.where(np.arange(T) < T / 2, u, 3 * u)
    assert found(louder, np.tanh(lag(louder, 0.5))) == {}


@pytest.mark.parametrize("pole", [0.5, 0.9])
def test_a_lost_sample(pole: float, u):
    y = lag(u, pole)
    for at in (2000, 3000):
        said = found(u[:-1], np.delete(y, at))
        assert set(said) == {"lost"}
        assert "a sample of the output may be lost" in said["lost"]
        sample = int(said["lost"].split("sample ")[1].split()[0])
        assert abs(sample - at) < 50
        assert "a sample of the inputs may be lost" in found(np.delete(u, at), y[:-1])["lost"]


def test_integrating_output(u):
    """Of all inputs, and no matter what the noise is; the line that it drifts along is its own."""
    y = lfilter([0, 1], np.poly([1.0, 0.9]), u + 0.1)
    said = found(u, y)
    assert set(said) == {"integrates"}
    assert "use integrators=1 and start='estimated'" in said["integrates"]
    slow = np.convolve(u, np.ones(20) / 20, "same")
    twice = found(slow, np.cumsum(np.cumsum(slow)))
    assert "integrators=2" in twice["integrates"]
    both = found(np.column_stack([u, u[::-1]]), lfilter([0, 1], [1, -1], u - 2 * u[::-1]))
    assert set(both) == {"integrates"}


def carriage(u: Array, *, friction: float = 0.02) -> Array:
    """Position and speed of a carriage under a force, from rest, with noise."""
    speed = lfilter([0, 1], [1, friction - 1], u)
    noise = NOISE * np.random.default_rng(1).standard_normal((len(u), 2))
    return np.column_stack([lfilter([0, 1], [1, -1], speed), speed]) + noise


def test_an_output_that_integrates_another(u):
    said = found(u, carriage(u), outputs=[Channel("place"), Channel("speed")])
    assert {*said} == {"rate"}
    assert said["rate"].startswith("output 'place' integrates output 'speed'")
    assert "integrators=[1,0]" in said["rate"]
    lags = np.column_stack([lag(lag(u)), lag(u)])  # the first follows the second, and forgets
    assert found(u, lags) == {}


@pytest.mark.parametrize(("omega", "damping"), [(0.3, 0.2), (0.05, 0.1), (0.01, 1.0)])
def test_a_place_on_a_spring_does_not_integrate(u, omega: float, damping: float):
    """It is the integral of its speed all the same."""
    pole = omega * (-damping + 1j * np.sqrt(1 - damping**2))
    a = np.poly(np.exp([pole, np.conj(pole)])).real
    signals = [lfilter(b, a, u) for b in ([0, 0, 1], [0, 1, -1], [1, -2, 1])]
    said = found(u, np.column_stack(signals))
    assert not {"rate", "chain", "integrates"} & {*said}


def test_a_chain_of_outputs_tells_the_states(u):
    slope = lfilter([0, 1], [1, -0.98], u)
    turned = np.cumsum(slope)
    said = found(u, np.column_stack([np.cumsum(turned), turned, slope]))
    assert {*said} == {"chain"}
    wild = np.random.default_rng(2).standard_normal(T)  # as if a controller made the input
    held = np.column_stack([np.cumsum(np.cumsum(turned)), np.cumsum(turned), turned, slope])
    assert "chain" in found(wild, held)
    assert "use start='measured', as the outputs are the states, and horizon=N" in said["chain"]


def test_what_is_settled_needs_no_advice_on_integrators(u):
    record = Record(u, carriage(u))
    assert "integrators=[1,0]" in notes_on(record)[0]
    assert "integrators=[1,0]" in notes_on(replace(record, start="estimated"))[0]
    assert notes_on(replace(record, start="measured")) == []
    assert notes_on(record, given={"integrators": [1, 0]}) == []


@pytest.mark.parametrize("constants", [5, 10, 50])
def test_a_slow_system_does_not_integrate(constants, u):
    """It forgets several times in the record."""
    assert found(u, lag(u, 1 - constants / T)) == {}


def test_a_random_walk_that_no_input_makes_does_not_integrate(u, rng):
    assert "integrates" not in found(u, np.cumsum(rng.standard_normal(T)))


def drive(friction: float, noise: float, *, feedback: bool = True) -> tuple[Array, Array]:
    """Force and position of a mass under a controller of the measured position."""
    rng = np.random.default_rng(0)
    e, wanted = noise * rng.standard_normal(T), np.repeat(rng.uniform(-1, 1, T // 200), 200)
    u, y = np.zeros(T), np.zeros(T)
    x, v, last = 0.0, 0.0, 0.0
    for k in range(T):
        y[k] = x + e[k]
        u[k] = 0.5 * (wanted[k] - last) - 3 * v + 0.02 * rng.standard_normal()
        last = y[k] if feedback else x
        held = v == 0 and abs(u[k]) < friction
        force = 0.0 if held else u[k] - friction * np.sign(v if v else u[k])
        after = 0.95 * v + 0.05 * force
        v = 0.0 if friction and after * v < 0 else after
        x += 0.1 * v
    return u, y


def test_dry_friction():
    said = found(*drive(0.1, 0.0))
    assert "input 'u1' changes with the direction of 'y1'" in said["friction"]
    assert set(found(*drive(0.0, 0.0))) == {"integrates"}


def test_a_binary_force_is_no_friction(u):
    u = np.repeat(np.sign(u[: T // 50]), 50)
    assert "friction" not in found(u, lag(u, noise=0))


def test_feedback():
    said = found(*drive(0.0, 0.1))
    assert "input 'u1' reacts to the output" in said["feedback"]
    assert "prediction" not in said["feedback"]
    assert set(found(*drive(0.0, 0.1, feedback=False))) == {"integrates"}


def test_feedback_of_a_system_that_forgets(rng):
    u, y, x, r = np.zeros(T), np.zeros(T), 0.0, rng.standard_normal(T)
    for k in range(T):
        u[k] = r[k] - 0.5 * y[k - 1]
        y[k] = x + 0.5 * rng.standard_normal()
        x = 0.9 * x + 0.1 * u[k]
    assert "feedthrough=False and refine='prediction'" in found(u, y)["feedback"]
    (note,) = notes_on(Record(u, y), given={"feedthrough": False})
    assert "try refine='prediction'" in note
    assert "reference=r, and compare with a fit without" in note
    assert "compare" not in notes_on(Record(u, y), given={"refine": "prediction"})[0]
    assert notes_on(Record(u, y, reference=r)) == []
    assert notes_on(Record(u, y), given={"feedthrough": False, "refine": "prediction"}) == []


def test_a_fault_in_one_place_is_no_feedback():
    """A clock that was set back shuffles the samples of two stretches; a sensor freezes."""
    rng = np.random.default_rng(0)
    u = lfilter([1], [1, -0.6], rng.standard_normal(3000))
    y = lfilter([0, 0.1], [1, -1.6, 0.7], u) + 0.02 * rng.standard_normal(3000)
    order = np.arange(3000)
    order[1300:1900] = order[1300:1900].reshape(2, 300).T.ravel()
    assert "feedback" not in found(u[order], y[order])
    y[1300:1420] = y[1300]
    assert set(found(u, y)) == {"frozen"}


def test_an_input_that_repeats_exactly_is_not_made_by_a_controller():
    u = np.where(np.arange(3000) % 400 < 20, 1.0, 0.0)
    assert "feedback" not in found(u, np.tanh(1.5 * lfilter([0, 0.3], [1, -1.3, 0.6], u)))


def test_feedback_in_the_same_sample_is_seen_without_feedthrough(rng):
    u, y, x = np.zeros(T), np.zeros(T), 0.0
    e = rng.standard_normal((2, T))
    for k in range(T):
        y[k] = x + e[0, k]
        u[k] = e[1, k] - 0.5 * y[k]
        x = 0.9 * x + 0.1 * u[k]
    assert "feedback" not in found(u, y)
    given = {"feedthrough": False}
    (note,) = notes_on(Record(u, y), given=given)
    assert note.startswith("input 'u' reacts to the output")
    y = np.append(0.0, lfilter([0.1], [1, -0.9], e[1])[:-1]) + e[0]
    assert not any("reacts" in note for note in notes_on(Record(e[1], y), given=given))


def test_unrelated(u, rng):
    assert "hardly anything of output 'y1'" in found(u, rng.standard_normal(T))["unrelated"]
    assert "unrelated" in found(u, lag(u, 0.5) ** 2)  # purely even


# --- records --------------------------------------------------------------------------------------


def test_notes_of_records(u):
    bad = Record(u, np.minimum(lag(u), 0.3), name="a", outputs=(Channel("level", "V"),))
    (sentence,) = notes_on(bad)
    assert sentence.startswith("output 'level' has its largest value 0.3")
    (sentence,) = notes_on([replace(bad, y=lag(u)), bad, replace(bad, name="c"), bad])
    assert sentence.startswith("record 'a' and 2 more: output 'level' has")
    assert notes_on(replace(bad, y=lag(u))) == []


def test_a_start_that_is_estimated_needs_no_advice(u):
    record = Record(u, lfilter([0, 1], [1, -1], u))
    assert "start='estimated'" in notes_on(record)[0]
    assert "use start='estimated'" in notes_on(record, given={"integrators": 1})[0]
    assert notes_on(replace(record, start="estimated")) == []


def test_skipped_samples_are_not_looked_at(u):
    record = Record(u, lag(u) + 5 * (np.arange(T) < 2000), skip=2000)
    assert notes_on(record) == []
    rest = np.where(np.arange(T) < 2000, 0, u)
    assert notes_on(Record(rest, lag(rest), skip=2000)) == []
    assert notes_on(Record(rest, lag(rest))) != []


@pytest.mark.slow
def test_simulated_benchmarks():
    for dataset in (boucwen.load(), parwh.load(source="stand-in")):
        for record in (*dataset.train[:3], *dataset.validation[:1], *dataset.tests):
            assert notes_on(record) == []
            assert "swapped" in found(record.y, record.u)


@pytest.mark.slow
@pytest.mark.data
def test_official_benchmarks(benchmark_root: Path):
    for module in (silverbox, wiener_hammerstein, boucwen):
        dataset = module.load(root=benchmark_root)
        for record in (*dataset.train, *dataset.tests):
            assert notes_on(record) == []
            assert "swapped" in found(record.y, record.u)


@pytest.mark.data
@pytest.mark.parametrize("use", ["Est", "Val"])
def test_overflow_of_the_cascaded_tanks(use: str, benchmark_root: Path):
    file = benchmark_root / "Cascaded_Tanks" / "CascadedTanksFiles" / "dataBenchmark.mat"
    data = loadmat(file)
    u, y = data[f"u{use}"], data[f"y{use}"]
    said = found(u, y, 0.25)
    assert set(said) == {"clipped"}
    assert f"largest value 10 in {np.sum(y == 10)} samples" in said["clipped"]
