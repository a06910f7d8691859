"""Settings that are numbers, texts and lists, for both Python and the command line.

Nothing heavy is imported here, as the help of the command line reads these declarations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from lfrtorch._support.settings import setting

Size = int | Literal["auto"]
"""A number, or "auto" for a number that the data choose."""

Noise = Literal["output", "innovation"]
"""Place of the noise: at the outputs alone, so that simulation errors are fitted, or also inside
the system, so that prediction errors are fitted."""


@dataclass(frozen=True, kw_only=True)
class PlainSettings:
    """The part of :class:`lfrtorch.Settings` that the command line passes on unchanged."""

    nx: Size | None = setting(
        None,
        'number of states. ``"auto"``: the lowest order up to ``nx_max`` whose linear model is as '
        'good as the best; it may be larger if another size is ``"auto"`` and more states lower '
        "the error of the NL-LFR. Required in Python, unless ``init_from`` is given.",
        least=1,
        word="auto",
    )
    nx_max: int = setting(12, 'highest order that ``nx="auto"`` tries.', least=1)
    nz: Size = setting(2, 'inputs of the static nonlinearity, or ``"auto"``.', least=1, word="auto")
    nw: Size = setting(1, 'outputs of the nonlinearity, or ``"auto"``.', least=1, word="auto")
    nn: Size = setting(15, 'neurons of ``static="network"``, or ``"auto"``.', least=1, word="auto")
    activation: Literal["tanh", "sigmoid", "relu", "rbf", "softplus"] = setting(
        "tanh",
        'function of neurons: ``"tanh"``, ``"sigmoid"``, ``"relu"``, ``"rbf"``, ``"softplus"``.',
    )
    degree: Size = setting(3, 'degree of the polynomial, or ``"auto"``.', least=1, word="auto")
    init: Literal["auto", "zero_output", "random_states", "paper"] = setting(
        "auto",
        'method that makes the starts, see :func:`lfrtorch.initialise`. ``"auto"``: '
        '``"zero_output"``, and ``"random_states"`` for every second start if it applies.',
    )
    relaxations: int = setting(
        0,
        "real poles that w alone drives, for hysteresis. Each adds a state to the ``nx`` of the "
        "linear model, see :func:`lfrtorch.initialise`.",
        least=0,
    )
    modes: int = setting(
        0, "modes that w alone drives, two states each, for structures that rattle.", least=0
    )
    z_feedthrough: bool = setting(
        True,
        "whether the input acts on z at once. False: the nonlinearity depends on the states alone, "
        "see :func:`lfrtorch.initialise`.",
    )
    feedthrough: bool = setting(
        True,
        "whether the input acts on the output at once, also in the linear model. Give False for "
        "data from a feedback loop without a delay.",
    )
    delay: float | Literal["auto"] | tuple[float, ...] = setting(
        0,
        'dead time of the inputs in samples, one number, or one for each input; ``"auto"``: found '
        "by linear models. Inputs act later by whole samples, rounded up; the fit finds the "
        "fraction, see :func:`lfrtorch.analysis.dead_times`.",
    )
    structure: Literal["free", "wiener", "hammerstein", "wiener_hammerstein", "parallel"] = setting(
        "free",
        'block structure of the model, which a fit keeps: ``"wiener"``, ``"hammerstein"``, '
        '``"wiener_hammerstein"`` or ``"parallel"``, see :func:`lfrtorch.initialise`.',
    )
    ridge: float | Literal["auto"] | Mapping[str, float] = setting(
        0.0,
        "weight of the squared distance to the start, against overfitting; or a weight for each of "
        'several parameters by name, see :func:`lfrtorch.fit`. ``"auto"``: chosen by '
        "cross-validation, as 0 is, too, if sizes are chosen.",
    )
    noise: Noise = setting(
        "output",
        'where noise acts, ``"output"`` or ``"innovation"``, see :func:`lfrtorch.fit`. With '
        '``"innovation"`` validation errors are those of predictions one sample ahead, and the '
        'linear model has ``refine="prediction"`` unless it has exact integrators.',
    )
    horizon: int | None = setting(
        None,
        "samples of the windows that a fit cuts training and validation records into, see "
        ":func:`lfrtorch.fit`. Default: records are simulated whole.",
        least=2,
    )
    average: int = setting(
        1,
        "largest number of best starts whose mean is the model; fewer are averaged if more would "
        "raise the validation error, see :func:`lfrtorch.fit`.",
        least=1,
    )
    refit: bool = setting(
        False,
        "whether the model that validation chose is at last fitted to all estimation records, see "
        ":func:`lfrtorch.refit`.",
    )
    first_part: float = setting(
        1.0,
        "part of the training samples that the first iterations fit, to choose a start at lower "
        "cost; the search for sizes fits this part, too. It is made of the shortest records, or of "
        "the beginning of each record if all are longer than the part. Default: 1, all samples are "
        "fitted from the first iteration.",
        positive=True,
        most=1,
    )
    first_iterations: int = setting(40, "number of iterations on ``first_part``.", least=1)
    starts: Size = setting(
        "auto",
        "number of random starts, of which the best is kept; at least 4 if sizes are chosen. "
        '``"auto"``: 8, or 16 if sizes are chosen, or fewer if these would take more than about a '
        "minute on one core. A single start may end in a poor minimum.",
        least=1,
        word="auto",
    )
    seed: int = setting(
        0,
        "seed of the first start; the others have seed + 1000, seed + 2000, ...",
        least=0,
    )
    device: str = setting("cpu", 'device of the fit: ``"cpu"`` or ``"cuda"``.')
