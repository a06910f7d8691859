"""Random-phase multisines: periodic excitation that separates noise from nonlinear distortion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from lfrtorch._support import checks
from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import dft_lines, integer, number, reals
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array, Integers

Grid = Literal["full", "odd", "random_odd"]


@dataclass(frozen=True, eq=False)
class Multisine:
    """Multisines: one period of each experiment, and the excited lines; line k is at k fs / N Hz.

    Args:
        u: one period of every experiment; nu experiments after one another are one realisation.
        lines: the excited DFT lines, rising, the same for all experiments and inputs.
        fs: sampling frequency in Hz.

    Shape:
        u: (realisations * nu, N, nu), lines: (F,).
    """

    u: Array
    lines: Integers
    fs: float

    @property
    def frequencies(self) -> Array:
        """Frequencies (F,) of the excited lines, Hz."""
        return self.lines * self.fs / self.u.shape[1]

    @property
    def odd_detection(self) -> Integers:
        """Odd lines between the first and the last excited one that are not excited."""
        return self._left_out(1)

    @property
    def even_detection(self) -> Integers:
        """Even lines between the first and the last excited one that are not excited."""
        return self._left_out(0)

    def _left_out(self, parity: int) -> Integers:
        between = np.setdiff1d(np.arange(self.lines[0], self.lines[-1]), self.lines)
        return between[between % 2 == parity]


@typed()
def multisine(
    samples: int,
    *,
    fs: float = 1.0,
    band: tuple[float, float] | None = None,
    lines: ArrayLike | None = None,
    grid: Grid = "full",
    group: int = 4,
    rms: ArrayLike = 1.0,
    amplitude: ArrayLike | None = None,
    nu: int = 1,
    realisations: int = 1,
    seed: int | np.random.Generator = 0,
) -> Multisine:
    """Random-phase multisines with an exact rms, orthogonal over the experiments of several inputs.

    At each excited line k the nu experiments (columns) of the nu inputs (rows) of one realisation
    are a full random orthogonal multisine::

        U(k) = A(k) D1(k) T D2(k)

    with A the amplitudes, T the nu x nu DFT matrix, and D1, D2 diagonal with independent uniform
    phases. U Uᴴ is diagonal, and the nonlinear distortions of the experiments do not depend on
    each other.

    Args:
        samples: number N of samples in one period.
        fs: sampling frequency in Hz.
        band: lowest and highest frequency in Hz. Default: all lines between 0 and fs / 2.
        lines: numbers (F,) of the DFT lines to choose from, instead of a band.
        grid: the excited ones of these lines: ``"full"``: all; ``"odd"``: the odd ones;
            ``"random_odd"``: the odd ones except one of every ``group`` in a row, drawn at random.
            The lines that are not excited show nonlinear distortion and noise.
        group: number of odd lines in a group.
        rms: root mean square of each input, in every experiment.
        amplitude: relative amplitudes of the lines 0 to N / 2; only excited lines matter.
            Default: all equal.
        nu: number of inputs.
        realisations: number of independent realisations, nu experiments each.
        seed: seed of phases and lines, or a generator to draw them from.

    Shape:
        rms: () or (nu,), amplitude: (N // 2 + 1,) or (N // 2 + 1, nu).

    Raises:
        ValueError: a band or a grid without lines, lines that are not between 0 and fs / 2, or an
            argument out of range.

    Example:
        >>> design = lfrtorch.multisine(1000, fs=100.0, band=(1.0, 20.0), grid="odd", nu=2)
        >>> design.u.shape  # two experiments of two inputs
        (2, 1000, 2)
        >>> design.frequencies[[0, -1]].round(1).tolist()
        [1.1, 19.9]

    References:
        Pintelon and Schoukens, "System Identification: A Frequency Domain Approach", 2nd ed.,
        2012, chapters 2 and 4.3. Dobrowiecki and Schoukens, "Measuring a linear approximation to
        weakly nonlinear MIMO systems", Automatica 43, 2007.
    """
    integer("samples", samples, 3)
    if not isinstance(seed, np.random.Generator):
        integer("seed", seed, 0)
    integer("nu", nu, 1)
    integer("realisations", realisations, 1)
    integer("group", group, 2)
    number("fs", fs, positive=True)
    if band is not None:
        checks.band(band)
    generator = np.random.default_rng(seed)
    excited = _on_grid(_candidates(samples, fs, band, lines), grid, group, generator)
    A = _amplitudes(amplitude, samples, nu, excited)
    A *= _rms(rms, nu) / np.sqrt(np.sum(A**2, axis=0))

    shape = (realisations, excited.size, nu)
    D1 = np.exp(1j * generator.uniform(0, 2 * np.pi, shape))
    D2 = np.exp(1j * generator.uniform(0, 2 * np.pi, shape))
    T = np.exp(-2j * np.pi * np.outer(np.arange(nu), np.arange(nu)) / nu)
    U = np.einsum("fi,mfi,ij,mfj->mjfi", A, D1, T, D2)  # (realisation, experiment, line, input)
    spectrum = np.zeros((realisations * nu, samples // 2 + 1, nu), complex)
    spectrum[:, excited] = U.reshape(-1, excited.size, nu) * samples / np.sqrt(2)
    u = np.asarray(np.fft.irfft(spectrum, samples, axis=1), dtype=np.float64)
    return Multisine(u, excited, float(fs))


def _candidates(
    samples: int, fs: float, band: tuple[float, float] | None, lines: ArrayLike | None
) -> Integers:
    """Candidate lines of the grid, rising; fs / 2 itself has no free phase."""
    last = (samples - 1) // 2
    if lines is not None:
        if band is not None:
            raise InputError("both lines and band are given; give one of them.")
        return dft_lines(lines, samples)
    low, high = (0.0, fs / 2) if band is None else band
    if not 0 <= low <= high <= fs / 2:
        raise InputError(
            f"the band is {low} to {high} Hz; give a lower and an upper frequency between 0 and "
            f"fs / 2 = {fs / 2:g} Hz."
        )
    # A frequency that is a line up to rounding belongs to the band.
    first = max(1, int(np.ceil(low / fs * samples * (1 - 1e-12))))
    found = np.arange(first, min(last, int(high / fs * samples * (1 + 1e-12))) + 1)
    if not found.size:
        raise InputError(
            f"the band {low:g} to {high:g} Hz holds no line of a period of {samples} samples, "
            f"whose lines are {fs / samples:g} Hz apart; use a wider band or a longer period."
        )
    return found


def _on_grid(lines: Integers, grid: Any, group: int, generator: np.random.Generator) -> Integers:
    if grid == "full":
        return lines
    odd = lines[lines % 2 == 1]
    least = group if grid == "random_odd" else 1
    if odd.size < least:
        raise InputError(
            f"grid {grid!r} needs {least} odd line(s) and there are {odd.size}; use a wider band "
            "or a longer period."
        )
    if grid == "odd":
        return odd
    groups = odd.size // group  # lines after the last whole group are excited
    dropped = np.arange(groups) * group + generator.integers(group, size=groups)
    return np.delete(odd, dropped)


def _amplitudes(amplitude: ArrayLike | None, samples: int, nu: int, excited: Integers) -> Array:
    """Relative amplitudes (F, nu) of the excited lines."""
    if amplitude is None:
        return np.ones((excited.size, nu))
    given = reals("amplitude", amplitude)
    if given.ndim == 1:
        given = given[:, None]
    F = samples // 2 + 1
    if given.shape not in ((F, 1), (F, nu)):
        raise InputError(
            f"amplitude has shape {np.shape(amplitude)}; a period of {samples} samples has {F} "
            f"lines from 0 to fs / 2: give ({F},) or ({F}, {nu})."
        )
    A = given[excited]
    if not (np.isfinite(A).all() and (A > 0).all()):
        raise InputError("amplitude must be finite and positive at every excited line.")
    return np.broadcast_to(A, (excited.size, nu)).copy()


def _rms(rms: ArrayLike, nu: int) -> Array:
    given = reals("rms", rms)
    if given.shape not in ((), (nu,)) or not (np.isfinite(given).all() and (given > 0).all()):
        raise InputError(f"rms is {rms}; give a positive number, or one for each of {nu} input(s).")
    return given
