"""One's own measurements as records by use: one file or many, of any format."""

from __future__ import annotations

import glob
import re
from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeGuard, cast

from numpy.typing import ArrayLike

from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import integer, number
from lfrtorch._support.errors import InputError, brief
from lfrtorch._support.paths import expanded, real
from lfrtorch.data.dataset import Dataset, Undecided
from lfrtorch.data.periods import find_period, find_transient
from lfrtorch.data.records import Record
from lfrtorch.data.score_window import SHORTEST, warm_up
from lfrtorch.files.excel import workbook
from lfrtorch.files.formats import similar
from lfrtorch.files.frame import frame_tables
from lfrtorch.files.measurement import (
    Gaps,
    Measurement,
    Stretch,
    Wanted,
    read_measurement,
)
from lfrtorch.files.split import TooShortError, cut
from lfrtorch.files.table import Columns, NoColumnError, Table
from lfrtorch.survey.integration import integrators

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["load_records"]

Paths = str | Path | Sequence[str | Path]
Use = float | str | Path | Sequence[str | Path] | None

Start = Literal["auto", "zero", "estimated", "periodic", "measured"]
Period = int | Literal["auto"] | None

EVERYTHING = "all"
"""Value of ``test`` that takes all records."""

_LEFT_OUT = "left out, as it is too short"
_SAME = 1e-4  # relative difference of sampling frequencies that rounded time stamps may cause


@dataclass(frozen=True)
class _Whole:
    """The record of a file, or of a stretch between its gaps, before it has a use."""

    record: Record
    path: Path
    stem: str  # name that all runs and stretches of the file share
    stretch: bool
    seen: int  # samples on which its start may be decided
    rest: int | None  # samples to skip if it begins at rest; None if its start is decided


