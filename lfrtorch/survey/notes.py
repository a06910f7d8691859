"""Notes on a measurement: faults that will hurt a model, each with a remedy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations, pairwise
from typing import Any, NamedTuple

import numpy as np
import scipy

from lfrtorch._support.types import Array, Integers
from lfrtorch.data.records import Record, as_records
from lfrtorch.survey.causality import TwoSidedResponse, dead_time, two_sided_response
from lfrtorch.survey.changes import change
from lfrtorch.survey.integration import chain, grows, integrators, rates
from lfrtorch.survey.measurement import Survey, survey_measurement
from lfrtorch.survey.mechanics import reacting, rubs
from lfrtorch.survey.outliers import input_outliers, output_outliers
from lfrtorch.survey.sensors import frozen, marked
from lfrtorch.survey.signal import SignalSurvey, held

_SHORT = 300  # samples: a small NL-LFR model has 50 to 100 parameters
_ENOUGH = 100  # samples of a record for notes on what it excites
_MOST = 2**21  # samples of a record that are examined, the first ones after ``skip``

# Nothing moves in a part with share STILL of the record, cut into STRETCHES pieces, if there the
# inputs stay within REST of their rms, the outputs' means over the pieces within SETTLED of theirs,
# and an output's rms within each piece is at most QUIET of its rms in the record.
_STILL, _STRETCHES, _REST, _SETTLED, _QUIET = 0.2, 200, 0.05, 0.1, 0.2

# A record is oversampled if 99 % of the power lies below fs / OVERSAMPLED; after decimation it lies
# below fs / WANTED.
_OVERSAMPLED, _WANTED = 30, 10
_COARSE, _FEW = 0.05, 200  # step of a coarse output over its rms; smallest record with a note on it

# An input with fewer than FEW_FREQUENCIES is narrow; a frequency counts from the share LINE of the
# strongest one's power on. A sine takes LOBE lines of a windowed spectrum.
_FEW_FREQUENCIES, _LINE, _LOBE = 5, 1e-4, 6
_NARROW = 0.1  # an input is narrow, too, if its band is narrower than this times its centre
_SAME = 0.999  # correlation of two inputs that carry the same signal

# An output drifts if a straight line explains DRIFT of its variance, with slopes in all thirds of
# the record within the factor ALIKE, and at most OTHERS of that of any input or its magnitude.
_DRIFT, _ALIKE, _OTHERS = 0.2, 3.0, 0.05

# The output precedes the input if the causality is below BEFORE and the reverse causality above
# AFTER. A reverse gain that rises with frequency speaks against it, as an integrator with
# feedthrough has one; then the causality must be below CERTAIN.
_BEFORE, _AFTER, _CERTAIN = -0.15, 0.5, -0.4
_PLANNED = 1e-3  # noise of an input without feedback, from period to period, over its rms
_SHOWN = 6  # outliers that a note names; it counts the others

# Coherence beyond chance above which the causality test means something, and below which the output
# does not follow the inputs.
_COHERENT, _UNRELATED = 0.1, 0.05
_DELAY, _SHARP = 5, 0.5  # samples of a dead time worth a shift; its least share of the peak's lag


_SENTENCES = {
    "empty": "'{name}' has no values at all; leave it out.",
    "missing": "'{name}' misses {one.missing} of {one.samples} samples, up to {one.gap} in a row: "
    "outputs are not fitted there; fill the gaps of inputs, or cut there by gaps='split'.",
    "mark": "{side}'{name}' is exactly {value:g} in {count} samples, at {places}, far from all "
    "other values: a mark for a missing value, or a dropout; {remedy}.",
    "frozen": "{side}'{name}' stays exactly {places}, while the input moves, but changes at every "
    "sample around it: check the sensor; {remedy}.",
    "constant": "{side}'{name}' is constant at {one.mean:.6g}{told}",
    "still": "no input or output moves in {share:.0f} % of the record (samples {first} to "
    "{last}): little is learnt there; cut most of it off, or excite the system all the time.",
    "clipped": "{side}'{name}' has its {what} value {end.value:.6g} in {end.samples} samples "
    "({share:.2g} %), {end.run} in a row; if the sensor clips there, use more range, or "
    "give its limits.",
    "coarse": "{side}'{name}' has {one.values} values, in steps of {one.step:.3g} ({share:.0f} % "
    "of its rms): an rms error of about {least:.2g} is the least; use more of the converter's "
    "range.",
    "short": "{T} samples{after} are few to fit: a small nonlinear model has 50 to 100 "
    "parameters; measure longer.",
    "outliers": "{side}'{name}' has {count} outlier(s), at sample {places}: if misread, {remedy}, "
    "by Record(valid=...) or an empty cell of the output.",
    "binary": "input '{name}' has two values only, between which a nonlinearity at the input does "
    "not show; use a signal of many levels, such as a multisine.",
    "narrow": "input '{name}' excites {band} {unit} only: elsewhere a model is a guess; excite "
    "the band where it is used.",
    "lines": "input '{name}' excites {count} frequenc{ending} or so, {band} {unit}: enough for "
    "order {count}; excite the band where the model is used.",
    "oversampled": "99 % of all power lies below {highest:.3g} {unit}, fs / {ratio:.0f}: the "
    "record is oversampled.\nDecimate by {factor} (scipy.signal.decimate) for a faster fit, "
    "unless modes above {lost:.3g} {unit}, which are lost then, matter.",
    "held": "the inputs change every {hold} samples only, and 99 % of the outputs' power lies "
    "below {highest:.3g} {unit}:\none sample in {factor}, sample {first} among them, is enough "
    "for a faster fit, unless modes above {lost:.3g} {unit} matter.",
    "periods": "the record has {count:.2f} periods of {period} samples{after}: two or more would "
    "tell noise from distortion; measure more, or cut it to one in steady state.",
    "same": "inputs '{name[0]}' and '{name[1]}' carry the same signal (correlation "
    "{correlation:.4f}): what each does cannot be told; leave one out.",
    "swapped": "output '{output}' comes before input '{input}': are inputs and outputs swapped? "
    "(Or a controller makes the input from the output.)",
    "chain": "'{first}' integrates '{second}', which integrates, too: use start='measured', as "
    "the outputs are the states, and horizon=N, the samples ahead that count.",
    "feedback": "input '{name}' reacts to the output: a controller closes the loop, and noise "
    "biases a fit; try {changes}, or give its reference=r{compare}.",
    "integrates": "output '{name}' integrates{behind}: use {known}start='estimated'; it has no "
    "steady state.",
    "friction": "input '{input}' changes with the direction of '{name}': dry friction or play; "
    "raise nx until a state can be the speed.",
    "unrelated": "hardly anything of output '{name}' follows from the inputs linearly: wrong "
    "columns, times that do not match, noise, or a purely even nonlinearity.",
    "delay": "a dead time of about {delay} samples{lasting} from input '{input}' to output "
    "'{output}', after the usual one sample:\ngive delay='auto', or a model spends as many states "
    "on it.",
    "drift": "output '{name}' drifts by {drift:.3g} in the record, {ratio:.1f} times its rms, and "
    "no input does: remove it if the sensor drifts; keep it if the system integrates.",
    "lost": "from about sample {sample} on, '{name}' follows the inputs one sample {turn}:\na "
    "sample of the {side} may be lost, or clocks differ; if so, cut the record there.",
    "gain": "from about sample {sample} on, the gain from the inputs to '{name}' is {ratio:.2g} "
    "times that before, at inputs of the same level:\na setting or the system may have changed; "
    "if so, cut the record there, or give what changed as an input.",
}
"""Possible faults by kind, with remedies."""

_CONSTANT = {
    "alone": ": it tells nothing.",
    "output": ": it does not respond; check the sensor and the column.",
    "step": " and the output moves: if it steps at the first sample, put samples from before the "
    "step in front; if another input moves the output, name that one.",
    "input": ": it tells nothing, unless it differs in other records; leave it out of the inputs "
    "if it does not.",
}
"""Meaning of a constant signal, by its use."""


class Note(NamedTuple):
    """A sentence, and its kind, which is the same for all records."""

    kind: str
    text: str

    @classmethod
    def of(cls, row: str, name: Any = "", *, kind: str = "", **values: Any) -> Note:
        """Fill in a row's sentence; the kind is the row and the name unless ``kind`` is given."""
        sentence = _SENTENCES[row].format(name=name, **values)
        return cls(kind or f"{row} {name}".rstrip(), sentence)


