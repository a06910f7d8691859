"""All stages of an identification, in their order."""

from __future__ import annotations

from lfrtorch.fitting.acting_inputs import ActingInputs
from lfrtorch.fitting.first_fit import FirstPart
from lfrtorch.fitting.from_outputs import PARTS, MeasuredStates, ShortWindows
from lfrtorch.fitting.given_entries import GivenEntries
from lfrtorch.fitting.known_start import FromEquations, Learned, Parameters
from lfrtorch.fitting.last_fits import MeanOfGood, Refit
from lfrtorch.fitting.linear_start import BestLinear, OutputsAsStates
from lfrtorch.fitting.sizes import Sizes
from lfrtorch.fitting.stage import Stage
from lfrtorch.fitting.start_models import FromLinear, FromModel
from lfrtorch.fitting.whole_fit import WholeFit

STAGES: tuple[Stage, ...] = (
    ActingInputs(),
    OutputsAsStates(),
    BestLinear(),
    Sizes(),
    FromModel(),
    FromEquations(),
    FromLinear(),
    MeasuredStates(),
    GivenEntries(),
    *(ShortWindows(part) for part in PARTS),
    Parameters(),
    Learned(),
    FirstPart(),
    WholeFit(),
    MeanOfGood(),
    Refit(),
)
