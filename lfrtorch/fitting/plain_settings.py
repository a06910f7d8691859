"""Settings that are numbers, texts and lists, as Python and the command line have them.

Nothing heavy is imported here: the help of the command line reads the declarations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from lfrtorch._support.settings import setting

Size = int | Literal["auto"]
"""A number, or one that the data choose."""

Noise = Literal["output", "innovation"]
"""Criteria of a fit: simulation errors, as if noise were at the outputs alone, or predictions."""


@dataclass(frozen=True, kw_only=True)
class PlainSettings:
    """The part of :class:`lfrtorch.Settings` that the command line hands on as it is."""

    nx: Size | None = setting(
        None,
        'states. ``"auto"``: the lowest order up to ``nx_max`` whose linear model does as well as '
        'the best, and more if an NL-LFR makes use of them and another size is ``"auto"``, too. '
        "Required in Python, unless ``init_from`` brings it.",
        least=1,
        word="auto",
    )
    nx_max: int = setting(12, 'highest order that ``nx="auto"`` tries.', least=1)
    nz: Size = setting(
        2, 'inputs of the static nonlinearity; ``"auto"`` searches for them.', least=1, word="auto"
    )
    nw: Size = setting(1, 'its outputs, or ``"auto"``.', least=1, word="auto")
    nn: Size = setting(15, 'neurons of ``static="network"``, or ``"auto"``.', least=1, word="auto")
    activation: Literal["tanh", "sigmoid", "relu", "rbf", "softplus"] = setting(
        "tanh",
        'their function: ``"tanh"``, ``"sigmoid"``, ``"relu"``, ``"rbf"`` or ``"softplus"``.',
    )
    degree: Size = setting(3, 'of ``static="polynomial"``, or ``"auto"``.', least=1, word="auto")
    init: Literal["zero_output", "paper"] = setting(
        "zero_output", "where the fit starts, see :func:`lfrtorch.initialise`."
    )
    relaxations: int = setting(
        0,
        "real poles that w alone drives, a state each beside the ``nx`` of the linear model: for "
        "hysteresis, see :func:`lfrtorch.initialise`.",
        least=0,
    )
    modes: int = setting(
        0, "modes that w alone drives, two states each: for structures that rattle.", least=0
    )
    z_feedthrough: bool = setting(
        True,
        "whether the input acts on z at once; False for a nonlinearity of the states alone, see "
        ":func:`lfrtorch.initialise`.",
    )
    feedthrough: bool = setting(
        True,
        "whether it acts on the output at once; False for data under feedback without a delay. "
        "The linear model has none then, either.",
    )
    structure: Literal["free", "wiener", "hammerstein", "wiener_hammerstein", "parallel"] = setting(
        "free",
        'of which blocks the model is made, and a fit keeps to: ``"wiener"``, ``"hammerstein"``, '
        '``"wiener_hammerstein"`` or ``"parallel"``, see :func:`lfrtorch.initialise`.',
    )
    ridge: float | Literal["auto"] | Mapping[str, float] = setting(
        0.0,
        "weight of the squared distance to the start, against overfitting; or weights by the "
        'parameters\' names, see :func:`lfrtorch.fit`. ``"auto"``: chosen by cross-validation; so '
        "is 0 with sizes that are.",
    )
    noise: Noise = setting(
        "output",
        'where it acts, ``"output"`` or ``"innovation"``, see :func:`lfrtorch.fit`. '
        'If it is not the output, the linear model has ``refine="prediction"``, too, unless it has '
        "exact integrators, and validation errors are those of predictions one sample ahead.",
    )
    horizon: int | None = setting(
        None,
        "samples of the windows that training and validation records are cut into in a fit, see "
        ":func:`lfrtorch.fit`. Default: records are simulated whole.",
        least=2,
    )
    average: int = setting(
        1,
        "the model is the mean of at most so many of the best starts, as long as it validates as "
        "well, see :func:`lfrtorch.fit`.",
        least=1,
    )
    refit: bool = setting(
        False,
        "whether the model that validation chose is fitted to all estimation records at last, see "
        ":func:`lfrtorch.refit`.",
    )
    first_part: float = setting(
        1.0,
        "part of the training samples that the first iterations fit, which cost as much less and "
        "choose one of the starts: the shortest records, those of a length spread evenly; the "
        "beginning of each if the part is less than a record. The search for sizes fits them, too. "
        "1 is for all.",
        positive=True,
        most=1,
    )
    first_iterations: int = setting(40, "how many of these there are.", least=1)
    starts: Size = setting(
        "auto",
        "random starts, of which the best is kept; at least 4 if sizes are chosen. "
        '``"auto"``: 8, or fewer if they would take more than about a minute on one core. A single '
        "one may end in a poor minimum.",
        least=1,
        word="auto",
    )
    seed: int = setting(
        0,
        "of the first start; the others have seed + 1000, seed + 2000, ...",
        least=0,
    )
    device: str = setting("cpu", 'of the fit: ``"cpu"`` or ``"cuda"``.')
