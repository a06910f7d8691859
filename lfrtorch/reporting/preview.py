"""A first look at a record before any fit: numbers of its signals, faults, and a figure."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lfrtorch._support.arguments import typed
from lfrtorch.data.records import Record
from lfrtorch.linear.record_start import try_starts
from lfrtorch.survey.measurement import Survey, survey_measurement
from lfrtorch.survey.notes import examine

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Preview:
    """Preview of a record, as by ``lfrtorch preview``; ``print`` shows the numbers and the notes.

    Args:
        survey: the numbers of each signal.
        notes: faults that would hurt a model, with remedies; empty if nothing was found.
        figure: each signal over time, its values, and its spectrum.

    Example:
        >>> print(lfrtorch.preview(record))
        signal    use       samples    missing ...
    """

    survey: Survey
    notes: tuple[str, ...]
    figure: Figure

    def __str__(self) -> str:
        said = [
            textwrap.fill(note, 100, initial_indent="- ", subsequent_indent="  ")
            for note in self.notes
        ]
        return "\n".join(
            [str(self.survey), "", *(said or ["Nothing found that would hurt a model."])]
        )


@typed()
def preview(record: Record) -> Preview:
    """Look at a record before any fit.

    Args:
        record: record with inputs and outputs; outputs that are not valid count as missing.

    Example:
        >>> found = lfrtorch.preview(record[:200])
        >>> print(found.notes[0])
        200 samples are few to fit...
        >>> found.figure.savefig("preview.png")
    """
    from lfrtorch.reporting.survey_plots import survey_figure  # slow: imports matplotlib

    y = np.where(record.valid, record.y, np.nan) if record.valid is not None else record.y
    survey = survey_measurement(
        record.u, y, record.fs, inputs=record.inputs, outputs=record.outputs, period=record.period
    )
    notes = [note.text for note in examine(survey, record.u, y)]
    if record.start == "zero" and survey.inputs and record.period is None:
        try:
            trial = try_starts(record)
        except ValueError:  # too short, or too little excitation
            trial = None
        if trial is not None and trial.in_motion:
            notes.append(f"{trial}, and the record has start 'zero'")
    figure = survey_figure(survey, np.hstack([record.u, y]), record.name)
    return Preview(survey, tuple(notes), figure)