def examine(
    found: Survey,
    u: Array,
    y: Array,
    *,
    skipped: int = 0,
    moving: Sequence[bool] = (),
    given: Mapping[str, Any] | None = None,
) -> list[Note]:
    """Return notes on a measurement u (T, nu), y (T, ny); none on one that was made well.

    Args:
        found: its survey. Without inputs all signals count as outputs.
        skipped: number of skipped samples before these, added to the sample numbers in notes.
        moving: True for inputs that move elsewhere, in other records or in skipped samples.
        given: arguments of :func:`lfrtorch.estimate_bla` that are set: notes do not advise what
            these do already.
    """
    notes = [*_missing(found)]
    faults, u, y = _faults(found, u, y, skipped)
    if faults:  # the other notes are on the signals without the faults
        inputs, outputs = ([one.channel for one in side] for side in (found.inputs, found.outputs))
        period = found.inputs[0].period if inputs else None
        found = survey_measurement(u, y, found.fs, inputs=inputs, outputs=outputs, period=period)
    notes += [*faults, *_levels(found, u, y, skipped, moving), *_outliers(found, u, y, skipped)]
    u, y = u[found.whole], y[found.whole]
    if len(y) >= _ENOUGH:
        notes += _excitation(found, u, skipped)
        notes += _relations(found, u, y, skipped + found.whole.start, given or {})
    return notes


