"""One record cut in time into a training, a validation and a test record."""

from __future__ import annotations

from dataclasses import replace

from lfrtorch._support.errors import InputError
from lfrtorch.data.records import Record
from lfrtorch.data.score_window import SHORTEST


class TooShortError(InputError):
    """A record that leaves a part too few samples."""


def cut(record: Record, validation: float, test: float) -> dict[str, Record]:
    """Cut a record into parts by use; a use with fraction 0 has no part."""
    # Every part begins where the record begins and is simulated from there, but only its own
    # samples are scored, so the transient of the start reaches neither validation nor test. A
    # record in steady state is cut into whole periods, each in steady state. A part with a measured
    # start begins at its own first output.
    names = ["train", *["validation"] * bool(validation), *["test"] * bool(test)]
    steady = record.start == "periodic"
    unit = (record.period or record.samples) if steady else 1
    total = record.samples // unit
    held = [max(1, round(total * f)) for f in (validation, test) if f]
    if steady and total - sum(held) < 1:
        raise TooShortError(
            f"record '{record.name}' has {total} whole period(s) after the transient, and "
            f"{', '.join(names)} need one each; set validation or test to 0, or start='zero'."
        )
    ends = [total - sum(held)]
    for count in held:
        ends.append(ends[-1] + count)
    parts, begin = {}, 0
    for name, end in zip(names, ends, strict=True):
        if steady:
            part = replace(record[begin * unit : end * unit], start="periodic", period=unit)
        else:
            first = max(begin, record.skip)
            if end - first < SHORTEST:
                raise TooShortError(
                    f"record '{record.name}': the {name} part has {max(end - first, 0)} scored "
                    f"samples of {total}, with skip={record.skip}; it needs {SHORTEST}: change the "
                    "fractions or skip."
                )
            part = replace(record[:end], start=record.start, skip=first)
            if record.start == "measured":  # the part begins at its own first output
                part = replace(record[begin:end], skip=max(1, first - begin))
        parts[name], begin = part, end
    return parts
