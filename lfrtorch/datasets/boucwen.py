"""Bouc-Wen hysteretic benchmark: official estimation procedure, official tests, and the simulator.

The system is a mass, spring and damper with a hysteretic force z, driven by a force u (N); its
output is the displacement y (m)::

    m y'' + c y' + k y + z = u
    z' = alpha y' - beta (gamma |y'| z + delta y' |z|)          (the published nu is 1)

It is integrated at 15 kHz and its signals are used at 750 Hz.

References:
    J.P. Noël and M. Schoukens (2016), "Hysteretic benchmark with a dynamic nonlinearity",
    Workshop on Nonlinear System Identification Benchmarks.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, floor, prod
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numba import njit
from numpy.typing import ArrayLike

from lfrtorch._support.checks import integer, number
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Record
from lfrtorch.datasets import official

__all__ = ["load", "multisine", "simulate", "sweep"]

# Parameters of the published system, in SI units.
_M, _C, _K = 2.0, 10.0, 5e4
_ALPHA, _BETA, _GAMMA, _DELTA = 5e4, 1e3, 0.8, -1.1

_FS = 750.0  # Hz, of the records
_RATIO = 20  # integration rate over _FS
_TAPS = 31  # length of each low-pass filter

_BAND = (5.0, 150.0)  # Hz, of the multisines
_PERIOD = 8192  # samples at 750 Hz, of the multisine test
_SWEEP = 153_000  # samples at 750 Hz, of the sweep test: 204 s
_TESTS = {"multisine": _PERIOD, "sinesweep": _SWEEP}  # official file names, and samples
_TEST_OFFSET = 2000  # seed of the simulated multisine test, beyond the training seed

_FILES = "BoucWen/BoucWenFiles/Test signals/Validation signals"  # below the benchmarks' folder

_LOADER = "not_splitted_benchmarks.BoucWen"


def load(
    *,
    seed: int = 0,
    validation_seed_offset: int = 1000,
    samples: int = _PERIOD,
    rms: float | Sequence[float] = 50.0,
    selection_rms: Sequence[float] = (25.0, 10.0),
    noise_rms: float = 8e-6,
    download: bool = False,
    root: str | Path | None = None,
) -> Dataset:
    """Simulated estimation data, and the official tests if their files exist.

    Training, validation and selection are steady-state periods of multisine realisations, with
    measurement noise: validation at the level of the first training record, selection at other
    levels. (Starts that are equally good at the training level differ by a factor of 2 at small
    amplitudes, and on the sweep.) The tests are noise free: ``"multisine"`` is one steady-state
    period and ``"sweep"`` starts from rest, its first 2000 samples unscored. A test without its
    files is simulated: the sweep is the official one up to rounding, the multisine is another
    realisation of the official kind (drawn from ``seed + 2000``). ``Record.source`` names the
    origin.

    Args:
        seed: seed of the training realisation and its noise.
        validation_seed_offset: added to ``seed`` for the validation realisation; those of the
            selection follow.
        samples: samples of one estimation period, at 750 Hz.
        rms: rms of the training input, N; several levels are a realisation each.
        selection_rms: rms of the selection inputs, N.
        noise_rms: rms of the measurement noise before the decimation, m; the low-pass filters leave
            0.92 of it: 7.35e-6 m of the official 8e-6 m.
        download: download missing test files, by the package nonlinear_benchmarks.
        root: folder that holds ``BoucWen/BoucWenFiles/...`` as the package nonlinear_benchmarks
            lays it out; by default that package's cache folder, if there is one.

    Shape:
        u (N) and y (m) of training and validation: (samples, 1); of the multisine test:
        (8192, 1); of the sweep test: (153000, 1).

    Example:
        >>> data = lfrtorch.datasets.boucwen.load(samples=1024)
        >>> data.train[0].u.shape, [test.name for test in data.tests]
        ((1024, 1), ['multisine', 'sweep'])
    """
    integer("seed", seed, 0)
    integer("validation_seed_offset", validation_seed_offset, -seed)
    number("noise_rms", noise_rms)
    trained = _levels("rms", rms)
    if not trained:
        raise InputError("rms is empty; give one level or more, in N, for example [50].")
    levels = [trained[0], *_levels("selection_rms", selection_rms)]
    offsets = range(validation_seed_offset, validation_seed_offset + len(levels))
    if 0 in offsets or _TEST_OFFSET in offsets:
        raise InputError(
            f"validation_seed_offset={validation_seed_offset} and {len(levels) - 1} level(s) of "
            "selection_rms: none may be the training or simulated test realisation\n"
            f"(offsets 0 and {_TEST_OFFSET}); use for example 1000."
        )
    found = _official(root, download)
    estimation: dict[str, Any] = {"samples": samples, "noise_rms": noise_rms}
    chosen = [
        _realisation(
            "validation" if offset == validation_seed_offset else f"selection_{level:g}",
            seed + offset,
            rms=level,
            **estimation,
        )
        for offset, level in zip(offsets, levels, strict=True)
    ]
    return Dataset(
        name="boucwen",
        train=[
            _realisation(
                f"train_{r}" if r else "train", [seed, r] if r else seed, rms=level, **estimation
            )
            for r, level in enumerate(trained)
        ],
        validation=[chosen[0]],
        selection=chosen[1:],
        tests=_tests(found, seed + _TEST_OFFSET),
        noise_rms=noise_rms,
        seed=seed,
        published=official.published("boucwen"),
    )


def multisine(
    *, samples: int = _PERIOD, rms: float = 50.0, seed: int | np.random.Generator = 0
) -> Array:
    """Period of the official random-phase multisine at 15 kHz: full grid, 5 Hz to 150 Hz.

    Lines floor(5 / f0) to ceil(150 / f0), f0 = 750 / samples Hz, of equal magnitude and uniform
    phase. Every 20th sample, ``multisine(...)[::20]``, is the input of a record.

    Args:
        samples: samples of the period at 750 Hz, 150 or more.
        rms: standard deviation, N.
        seed: seed of the phases, or a generator to draw them from.

    Shape:
        (20 samples,), N.

    Raises:
        ValueError: a period that cannot hold the band, or an rms that is not positive.

    Example:
        >>> u = lfrtorch.datasets.boucwen.multisine(samples=1500)
        >>> u.shape, round(float(np.std(u)))
        ((30000,), 50)
    """
    least = ceil(_FS / _BAND[0])
    if not isinstance(samples, Integral) or samples < least:
        raise InputError(
            f"a period of {samples} samples at {_FS:g} Hz cannot hold the excited band, "
            f"{_BAND[0]:g} to {_BAND[1]:g} Hz; give a whole number of at least {least} samples."
        )
    number("rms", rms, positive=True)
    f0 = _FS / samples
    lines = np.arange(floor(_BAND[0] / f0), ceil(_BAND[1] / f0) + 1)
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, lines.size)
    spectrum = np.zeros(samples * _RATIO // 2 + 1, complex)
    spectrum[lines] = np.exp(1j * phase)
    u = np.fft.irfft(spectrum, samples * _RATIO)
    return rms * u / np.std(u, ddof=1)  # ddof as in the official files


def sweep() -> Array:
    """Input of the official sweep test at 15 kHz, from its formula: 18 Hz to 52 Hz in 204 s.

    u(t) = 40 sin(2 pi (18 t + t^2 / 12)): 10 Hz a minute. (The description says 20 Hz to 50 Hz
    and 40 N rms; the official file has 18 Hz to 52 Hz and 40 N peak.)

    Shape:
        (3060000,), N.

    Example:
        >>> lfrtorch.datasets.boucwen.sweep().shape
        (3060000,)
    """
    t = np.arange(_SWEEP * _RATIO) / (_RATIO * _FS)
    return 40 * np.sin(2 * np.pi * (18 * t + t**2 / 12))


def simulate(
    u: ArrayLike,
    *,
    factors: tuple[int, ...] = (2, 2, 5),
    noise_rms: float = 0.0,
    seed: int | np.random.Generator = 0,
) -> Array:
    """Displacement at 750 Hz under a force at 15 kHz, from rest.

    Args:
        u: force at 15 kHz.
        factors: successive decimations, 20 together: the estimation data and the multisine
            test use (2, 2, 5), the sweep test (20,).
        noise_rms: rms of Gaussian noise in 0 to 375 Hz, m, added before the decimation.
        seed: seed of the noise, or a generator to draw it from.

    Shape:
        u: (T,), N, T a multiple of 20. Returns: (T / 20,), m.

    Raises:
        ValueError: a force of wrong shape or with NaN, factors that do not give 750 Hz, negative
            noise, or a force too large for the integration.

    Example:
        >>> force = lfrtorch.datasets.boucwen.multisine(samples=150)
        >>> lfrtorch.datasets.boucwen.simulate(force).shape
        (150,)
    """
    u = np.ascontiguousarray(u, dtype=np.float64)
    if u.ndim != 1 or u.size % _RATIO or u.size < 4 * _RATIO:
        raise InputError(
            f"the force has shape {u.shape}; give one dimension at 15 kHz, a multiple of "
            f"{_RATIO} samples and at least {4 * _RATIO}."
        )
    if not np.isfinite(u).all():
        raise InputError("the force has NaN or infinite samples; give finite numbers.")
    if prod(factors) != _RATIO or min(factors) < 2:
        raise InputError(
            f"decimation factors {tuple(factors)}: 15 kHz to 750 Hz needs factors of 2 or more "
            f"that multiply to {_RATIO}, for example (2, 2, 5)."
        )
    number("noise_rms", noise_rms)
    y = _newmark(u)
    if not np.isfinite(y[-1]):
        raise InputError(
            f"the integration fails under a force of up to {np.abs(u).max():.3g} N; "
            "use a smaller one (the benchmark's rms is 50 N)."
        )
    if noise_rms:
        white = np.random.default_rng(seed).standard_normal(u.size // _RATIO)
        # Zeros above 375 Hz in the spectrum: resample interpolates over the period T exactly.
        y = y + noise_rms * np.asarray(scipy.signal.resample(white, u.size), dtype=np.float64)
    for factor in factors:
        y = _decimate(y, factor)
    return y


@njit(cache=True)
def _newmark(u: Array) -> Array:
    """Displacement (T,) under a force (T,), both at 15 kHz; NaN from where Newton fails.

    Newmark (1/2, 1/4), with the trapezoidal rule for z. The balance of forces is linear in the
    acceleration a, so that a step is one equation in the rate s = z', solved by Newton.
    """
    half = 1 / (_RATIO * _FS) / 2  # length of a step, s
    inertia = _M + half * _C + half**2 * _K
    out = np.full(u.size, np.nan)
    y = v = z = s = 0.0
    a = u[0] / _M
    out[0] = y
    for i in range(1, u.size):
        # Prediction without the new rates, which add half**2 a to y, half a to v and half s to z.
        y_last = y + 2 * half * v + half**2 * a
        v_last = v + half * a
        z_last = z + half * s
        force = u[i] - _C * v_last - _K * y_last - z_last
        scale = 1 + abs(s) + (_ALPHA + _BETA * abs(z_last)) * abs(v_last)
        for _ in range(50):  # 2 or 3 are usual
            a = (force - half * s) / inertia
            v = v_last + half * a
            z = z_last + half * s
            residual = s - _ALPHA * v + _BETA * (_GAMMA * abs(v) * z + _DELTA * v * abs(z))
            if abs(residual) <= 1e-13 * scale:  # rounding leaves about 1e-15
                break
            dv = -_ALPHA + _BETA * (_GAMMA * np.sign(v) * z + _DELTA * abs(z))
            dz = _BETA * (_GAMMA * abs(v) + _DELTA * v * np.sign(z))
            s -= residual / (1 - dv * half**2 / inertia + dz * half)
        else:
            return out
        y = y_last + half**2 * a
        out[i] = y
    return out


def _decimate(x: Array, factor: int) -> Array:
    """Every ``factor``-th sample (T / factor,) of x (T,), low-passed without delay.

    Hamming-window FIR with its cut-off at the new Nyquist frequency; the ends are continued by
    odd mirror images.
    """
    padded = np.pad(x, _TAPS // 2, mode="reflect", reflect_type="odd")
    windows = np.lib.stride_tricks.sliding_window_view(padded, _TAPS)[::factor]
    return windows @ scipy.signal.firwin(_TAPS, 1 / factor, window="hamming")


def _levels(name: str, given: float | Sequence[float]) -> list[float]:
    """List one level, several or none, in N."""
    levels = list(given) if isinstance(given, Sequence) else [given]
    for level in levels:
        number(name, level, positive=True)
    return [float(level) for level in levels]


def _realisation(
    name: str, seed: int | list[int], *, samples: int, rms: float, noise_rms: float
) -> Record:
    """Steady-state period by the official procedure, of any length.

    The simulation starts from rest. Its transient is dropped: one period of 8192 samples, or
    shorter ones of the same length together. One more period follows, dropped for the filters'
    end effects.
    """
    rng = np.random.default_rng(seed)
    u = multisine(samples=samples, rms=rms, seed=rng)
    transient = ceil(_PERIOD / samples)
    y = simulate(np.tile(u, transient + 2), noise_rms=noise_rms, seed=rng)
    y = y[transient * samples : (transient + 1) * samples]
    return _record(u[::_RATIO], y, name=name, start="periodic", source="simulated")


def _tests(found: dict[str, list[Array]], seed: int) -> list[Record]:
    """Tests multisine and sweep; simulated without their files."""
    if "multisine" in found:
        u, y = found["multisine"]
        multisine = _record(u, y, name="multisine", start="periodic", source="official")
    else:
        multisine = _realisation("multisine", seed, samples=_PERIOD, rms=50.0, noise_rms=0.0)
    source = "official" if "sinesweep" in found else "simulated"
    if source == "official":
        u, y = found["sinesweep"]
    else:
        force = sweep()
        u, y = force[::_RATIO], simulate(force, factors=(_RATIO,))
    return [multisine, _record(u, y, name="sweep", start="zero", skip=2000, source=source)]


def _record(u: Array, y: Array, **kwargs: Any) -> Record:
    return official.record(u, y, {"u": "N"}, {"y": "m"}, fs=_FS, **kwargs)


def _official(root: str | Path | None, download: bool) -> dict[str, list[Array]]:
    """Read input (N) and output (m), (samples,) each, of the tests whose files exist."""
    if download:
        official.find(root, f"{_FILES}/uval_multisine.mat", _LOADER, download=True)
    found: dict[str, list[Array]] = {}
    for test, samples in _TESTS.items():
        paths = [official.folder(root) / _FILES / f"{letter}val_{test}.mat" for letter in "uy"]
        missing = [path for path in paths if not path.is_file()]
        if len(missing) == 1:
            raise FileNotFoundError(
                f"'{missing[0]}' is missing although its partner is there; put it back, or remove "
                "both to have the test simulated."
            )
        if not missing:
            found[test] = [official.read_arrays(p, {p.stem: (samples,)})[p.stem] for p in paths]
    if root is not None and not found:
        raise FileNotFoundError(
            f"no Bouc-Wen test files in '{root}': expected '{_FILES}/uval_multisine.mat', "
            "yval_multisine.mat, uval_sinesweep.mat and yval_sinesweep.mat below it.\nGive the "
            "folder that holds 'BoucWen', or leave root out to simulate the tests."
        )
    return found