def notes_on(
    records: Record | Sequence[Record], *, given: Mapping[str, Any] | None = None
) -> list[str]:
    """Say what will hurt a model of the records, and what to do about it, a sentence each.

    If there are several records, a sentence names its record. Skipped samples are not examined;
    ``given`` is as in :func:`examine`.
    """
    data = as_records(records)
    levels = np.concatenate([r.u for r in data])
    moving = (np.ptp(levels, axis=0) > 0).tolist()
    by_kind: dict[str, list[tuple[str, str]]] = {}
    for r in data:
        scored = slice(r.skip, r.skip + _MOST)
        known = {**(given or {})}
        if r.reference is not None:  # no advice on feedback
            known |= {"feedthrough": False, "refine": "prediction"}
        found = survey_measurement(
            r.u[scored], r.y[scored], r.fs, inputs=r.inputs, outputs=r.outputs, period=r.period
        )
        seen = examine(found, r.u[scored], r.y[scored], skipped=r.skip, moving=moving, given=known)
        for kind, text in seen:
            if kind.startswith("integrates") and r.start == "estimated":
                continue  # a fit says this itself, if its model does not integrate
            settled = r.start == "measured" or np.any(known.get("integrators", 0))
            if kind.startswith(("chain", "rate")) and settled:
                continue
            by_kind.setdefault(kind, []).append((r.name, text))
    sentences = []
    for (name, text), *more in by_kind.values():
        others = f" and {len(more)} more" if more else ""
        sentences.append(text if len(data) == 1 else f"record '{name}'{others}: {text}")
    return sentences


def _missing(found: Survey) -> Iterator[Note]:
    """Samples without a value."""
    for one in found.signals:
        if one.missing:
            row = "empty" if one.missing == one.samples else "missing"
            name = one.channel.name
            yield Note.of(row, name, kind=f"missing {name}", one=one)


def _sides(found: Survey) -> list[str]:
    """The use of each signal before its name, if it is known."""
    if not found.inputs:
        return [""] * len(found.outputs)
    return ["input "] * len(found.inputs) + ["output "] * len(found.outputs)


def _faults(found: Survey, u: Array, y: Array, skipped: int) -> tuple[list[Note], Array, Array]:
    """Return notes on values that sensors did not measure, and the signals without them."""
    notes = list[Note]()
    u, y = u.copy(), y.copy()
    nu = u.shape[1]
    signals = zip(found.signals, _sides(found), (*u.T, *y.T), strict=True)
    for i, (one, side, signal) in enumerate(signals):
        name, of_input = one.channel.name, i < nu
        remedy = "fill these cells" if of_input else "empty these cells, or Record(valid=...)"
        told = {"side": side, "remedy": remedy}
        marks = marked(signal, of_input=of_input)
        for value in np.unique(signal[marks]):
            k = np.flatnonzero(signal == value)
            told |= {"value": value, "count": len(k), "places": _numbered(k, skipped)}
            notes.append(Note.of("mark", name, kind=f"mark {name} {value:g}", **told))
        known = np.flatnonzero(np.isfinite(signal) & ~marks)
        if marks.any():
            signal[marks] = np.interp(np.flatnonzero(marks), known, signal[known])
        parts = [] if of_input else frozen(signal, u)
        if parts:
            shown = " and ".join(
                f"at {signal[part.start]:.6g} in samples {skipped + part.start} to "
                f"{skipped + part.stop - 1}"
                for part in parts
            )
            notes.append(Note.of("frozen", name, side=side, places=shown, remedy=remedy))
        for part in parts:
            signal[part] = np.nan
    return notes, u, y