@typed("path", "inputs", "outputs", "reference")
def load_records(
    path: Paths | DataFrame | Sequence[DataFrame],
    *,
    inputs: Columns | None = None,
    outputs: Columns | None = None,
    fs: float | None = None,
    time: str | int | None = None,
    units: Mapping[str | int, str] | None = None,
    validation: Use = 0.2,
    test: Use = 0.2,
    start: Start = "auto",
    period: Period = "auto",
    skip: int | Literal["auto"] | None = None,
    gaps: Gaps = "error",
    limits: Sequence[ArrayLike | None] | None = None,
    reference: Columns | None = None,
) -> Dataset:
    """Measurements from files, each a record, by use: training, validation and test.

    Text (.csv, .tsv, .txt, .dat, .lvm, also .gz) with or without header, units line and preamble;
    MATLAB (.mat), .npz, .npy, HDF5 (.h5, .hdf5), Parquet and Excel (.xlsx, .xlsm); MDF4 (.mf4),
    TDMS (.tdms), MCAP and ROS 2 bags (.mcap, .db3) and UFF58 (.uff, .unv). All but Excel may be
    interpolated to a rate, as ``"drive.mf4#50Hz"`` or ``"x.csv#50Hz"``.

    A file is one record, or one for each of its runs. It has several runs if a column named as a
    run number, such as ``run`` or ``trial``, has each of its values in one stretch, or if the time
    begins again.

    A part cut off by a fraction is simulated from the beginning of its record, but only its own
    samples are scored. So the transient of the start reaches neither validation nor test.

    Args:
        path: a file, a pattern such as ``"runs/*.csv"``, or a list of these; ``"rig.xlsx#Run 2"``
            is a sheet of a workbook (default: the first sheet that has samples). Or a pandas data
            frame, or a list of them, with an index of times or ``fs``.
        inputs: one or several names of columns or arrays, or column numbers from 0. An array of
            several channels is several inputs, and ``"acc[0]"`` is the first channel of ``acc``.
            Default: those whose names leave no doubt, as ``u``, or ``u1`` and ``u2``.
        outputs: likewise; by name ``y``, or ``y1`` and ``y2``.
        fs: sampling frequency in Hz. Default: from ``time``.
        time: the column of time stamps, in seconds or as ISO date-times. Default: a column named
            as time is; or a lone number like ``Fs`` in a file of arrays; or another column that
            rises evenly. Signals at uneven times are interpolated to even ones.
        units: units of the channels by name or column number. Default: those in the file's header.
        validation: records that choose among iterates and are not fitted. A fraction below 1: that
            part of every record, after the training part. A whole number: that many of the last
            records. Names: records of ``path``, called as their files without extension. Or other
            files, as for ``path``. 0 for none.
        test: records that are scored, likewise; a fraction takes the last part of every record, a
            number the last records. ``"all"``: every record, to score an existing model without
            a fit.
        start: ``"zero"`` (at rest), ``"estimated"`` (in motion), ``"measured"`` (the outputs are
            the states), or ``"periodic"``: every record is cut to whole periods in steady state.
            Default: a record of whole periods that is settled from its first sample on is periodic.
            Other records have an estimated start, with rest as its most likely value.
            :func:`lfrtorch.identify` sets it to ``"zero"`` for training records that linear models
            fit clearly better so, see ``Dataset.undecided``. With ``test="all"`` these records
            start at rest.
        period: samples of one period of the inputs; ``"auto"`` finds it, ``None`` means no period.
        skip: samples at the beginning of every record that are left out of cost and score.
            Default: a record from rest skips the periods in which the output settles, or 5 % if
            the input does not repeat. An estimated start skips none, and scores leave out the first
            50 samples, or a fifth of a shorter record.
        gaps: ``"error"`` refuses missing inputs and missing time stamps, and leaves outputs without
            a value out of fits and scores (``Record.valid``); up to four samples in a row that the
            times lack are filled so, the inputs on a line. ``"split"`` makes a record of every
            stretch between missing values of any kind.
        limits: smallest and largest output that the sensors show, see :class:`lfrtorch.Record`; for
            example ``(None, 10)``.
        reference: setpoint if a controller makes the inputs, or the generator's signal if the
            inputs are measured with noise: one or several columns, as for ``inputs``, one for each
            of these; see :class:`lfrtorch.Record`.

    Shape:
        u, y of a record: (its samples, inputs), (its samples, outputs), in the file's units.

    Returns:
        The records; ``notes`` say what was found about periods, transients, time and gaps.

    Raises:
        ValueError: a file, column or setting that cannot be used, files that do not belong
            together, or a part too short to score.
        FileNotFoundError: no such file.

    Example:
        >>> header = "force (N);position (mm)"
        >>> np.savetxt("rig.csv", np.c_[u, y], delimiter=";", header=header, comments="")
        >>> data = lfrtorch.load_records("rig.csv", inputs="force", outputs="position", fs=100.0)
        >>> data.train[0].samples, str(data.train[0].outputs[0])
        (240, 'position (mm)')
        >>> [len(records) for records in (data.train, data.validation, data.tests)]
        [1, 1, 1]
    """
    reader = _Reader(
        Wanted(inputs, outputs, fs, time, dict(units or {}), gaps, reference),
        "zero" if start == "auto" and test == EVERYTHING else start,
        period,
        None if skip == "auto" else skip,
        limits,
        validation=validation if is_fraction(validation) else 0.0,
        test=test if is_fraction(test) else 0.0,
    )
    sources = frame_tables(path) or listed_files(path, "path")
    name = _name([place_of(source) for source in sources])
    left = reader.read(sources)
    if test == EVERYTHING:
        tests = [whole.record for whole in left]
        return Dataset(name, [], [], tests, notes=reader.notes)
    tests, left, tested = _taken("test", test, left, reader)
    chosen, left, validated = _taken("validation", validation, left, reader)
    if not left:
        raise InputError(
            f"validation={validation} and test={test} leave no record for training; "
            f"path has {len(reader.all)} in all."
        )
    if validated + tested >= 1:
        raise InputError(
            f"the fractions are validation={validation} and test={test}; they must leave something "
            "for training, for example 0.2 and 0.2."
        )
    parts: dict[str, list[Record]] = {"train": [], "validation": chosen, "test": tests}
    short, undecided = None, []
    for whole in left:
        try:
            own = cut(whole.record, validated, tested)
            if whole.rest is not None and own["train"].samples - whole.rest >= SHORTEST:
                places = {use: len(parts[use]) for use in own}
                undecided.append(Undecided(whole.record, whole.seen, whole.rest, places))
            for use, record in own.items():
                parts[use].append(record)
        except TooShortError as error:
            if not whole.stretch:
                raise InputError(f"'{whole.path}': {error}") from error
            short = error
            reader.note(whole.record.name, _LEFT_OUT)
    if not parts["train"]:
        raise InputError(f"'{left[0].path}': no stretch between gaps is long enough: {short}")
    if (validated or tested) and any(whole.record.period for whole in left):
        reader.note(
            "",
            "the parts of a record have the same input in every period: validation and test show "
            "noise, and no other inputs; give them records of their own",
        )
    for use, records in parts.items():
        if len(records) == 1:
            parts[use] = [replace(records[0], name=use)]
    train, chosen, tests = parts.values()
    return Dataset(name, train, chosen, tests, notes=reader.notes, undecided=tuple(undecided))


