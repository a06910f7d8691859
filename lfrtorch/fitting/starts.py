"""Weights of an NL-LFR model whose output is at first that of a best linear approximation."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor
from torch.nn import Module

from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError
from lfrtorch.data.records import Record, Scaler, as_records, rms_scale, without_coordinates
from lfrtorch.engine import held
from lfrtorch.engine.cell import LFRCell, check_dtype
from lfrtorch.engine.lfr import LFR
from lfrtorch.fitting.driven_states import with_driven_states
from lfrtorch.fitting.exclusions import refuse_together
from lfrtorch.fitting.nonlinear_end import nonlinear_end
from lfrtorch.fitting.random_states import unsuited, with_random_states
from lfrtorch.least_squares.fit_memory import check_fit_memory
from lfrtorch.linear.model import LinearModel
from lfrtorch.linear.modes import without_slow_minor_modes
from lfrtorch.maps.network import Network
from lfrtorch.model.model import Model

_OUTPUT_RANGE = 0.3
"""Range of the ``"zero_output"`` start: Bw, Dyw ~ U(-0.3, 0.3)."""

_RUNAWAY = 1e38
"""Largest normalised state; its eighth power, in a polynomial, is still finite."""


@typed("dtype")
def initialise(
    bla: LinearModel,
    records: Record | Sequence[Record],
    *,
    nz: int,
    nw: int,
    nn: int | None = None,
    activation: str = "tanh",
    static: Module | None = None,
    method: Literal["zero_output", "random_states", "paper"] = "zero_output",
    seed: int = 0,
    relaxations: int = 0,
    modes: int = 0,
    z_feedthrough: bool = True,
    feedthrough: bool = True,
    structure: str = "free",
    dtype: torch.dtype = torch.float64,
) -> Model:
    """Make an NL-LFR model whose output is that of the linear model, or near the data.

    ``"zero_output"`` first speeds up modes of the linear model that are slower than all others and
    add next to nothing to the output (:func:`lfrtorch.linear.modes.without_slow_minor_modes`). It
    does not if the linear model has a noise model, or if a record has a measured start.

    Signals, states and every z are scaled to unit standard deviation over the records. For z, C*
    and D* are drawn from U(-1, 1), and Cz, Dzu are C*, D* over the standard deviation of
    C* x + D* u. The static map is a ``Network`` with random weights (Wz and bz ~ U(-1, 1), bw = 0),
    or a module of the caller's own with its given weights. Two methods begin at the linear model,
    and differ in what makes the contribution of w zero:

    - ``"paper"``: Bw = Dyw = 0 and Ww ~ U(-1, 1) (Schoukens and Tóth 2020);
    - ``"zero_output"``: Ww = 0 and Bw, Dyw ~ U(-0.3, 0.3) (after Schoukens 2021); for a polynomial
      C = 0. This method is more reliable. For a module of another class it applies only if the
      module's output with its given weights is zero on the data; otherwise Bw = Dyw = 0.

    ``"random_states"`` does not begin at the linear model, whose states may be far from those of
    the system. It draws many Wiener models, with modes of the linear model or random ones and a
    random network, fits their outputs by least squares, and keeps the best
    (``lfrtorch.fitting.random_states``).

    If a static map of the linear model's output explains most of the model's error, as in a Wiener
    system, ``"zero_output"`` begins there: the first z are the linear model's outputs, and Bw = 0.
    If a static map of the input does, as in a Hammerstein system, the first z are the inputs.

    ``relaxations`` and ``modes`` add states that w alone drives. A relaxation is a real pole whose
    state z sees; relaxations describe hysteresis. Their corner frequencies are spread over two
    decades up to half the band of the inputs. Modes are lightly damped, above the band of the
    inputs, where the linear model has no modes. Their frequencies split the power of the linear
    model's errors there into equal parts. Friction, clearance and impacts excite such modes of a
    structure.

    Exact integrators of the linear model (``estimate_bla(..., integrators=1)``) stay exact: no z
    sees their states, and a fit does not change their columns of A and Cz. Without
    ``z_feedthrough`` Dzu is 0, and a fit keeps it 0: the nonlinearity depends on the states alone.
    Without ``feedthrough`` the input does not act on the output at once, neither by Dyu nor through
    w: Dyw is then 0 as well, unless Dzu is 0. Data from a feedback loop without a delay need this.

    ``structure`` gives the model a block structure, which a fit keeps. In all structures but
    ``"free"``, w never acts on z:

    - ``"wiener"``: w acts on the output alone, and z is made of the linear model's states;
    - ``"hammerstein"``: z is made of the inputs alone;
    - ``"wiener_hammerstein"``: w alone drives a second set of states, a copy of those of the linear
      model, so that nx doubles;
    - ``"parallel"``: as ``"wiener_hammerstein"``, with a map of nz = nw functions of one z each.

    Args:
        bla: stable linear model, best in balanced coordinates.
        records: the data that are to be fitted.
        nz, nw: inputs and outputs of the static nonlinearity.
        nn, activation: number of neurons of the network, and their function.
        static: the map z -> w in place of the network, which is copied: a ``Network``, a
            ``Polynomial`` or any module from (..., nz) to (..., nw); nn and activation are ignored.
        method: ``"zero_output"``, ``"random_states"`` or ``"paper"``.
        seed: seed of the random weights.
        relaxations, modes: numbers of relaxations (one state each) and modes (two states each) that
            are added to the linear model.
        z_feedthrough: True if the input acts on z at once.
        feedthrough: True if the input acts on the output at once; if False, the linear model must
            have D = 0.
        structure: ``"free"``, ``"wiener"``, ``"hammerstein"``, ``"wiener_hammerstein"`` or
            ``"parallel"``.
        dtype: dtype of the weights.

    Raises:
        ValueError: sizes below 1, or so large that a fit needs more memory than there is; a dtype
            that is not float32 or float64; an unknown method; a static map of other sizes; modes,
            but no errors above the band of the inputs; no state or input that z may see;
            ``feedthrough=False`` and a linear model with D; a linear model that runs away; or
            ``"random_states"`` with a static map that is no network, a structure, integrators, a
            noise model, or a record with a given or measured start.

    References:
        Schoukens and Tóth, IFAC-PapersOnLine 53(2), 2020, section 4.2.
        Schoukens, "Improved initialization of state-space artificial neural networks", ECC 2021.

    Example:
        >>> model = lfrtorch.initialise(bla, record, nz=1, nw=1, nn=4, seed=1)
        >>> np.allclose(model.simulate(record), bla.simulate(record))
        True
        >>> static = lfrtorch.Polynomial(1, 1, degree=3)
        >>> lfrtorch.initialise(bla, record, nz=1, nw=1, static=static).sizes["degree"]
        3
    """
    for name, size in (("nz", nz), ("nw", nw)):
        integer(name, size, 1)
    integer("seed", seed, 0)
    integer("relaxations", relaxations, 0)
    integer("modes", modes, 0)
    check_dtype(dtype)
    _check_structure(structure, nz, nw, nn if static is None else None)
    refuse_together(
        structure=structure,
        relaxations=relaxations,
        modes=modes,
        z_feedthrough=z_feedthrough,
    )
    if not feedthrough:
        _check_no_feedthrough(bla, structure, z_feedthrough)
    data = [without_coordinates(record) for record in as_records(records)]
    # Slow modes are kept if they model noise, or if measured outputs determine their states.
    told = bla.K is not None or any(record.start == "measured" for record in data)
    if method != "paper" and not told:
        bla = without_slow_minor_modes(bla, data)
    scaler = Scaler(
        bla.u_offset,
        rms_scale([r.u for r in data], bla.u_offset),
        bla.y_offset,
        rms_scale([r.y for r in data], bla.y_offset),
        bla.delay,
    )
    sizes = len(bla.inputs), len(bla.outputs), len(bla.A)
    generator = torch.Generator().manual_seed(int(seed))
    if static is None:
        integer("nn", nn, 1)
        assert nn is not None
        with torch.device("meta"):  # nothing is allocated
            planned = Network(nz, nw, nn, activation, dtype=dtype)
            check_fit_memory(LFRCell(*sizes, nz, nw, planned, dtype=dtype, random=False))
        static = Network(nz, nw, nn, activation, dtype=dtype)
        static.reset_parameters(generator)
    else:
        static = deepcopy(static).to(dtype)
        _check_sizes(static, nz, nw, dtype)
    linear, cell = (
        LFRCell(*sizes, dtype=dtype, random=False),
        LFRCell(*sizes, nz, nw, static, dtype=dtype, random=False),
    )
    for target in (linear, cell):
        bla.write(target, scaler)
    response, model = (
        Model(LFR(c), scaler, bla.fs, bla.inputs, bla.outputs) for c in (linear, cell)
    )

    def uniform(parameter: Tensor, limit: float = 1.0) -> None:
        parameter.uniform_(-limit, limit, generator=generator)

    with torch.no_grad():
        found = [response.signals(record) for record in data]
        x = torch.cat([trajectory.x[0, :-1] for trajectory in found])
        u = torch.cat([torch.as_tensor(scaler.normalise(r).u).to(x) for r in data])
        std = _deviation(x)
        if not (x.abs() < _RUNAWAY).all():
            raise InputError(
                "the linear model is unstable, and its simulation of a record runs away; give a "
                "horizon with start='measured', or shorter records."
            )
        cell.A.copy_(cell.A * std / std[:, None])
        cell.Bu.div_(std[:, None])
        cell.Cy.mul_(std)
        if bla.state_covariance is not None:
            cell.state_covariance.div_(torch.outer(std, std))
        K = None
        if bla.K is not None:
            K = torch.as_tensor(bla.K * scaler.y_scale).to(std) / std[:, None]
        integrating = held.integrating_states(cell)
        uniform(cell.Cz)
        uniform(cell.Dzu)
        known = method == "zero_output" and z_feedthrough
        end = nonlinear_end(response, data, found) if known else None
        if end == "output" and not integrating.any():
            cell.Cz[: cell.ny], cell.Dzu[: cell.ny] = cell.Cy[:nz], cell.Dyu[:nz]
        elif end == "input":
            cell.Cz[: cell.nu], cell.Dzu[: cell.nu] = 0.0, torch.eye(cell.nu).to(u)[:nz]
        if integrating.all() and not z_feedthrough:
            raise InputError(
                "z_feedthrough is False, and all states integrate, which z may not see; raise nx."
            )
        cell.Cz[:, integrating] = 0.0
        if structure == "hammerstein":
            cell.Cz.zero_()
        cell.Dzu.mul_(z_feedthrough)
        z = (x / std) @ cell.Cz.mT + u @ cell.Dzu.mT
        spread = _deviation(z)[:, None]
        cell.Cz.div_(spread)
        cell.Dzu.div_(spread)
        if method != "paper":
            cell.map.zero_output()
        if method != "paper" and not static((z / spread.mT).unsqueeze(0)).any():
            to_output = feedthrough or not z_feedthrough
            uniform(cell.Bw, 0.0 if end == "output" and to_output else _OUTPUT_RANGE)
            uniform(cell.Dyw, _OUTPUT_RANGE if to_output else 0.0)
    model = replace(model, K=K)
    if structure in held.IN_SERIES:
        model = _in_series(model)
    model = with_driven_states(model, data, relaxations, modes, generator)
    cell = model.lfr.cell
    for given in (
        held.structure(cell, structure, before=len(bla.A)),
        held.integrators(cell),
        held.no_feedthrough(cell, z=z_feedthrough, y=feedthrough),
    ):
        cell.hold(given)
    if method != "random_states":
        return model
    if reason := unsuited(model, data):
        raise InputError(f"method is 'random_states', but {reason}; give 'zero_output'.")
    return with_random_states(model, data, int(seed))


@torch.no_grad()
def _in_series(model: Model) -> Model:
    """The model with a copy of its states behind the static map, which w alone drives."""
    before, none, K = model.lfr.cell, torch.zeros_like, model.K
    sizes = before.nu, before.ny, 2 * before.nx, before.nz, before.nw
    like = {"device": before.A.device, "dtype": before.A.dtype}
    cell = LFRCell(*sizes, before.static, **like, random=False)
    cell.A.copy_(torch.block_diag(before.A, before.A))
    cell.Bu.copy_(torch.cat([before.Bu, none(before.Bu)]))
    cell.Bw.copy_(torch.cat([none(before.Bw), before.Bw]))
    cell.Cz.copy_(torch.cat([before.Cz, none(before.Cz)], dim=1))
    cell.Cy.copy_(torch.cat([before.Cy, before.Cy], dim=1))
    for name in ("Dzu", "Dyu", "Dyw"):
        cell.get_parameter(name).copy_(before.get_parameter(name))
    K = None if K is None else torch.cat([K, none(K)])
    return replace(model, lfr=LFR(cell), K=K)


def _check_structure(structure: str, nz: int, nw: int, nn: int | None) -> None:
    """Raise a ValueError for an unknown structure, or sizes that do not fit it."""
    if structure not in held.STRUCTURES:
        raise InputError(f"structure is {structure!r}; use one of {', '.join(held.STRUCTURES)}.")
    if structure == "parallel":
        if nz != nw:
            raise InputError(
                f"structure is 'parallel', which has a w for each z, but nz={nz} and nw={nw}."
            )
        if nn is not None and nn < nz:
            raise InputError(f"structure is 'parallel', but {nn} neurons are fewer than {nz} z.")


def _check_no_feedthrough(bla: LinearModel, structure: str, z_feedthrough: bool) -> None:
    """Raise a ValueError if the input would act on the output at once."""
    if bla.D.any():
        raise InputError(
            "feedthrough is False, but the linear model has feedthrough; estimate it with "
            "estimate_bla(..., feedthrough=False)."
        )
    if structure == "wiener" and z_feedthrough:
        raise InputError(
            "structure is 'wiener', whose w acts on the output alone, and feedthrough is False; "
            "give z_feedthrough=False as well."
        )


def _check_sizes(static: Module, nz: int, nw: int, dtype: torch.dtype) -> None:
    """Raise a ValueError if a static map does not map nz signals to nw signals."""
    try:
        with torch.no_grad():
            found: object = tuple(static(torch.zeros(1, 2, nz, dtype=dtype)).shape)
    except (RuntimeError, IndexError) as error:
        found = error
    if found != (1, 2, nw):
        raise InputError(
            f"static gives {found} for z of shape (1, 2, {nz}); with nz={nz} and nw={nw} it must "
            f"give w of shape (1, 2, {nw})."
        )


def _deviation(signal: Tensor) -> Tensor:
    std = signal.std(dim=0, correction=0)
    return torch.where(std > 0, std, torch.ones_like(std))