def _levels(
    found: Survey, u: Array, y: Array, skipped: int, moving: Sequence[bool]
) -> Iterator[Note]:
    """Notes on constant, clipped and coarse signals, a rest, and a short record."""
    T, sides = len(y), _sides(found)
    alone = not any(one.rms > 0 for one in found.inputs)
    steps = alone and any(output.rms > 0 for output in found.outputs)
    elsewhere = [*moving, *[False] * len(found.signals)]
    for one, side, moves in zip(found.signals, sides, elsewhere, strict=False):
        if one.values == 1 and not moves:
            use = side.rstrip() or "alone"
            told = _CONSTANT["step" if use == "input" and steps else use]
            yield Note.of("constant", one.channel.name, one=one, side=side, told=told)
    first, length = _still(found, u, y)
    if length >= _STILL * max(T, _ENOUGH):
        first += skipped
        yield Note.of("still", share=100 * length / T, first=first, last=first + length)
    side = sides[-1]
    for one in found.outputs:
        name = one.channel.name
        for end in one.clipped:
            what = "largest" if end is one.maximum else "smallest"
            share = 100 * end.samples / T
            told = {"end": end, "what": what, "side": side, "share": share}
            yield Note.of("clipped", name, kind=f"clipped {name} {what}", **told)
        if T > _FEW and one.values > 2 and one.step > _COARSE * one.rms:
            share, least = 100 * one.step / one.rms, one.step / np.sqrt(12)
            yield Note.of("coarse", name, one=one, side=side, share=share, least=least)
    if T < _SHORT:
        yield Note.of("short", T=T, after=_after(skipped))


def _outliers(found: Survey, u: Array, y: Array, skipped: int) -> Iterator[Note]:
    """Lone samples that stick out of a signal."""
    places = [input_outliers(signal, y) for signal in u.T]
    places += [output_outliers(s, u) if found.inputs else input_outliers(s) for s in y.T]
    remedies = {"input ": "interpolate, or leave the outputs that follow out"}
    for one, side, k in zip(found.signals, _sides(found), places, strict=True):
        if len(k):
            remedy, shown = remedies.get(side, "leave them out"), _numbered(k, skipped)
            yield Note.of(
                "outliers", one.channel.name, side=side, count=len(k), places=shown, remedy=remedy
            )


def _excitation(found: Survey, u: Array, skipped: int) -> Iterator[Note]:
    """Notes on the excitation by inputs (T, nu) without gaps, and on the sampling frequency."""
    T, fs, unit = len(u), found.fs or 1.0, _unit(found)
    for one, signal in zip(found.inputs, u.T, strict=True):
        if one.band is None:
            continue
        name, (low, high) = one.channel.name, one.band
        if one.values == 2:
            yield Note.of("binary", name)
        count, shown = _frequencies(signal), f"{low:.4g} to {high:.4g}"
        if count < _FEW_FREQUENCIES:
            told = {"count": count, "ending": "y" if count == 1 else "ies"}
            told |= {"band": shown, "unit": unit}
            yield Note.of("lines", name, kind=f"narrow {name}", **told)
        elif high - low < _NARROW * (high + low) / 2:
            yield Note.of("narrow", name, band=shown, unit=unit)
    bands = [one.band for one in found.signals]
    if bands and all(b is not None and b[1] < fs / _OVERSAMPLED for b in bands):
        highest = max(b[1] for b in bands if b is not None)
        factor = int(fs / (_WANTED * highest)) if highest > 0 else 1
        told = {"highest": highest, "unit": unit, "factor": factor, "lost": fs / (2 * factor)}
        yield Note.of("oversampled", ratio=fs / highest, **told)
    elif found.outputs and (clock := held(u)) is not None:
        hold, first = clock[0], skipped + found.whole.start + clock[1]
        highest = max(fs if one.band is None else one.band[1] for one in found.outputs)
        factor = max(
            k for k in range(1, hold + 1) if not hold % k and k <= max(1, fs / (_WANTED * highest))
        )
        if factor > 1 and highest < min(fs / _OVERSAMPLED, fs / (2 * hold)):
            told = {"highest": highest, "unit": unit, "factor": factor, "lost": fs / (2 * factor)}
            yield Note.of("held", hold=hold, first=first, **told)
    period = found.inputs[0].period if found.inputs else None
    if period is not None and period < T < 2 * period:
        yield Note.of("periods", count=T / period, period=period, after=_after(skipped))
    for j, i in combinations(range(u.shape[1]), 2):
        if bands[i] is None or bands[j] is None:
            continue
        correlation = float(np.corrcoef(u[:, i], u[:, j])[0, 1])
        if abs(correlation) > _SAME:
            names = found.inputs[j].channel.name, found.inputs[i].channel.name
            yield Note.of("same", names, correlation=correlation)