class _Reader:
    """Reads files into whole records, all of one kind, and keeps what was found."""

    def __init__(
        self,
        wanted: Wanted,
        start: Start,
        period: Period,
        skip: int | None,
        limits: Sequence[ArrayLike | None] | None,
        *,
        validation: float,
        test: float,
    ) -> None:
        if period not in (None, "auto"):
            integer("period", period, 1)
        if skip is not None:
            integer("skip", skip, 0)
        self.wanted, self.period, self.skip = wanted, period, skip
        self.limits, self.validation, self.unseen = limits, validation, test
        self.start: Start = start
        self.all: list[_Whole] = []
        self._first: Measurement | None = None
        self._notes: dict[str, list[str]] = {}

    def note(self, name: str, *texts: str) -> None:
        """Keep a note on a record, or on all records if the name is empty."""
        for text in texts:
            self._notes.setdefault(text, []).append(name)

    @property
    def notes(self) -> tuple[str, ...]:
        """Return the notes, each with the records that it is about unless that is clear."""
        return tuple(
            text if len(self.all) == 1 or names == [""] else f"{_some(names)}: {text}"
            for text, names in self._notes.items()
        )

    def read(self, sources: Sequence[Path | Table]) -> list[_Whole]:
        """The records of some files or frames."""
        found = []
        paths = [place_of(source) for source in sources]
        stems = _stems(paths, {whole.stem for whole in self.all})
        for source, path, stem in zip(sources, paths, stems, strict=True):
            measured = self._measured(source)
            several = len(measured.stretches) > 1
            self.note(stem, *measured.notes)
            runs = Counter(stretch.run for stretch in measured.stretches)
            if len(measured.stretches) > len(runs):
                self.note(stem, f"{len(measured.stretches)} stretches between gaps, a record each")
            before, count = len(found), Counter[str]()
            for stretch in measured.stretches:
                count[stretch.run] += 1
                place = [stretch.run] if stretch.run else []
                place += [str(count[stretch.run])] if runs[stretch.run] > 1 else []
                name = "_".join([stem, *place])
                try:
                    record, rest = self._record(name, measured, stretch)
                except TooShortError as error:
                    if not several:
                        raise InputError(f"'{path}': {error}") from error
                    self.note(name, _LEFT_OUT)
                else:
                    seen = self._seen(record.samples)
                    found.append(_Whole(record, path, stem, several, seen, rest))
            if len(found) == before:
                raise InputError(
                    f"'{path}': no run or stretch between gaps is long enough to score."
                )
        self.all += found
        return found

    def _measured(self, source: Path | Table) -> Measurement:
        """Measurement of a file; refuse one that differs in kind from the first."""
        path = place_of(source)
        try:
            measured = read_measurement(source, self.wanted)
        except NoColumnError as error:
            if self._first is None:
                raise
            raise InputError(f"{error} '{self._first.path}' has it.") from error
        if self._first is None:
            self._first = measured
        first = self._first
        assert first.fs
        assert measured.fs
        for side in ("inputs", "outputs"):
            here, there = getattr(measured, side), getattr(first, side)
            if here != there:
                raise InputError(
                    f"the {side} of '{path}' are {', '.join(map(str, here))} and those of "
                    f"'{first.path}' {', '.join(map(str, there))}; give files of the same columns "
                    "and units."
                )
        if abs(measured.fs / first.fs - 1) > _SAME:
            raise InputError(
                f"'{path}' is sampled at {measured.fs:g} Hz and '{first.path}' at {first.fs:g} Hz; "
                f"'{path}#{first.fs:.6g}Hz' interpolates it to that rate."
            )
        return replace(measured, fs=first.fs)

    def _record(
        self, name: str, measured: Measurement, stretch: Stretch
    ) -> tuple[Record, int | None]:
        """Return the record of a stretch, and the samples to skip at rest if its start is open."""
        u, y, r, T = stretch.u, stretch.y, stretch.reference, len(stretch.u)
        assert measured.fs
        seen = y[: self._seen(T)]
        automatic = self.period == "auto"
        N = find_period(u if r is None else r) if automatic else cast("int | None", self.period)
        start: Start = self.start
        if not stretch.begins and start not in ("periodic", "measured"):
            start = "estimated"
        settling, settled = 0, False
        if N is not None and self.skip is None and start != "estimated":
            settling = find_transient(seen, N)
            settled = not settling and not any(
                integrators(u[: len(seen)], channel) for channel in seen.T
            )
        undecided = start == "auto"
        if start == "auto":
            start = "zero"
            whole = N is not None and len(seen) >= 2 * N and self._whole_periods(T, N)
            if settled and whole and stretch.valid is None:
                start, undecided = "periodic", False
        if start == "periodic":
            if N is None:
                raise InputError(
                    f"start is 'periodic' and the input of '{measured.path}' does not repeat; "
                    "give period in samples, or start='zero'."
                )
            begin = settling if self.skip is None else self.skip
            if T - begin < N:
                raise TooShortError(
                    f"record '{name}' has no whole period of {N} samples: {T} samples, of which "
                    f"{begin} are left out at the start."
                )
            kept, skip = slice(begin, begin + (T - begin) // N * N), 0
        else:
            kept, skip = slice(0, T), self.skip or 0
            if self.skip is None and start == "zero":
                skip = warm_up(T, settling)
            skip = max(1, skip) if start == "measured" else skip
            settling = settling if skip == settling else 0
            undecided = undecided and not settling
            if T - skip < SHORTEST:
                raise TooShortError(
                    f"record '{name}' has {max(T - skip, 0)} scored samples of {T}, with "
                    f"skip={skip}; it needs {SHORTEST}: give a longer record or a smaller skip=N."
                )
        if N is not None and (automatic or settling):
            said = f"the input repeats every {N} samples, {T / N:.3g} times"
            count = settling // N
            if count == 1:
                said += "; the first period is the transient and is not fitted"
            elif count:
                said += f"; the first {count} periods are the transient and are not fitted"
            elif settled and self.start != "periodic":
                said += "; the output is settled from the first sample on: "
                said += "start is periodic" if start == "periodic" else "use start='periodic'"
            self.note(name, said)
        rest = skip if undecided else None
        if undecided:
            start, skip = "estimated", self.skip or 0
        record = Record(
            u[kept],
            y[kept],
            fs=measured.fs,
            start=start,
            skip=skip,
            name=name,
            source="file",
            inputs=measured.inputs,
            outputs=measured.outputs,
            period=N,
            limits=self.limits,
            reference=None if r is None else r[kept],
            valid=None if stretch.valid is None else stretch.valid[kept],
        )
        return record, rest

    def _seen(self, T: int) -> int:
        """Return how many samples may decide how a record begins: test outputs may not."""
        return T - round(T * self.unseen)

    def _whole_periods(self, T: int, N: int) -> bool:
        """Tell if a record consists of periods, at least one in each of its parts."""
        parts = [max(1, round(T // N * part)) for part in (self.validation, self.unseen) if part]
        return T % N == 0 and max(1, sum(parts)) < T // N


def listed_files(given: Any, option: str) -> list[Path]:
    """The files of paths and patterns; the files of a pattern in counting order (2 before 10)."""
    several = isinstance(given, Iterable) and not isinstance(given, str | Path)
    listed: list[Any] = [*given] if several else [given]
    if not listed or not all(isinstance(path, str | Path) for path in listed):
        raise InputError(
            f"{option} is {brief(repr(given))}; give the path of a file, a pattern as "
            "'runs/*.csv', or a list of these."
        )
    found: list[Path] = []
    for entry in listed:
        path = expanded(entry)
        if path.exists() or not glob.has_magic(str(path)):
            found.append(path)
            continue
        matches = [Path(p) for p in glob.glob(str(path), recursive=True) if Path(p).is_file()]
        if not matches:
            raise FileNotFoundError(f"no file matches '{path}'{similar(path)}.")
        found += sorted(matches, key=lambda p: _counting(str(p)))
    return list({real(path): path for path in found}.values())


def place_of(source: Path | Table) -> Path:
    """Return the path of a file, or the name of a table."""
    return source.path if isinstance(source, Table) else source


def _counting(text: str) -> list[tuple[int, str]]:
    """A key that sorts run2 before run10."""
    return [
        (int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", text)
    ]


def stem_of(path: Path) -> str:
    """Name of a file without its extension, followed by its sheet."""
    file, sheet = workbook(path)
    name = file.name
    stem = Path(name[:-3] if name.lower().endswith(".gz") else name).stem
    return f"{stem}_{sheet}" if sheet else stem


def _stems(paths: Sequence[Path], taken: Container[str]) -> list[str]:
    """Names of files, with as many of their folders as needed to tell them apart."""
    full = [real(path) for path in paths]
    names = []
    for depth in range(1, max(len(path.parts) for path in full) + 1):
        names = ["_".join([*path.parts[-depth:-1], stem_of(path)]).lstrip("/") for path in full]
        if len(set(names)) == len(names) and not any(name in taken for name in names):
            return names
    return [f"{name}{path.suffix}" for name, path in zip(names, paths, strict=True)]


def _name(paths: Sequence[Path]) -> str:
    """Name of a data set: the name of its file, or what the names of its files begin with."""
    if len(paths) == 1:
        return stem_of(paths[0])
    letters = zip(*map(stem_of, paths), strict=False)
    common = "".join(some[0] for some in takewhile(lambda some: len(set(some)) == 1, letters))
    return common.rstrip("0123456789_-. ") or real(paths[0]).parent.name or "files"


def _some(names: Sequence[str]) -> str:
    shown = ", ".join(names[:4])
    return shown if len(names) <= 4 else f"{shown} and {len(names) - 4} more"


def is_fraction(use: Use) -> TypeGuard[float]:
    """Tell whether a use is a part of every record."""
    return isinstance(use, Real) and 0 <= float(use) < 1


def _taken(
    option: str, use: Use, wholes: list[_Whole], reader: _Reader
) -> tuple[list[Record], list[_Whole], float]:
    """Return the records for a use, the remaining records, and the fraction to cut from those."""
    if use is None:
        return [], wholes, 0.0
    if isinstance(use, str | Path | Sequence):
        return *_named(option, [use] if isinstance(use, str | Path) else use, wholes, reader), 0.0
    number(option, use)
    if is_fraction(use):
        return [], wholes, float(use)
    if use != int(use):
        raise InputError(
            f"{option} is {use}; give a fraction below 1, a whole number of records, or names of "
            "records or files."
        )
    count = int(use)
    if count >= len(wholes):
        raise InputError(
            f"{option}={count} takes the last {count} of the {len(wholes)} record(s) there are, "
            "which leaves none for training; give more files, or a fraction below 1."
            + f" To score a model on all of it: test={EVERYTHING!r}."
            * (option == "test")
        )
    return [whole.record for whole in wholes[-count:]], wholes[:-count], 0.0


def _named(
    option: str, names: Sequence[str | Path], wholes: list[_Whole], reader: _Reader
) -> tuple[list[Record], list[_Whole]]:
    """Return records by their names or of other files, and the remaining records."""
    left, records = list(wholes), []
    known = list(reader.all)
    for name in names:
        if not isinstance(name, str | Path):
            raise InputError(
                f"{option} is {list(names)!r}; give a fraction, a number of records, or a list of "
                "names of records and files."
            )
        found = [whole for whole in known if str(name) in (whole.record.name, whole.stem)]
        if not found:
            path = expanded(name)
            if not (path.exists() or path.suffix or glob.has_magic(str(name))):
                raise InputError(
                    f"{option} names {str(name)!r}, which is neither a file nor one of the "
                    f"records: {', '.join(whole.record.name for whole in known)}."
                )
            paths = listed_files(name, option)
            same = {real(path) for path in paths}
            found = [whole for whole in known if real(whole.path) in same]
            own = [p for p in paths if real(p) not in {real(w.path) for w in found}]
            fresh = reader.read(own) if own else []
            records += [whole.record for whole in fresh]
        used = [whole.record.name for whole in found if whole not in left]
        if used:
            raise InputError(
                f"{option} names {', '.join(map(repr, used))}, which has a use already; name every "
                "record once in validation and test."
            )
        records += [whole.record for whole in found]
        left = [whole for whole in left if whole not in found]
    return records, left
