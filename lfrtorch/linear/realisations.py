"""Records of one realisation of the input: the same period again, perhaps shifted in time.

Nonlinear distortion is the same in all of them, so that they show noise but not distortion: they
count as more periods of one experiment. Without a trigger a record begins anywhere in its
period, so that spectra U and V of one realisation differ by V = U exp(-2πj k τ / N).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Complex128, Int64

from lfrtorch._support.types import Array, Complex, Integers
from lfrtorch.data.records import Record
from lfrtorch.linear.regression import outer
from lfrtorch.linear.spectra import RELATIVE_POWER, Spectra

ALIKE = 0.15
"""Largest rms difference of two spectra of one realisation, relative to them; for two realisations
it is about √2. Lines count by amplitude, not power, as a shift can always match one strong line."""

FEW = 8
"""A shift is looked for with this many lines: fewer lines of two realisations agree by chance."""


def united(
    spectra: Spectra, data: Sequence[Record], *, shifted: bool
) -> tuple[Spectra, list[Record], tuple[str, ...]]:
    """Return the spectra and the first record of each realisation, and a note on repeated ones.

    If ``shifted``, one realisation may begin anywhere in its period.
    """
    E = spectra.excitation
    power = np.mean(np.abs(E) ** 2, axis=1)  # (F, nu)
    excited = power > RELATIVE_POWER * power[1:].max(axis=0)
    lines = 1 + np.flatnonzero(excited[1:].any(axis=1))
    groups: dict[int, list[tuple[int, float]]] = {}
    for r in range(len(data)):
        for first, group in groups.items():
            tau = delay(E[lines, first], E[lines, r], lines, spectra.N, shifted=shifted)
            if tau is not None:
                group.append((r, tau))
                break
        else:
            groups[r] = [(r, 0.0)]
    if len(groups) == len(data):
        return spectra, list(data), ()
    k, ny, noisy = np.arange(len(E))[:, None], spectra.Y.shape[2], len(spectra.C[0])
    signals = np.concatenate([spectra.Y, spectra.U, E], axis=2)
    C, freedom, means, P = spectra.C * spectra.freedom, spectra.freedom, [], []
    for group in groups.values():
        of, taus = (np.array(part) for part in zip(*group, strict=True))
        Z = signals[:, of] * np.exp(2j * np.pi * k * taus / spectra.N)[:, :, None]
        counts = spectra.P[of]
        means.append(np.average(Z, axis=1, weights=counts))
        P.append(counts.sum())
        D = (Z - means[-1][:, None])[:, :, :noisy] * np.sqrt(counts)[:, None]
        C, freedom = C + outer(D), freedom + len(group) - 1
    Y, U, E = np.split(np.stack(means, axis=1), [ny, noisy], axis=2)
    reference = None if spectra.reference is None else E
    note = (
        f"realisations: {len(data)} records have {len(groups)} different input(s); "
        "those of one input count as periods of one experiment."
    )
    spectra = Spectra(
        U, Y, C / freedom, freedom, np.array(P), spectra.N, spectra.resolution, reference
    )
    return spectra, [data[r] for r in groups], (note,)


def delay(
    U: Complex128[Complex, "F nu"],
    V: Complex128[Complex, "F nu"],
    lines: Int64[Integers, " F"],
    N: int,
    *,
    shifted: bool = True,
) -> float | None:
    """Return the shift τ in samples if V is U, shifted; ``None`` for another realisation."""
    size = np.sqrt((np.abs(U) ** 2 + np.abs(V) ** 2) / 2)
    size = np.maximum(size, np.finfo(float).tiny)

    def far(difference: Array | Complex) -> bool:
        return float(np.sum(np.abs(difference) ** 2 / size)) > ALIKE**2 * float(np.sum(size))

    if far(np.abs(U) - np.abs(V)):
        return None
    tau = 0.0
    if shifted and len(lines) >= FEW:
        cross = np.sum(U.conj() * V / size, axis=1)
        spectrum = np.zeros(N // 2 + 1, dtype=complex)
        spectrum[lines] = cross
        tau = float(np.argmax(np.fft.irfft(spectrum, N)))
        weight = np.abs(cross) * lines
        for _ in range(2):  # corrections of whole samples by the slope of the phase
            phase = np.angle(cross * np.exp(2j * np.pi * lines * tau / N))
            tau -= N / (2 * np.pi) * float(weight @ phase / (weight @ lines))
    turned = U * np.exp(-2j * np.pi * lines * tau / N)[:, None]
    return None if far(V - turned) else tau