def _relations(
    found: Survey, u: Array, y: Array, skipped: int, given: Mapping[str, Any]
) -> Iterator[Note]:
    """Notes on outputs (T, ny) without gaps under inputs (T, nu): order, delay, drift, changes."""
    inputs = [one.channel.name for one in found.inputs]
    outputs = [one.channel.name for one in found.outputs]
    between = {
        (i, j): pair
        for i in range(y.shape[1])
        for j in range(u.shape[1])
        if (pair := two_sided_response(u[:, j], y[:, i])) is not None
    }
    if between:
        (i, j), pair = max(between.items(), key=lambda item: item[1].coherence)
        if _first(pair):
            yield Note.of("swapped", output=outputs[i], input=inputs[j])
            return
    rate = rates(y)
    counts = [
        integrators(u, channel) or int(rate[i] is not None and grows(u, channel))
        for i, channel in enumerate(y.T)
    ]
    # Two integrators must be behind all outputs or none.
    some = counts if min(counts) else [min(count, 1) for count in counts]
    asked = counts[0] if len({*counts}) == 1 else f"[{','.join(map(str, some))}]"
    both = ((i, j) for i, j in enumerate(rate) if j is not None and counts[i] and counts[j])
    linked = next(both, chain(rate))
    if linked is not None:
        yield Note.of("chain", first=outputs[linked[0]], second=outputs[linked[1]])
    changes, compare = ["feedthrough=False"] if given.get("feedthrough", True) else [], ""
    if given.get("refine") != "prediction" and not any(counts):
        changes.append("refine='prediction' or noise='innovation'")
        compare = ", and compare with a fit without: what predicts best may simulate worse"
    moving = [one for one, signal in zip(found.inputs, u.T, strict=True) if np.ptp(signal) > 0]
    parts = reacting(u, y, feedthrough=bool(given.get("feedthrough", True)))
    for one, part in zip(moving, parts, strict=True):
        if part and changes and not _repeats(one):
            told = " and ".join(changes)
            yield Note.of("feedback", one.channel.name, changes=told, compare=compare)
    for i, output in enumerate(found.outputs):
        pairs = {j: pair for (k, j), pair in between.items() if k == i}
        name, integrates = output.channel.name, counts[i]
        if integrates and linked is None:
            known = "" if np.any(given.get("integrators", 0)) else f"integrators={asked} and "
            j = rate[i]
            kind, behind = ("integrates", "") if j is None else ("rate", f" output '{outputs[j]}'")
            told = {"known": known, "behind": behind}
            yield Note.of("integrates", name, kind=f"{kind} {name}", **told)
        force = next((j for j in range(u.shape[1]) if rubs(u[:, j], y[:, i])), None)
        if force is not None:
            yield Note.of("friction", name, input=inputs[force])
        beyond = sum(p.coherence - p.chance for p in pairs.values())
        if not integrates and pairs and beyond < _UNRELATED:
            yield Note.of("unrelated", name)
        for j, pair in pairs.items():
            unclear = pair.coherence - pair.chance < _COHERENT or pair.causality < _AFTER
            if unclear or pair.peak < _DELAY:
                continue
            delay = dead_time(u[:, j], y[:, i], pair.peak)
            if max(_DELAY, _SHARP * pair.peak) <= delay <= pair.peak:
                lasting = "" if found.fs is None else f" ({delay / found.fs:.3g} s)"
                told = {"input": inputs[j], "output": name, "lasting": lasting}
                yield Note.of("delay", f"{name} {j}", delay=delay, **told)
        if not integrates:
            yield from _drift(output, y[:, i], u)
            yield from _change(output, y[:, i], u, skipped)


def _repeats(one: SignalSurvey) -> bool:
    """Tell whether an input repeats without noise, which a controller would bring in."""
    return one.method == "periods" and one.noise is not None and one.noise < _PLANNED * one.rms


def _first(pair: TwoSidedResponse) -> bool:
    """Tell if the output precedes the input."""
    return (
        pair.coherence - pair.chance > _COHERENT
        and pair.causality < _BEFORE
        and pair.reverse > _AFTER
        and (pair.rise < 1 or pair.causality < _CERTAIN)
    )


def _drift(output: SignalSurvey, y: Array, u: Array) -> Iterator[Note]:
    """Tell if an output (T,) drifts, and the inputs (T, nu) and their magnitudes do not."""
    share, slope = _trend(y)
    thirds = [_trend(part)[1] for part in np.array_split(y, 3)] if len(y) >= _SHORT else [0.0]
    steady = all(slope * third > 0 and 1 / _ALIKE < third / slope < _ALIKE for third in thirds)
    centred = u - u.mean(axis=0)
    others = [_trend(v)[0] for v in (*centred.T, *np.abs(centred).T)]
    if share > _DRIFT and steady and max(others, default=1.0) < _OTHERS:
        drift, ratio = slope * len(y), abs(slope) * len(y) / output.rms
        yield Note.of("drift", output.channel.name, drift=drift, ratio=ratio)


def _change(output: SignalSurvey, y: Array, u: Array, skipped: int) -> Iterator[Note]:
    """Tell whether the gain from inputs (T, nu) to an output (T,) changes, or a sample is lost."""
    found, name = change(u, y), output.channel.name
    if found is None:
        return
    sample = skipped + found.sample
    if found.shift:
        turn, side = ("sooner", "output") if found.shift > 0 else ("later", "inputs")
        yield Note.of("lost", name, sample=sample, turn=turn, side=side)
    else:
        yield Note.of("gain", name, sample=sample, ratio=found.ratio)


def _trend(signal: Array) -> tuple[float, float]:
    """Share of the variance that a straight line explains, and its slope per sample."""
    k = np.arange(len(signal)) - (len(signal) - 1) / 2
    slope = float(k @ signal) / float(k @ k)
    variance = float(np.var(signal))
    return (slope**2 * float(k @ k) / (len(k) * variance) if variance else 0.0), slope


def _still(found: Survey, u: Array, y: Array) -> tuple[int, int]:
    """First sample and length of the longest part in which no input or output (T, n) moves."""
    if not any(one.rms > 0 for one in found.inputs):
        return 0, 0
    u, y = (
        np.nan_to_num((s - [one.mean for one in of]) / [one.rms or 1.0 for one in of])
        for s, of in ((u, found.inputs), (y, found.outputs))
    )
    edges = np.linspace(0, len(u), min(_STRETCHES, len(u)) + 1).astype(int)
    parts = [slice(*ends) for ends in pairwise(edges)]
    ends = np.array([[u[part].min(axis=0), u[part].max(axis=0)] for part in parts])
    means = np.array([y[part].mean(axis=0) for part in parts])
    rests = np.array([(y[part].std(axis=0) <= _QUIET).all() for part in parts])
    longest, last = (0, 0), 0
    for first in range(len(parts)):
        last = max(first, last)
        while (
            last < len(parts)
            and rests[last]
            and (np.ptp(ends[first : last + 1], axis=(0, 1)) <= _REST).all()
            and (np.ptp(means[first : last + 1], axis=0) <= _SETTLED).all()
        ):
            last += 1
        longest = max(longest, (int(edges[last] - edges[first]), int(edges[first])))
    return longest[1], longest[0]


def _frequencies(signal: Array) -> int:
    """Approximate number of frequencies that a signal (T,) excites."""
    _, power = scipy.signal.periodogram(signal, window="hann")
    excited = power > _LINE * power.max()
    groups = np.sum(np.diff(excited.astype(np.int8), prepend=0) == 1)
    return int(max(groups, np.ceil(np.sum(excited) / _LOBE)))


def _numbered(k: Integers, skipped: int) -> str:
    """Numbers of the first samples of k (n,), and how many more there are."""
    shown = ", ".join(str(skipped + sample) for sample in k[:_SHOWN])
    return shown + (f" and {len(k) - _SHOWN} more" if len(k) > _SHOWN else "")


def _after(skipped: int) -> str:
    return f" after the {skipped} that are skipped" if skipped else ""


def _unit(found: Survey) -> str:
    return "cycles/sample" if found.fs is None else "Hz"
