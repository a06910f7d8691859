"""Starts of a fit of a known model: first its parameters are fitted, then learned parts are added.

The known model is a block of the LFR's static map. Fixed matrices lead x and u to this block, and
its next state and output back. A network (or polynomial) and ``nx`` states are learned beside it:
they see all states and inputs, and act on all states and outputs. The learned part begins at zero,
so the model begins as the known model.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy, deepcopy
from dataclasses import replace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from lfrtorch._support.tables import number, quantity
from lfrtorch.data.records import Record, Scaler, common_unit, rms_scale
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.held import no_feedthrough
from lfrtorch.engine.lfr import LFR
from lfrtorch.fitting.driven_states import begin_driven, frequencies, relaxation_frequencies
from lfrtorch.fitting.observer import Observer
from lfrtorch.fitting.prediction import without_innovations
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.stage import Job, Stage
from lfrtorch.fitting.trainer import FitResult, StartDivergesError, Trainer
from lfrtorch.fitting.windows import begins_at_outputs, in_windows
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.linear.model import LinearModel
from lfrtorch.maps.direct_sum import DirectSum
from lfrtorch.maps.known_map import KnownModel
from lfrtorch.maps.network import Network
from lfrtorch.maps.static_map import StaticMap, as_map
from lfrtorch.model.known import Known
from lfrtorch.model.model import Model

_ITERATIONS = 240
"""Iterations of the first fit, which fits only the parameters of the known model."""

_FROM_OUTPUTS = 20
"""Iterations of that fit if records begin at outputs, where fits over short windows precede it."""

_STARTS = 8
"""Number of starts of that fit, each with other values of the parameters."""

_SPREAD = 0.5
"""Standard deviation of the logarithm of the factor on each parameter, for all starts but the
first."""

_REACH = 0.3
"""Largest entry of Bw and Dyw at the start, for states and outputs of unit rms."""


def known_model(known: Known, linear: LinearModel, records: Sequence[Record]) -> Model:
    """The known model as an LFR; its signals have the offsets of the linear model."""
    first = records[0]
    nu, ny, nx = len(first.inputs), len(first.outputs), len(known.states)
    scaler = Scaler(
        linear.u_offset,
        rms_scale([r.u for r in records], linear.u_offset),
        linear.y_offset,
        rms_scale([r.y for r in records], linear.y_offset),
        linear.delay,
    )
    static = known.map(nu, [channel.name for channel in first.outputs], first.fs)
    with torch.no_grad():
        for ends, place, offset, scale in (
            (static.of_z, nx, scaler.u_offset, scaler.u_scale),
            (static.of_w, nx, scaler.y_offset, scaler.y_scale),
        ):
            ends[place:] = torch.as_tensor(np.stack([offset, scale], axis=1))
    cell = around(static, known, nu, ny)
    model = Model(LFR(cell), scaler, first.fs, first.inputs, first.outputs)
    x = torch.cat([model.signals(record).x[0] for record in records])
    rms = x.square().mean(dim=0).sqrt()
    with torch.no_grad():
        for i, state in enumerate(known.states):
            if state.scale is None and torch.isfinite(rms[i]) and rms[i] > 0:
                static.of_z[i, 1] = static.of_w[i, 1] = rms[i]
    return model


def around(
    static: KnownModel,
    known: Known,
    nu: int,
    ny: int,
    *,
    learned: StaticMap | None = None,
    states: int = 0,
) -> LFRCell:
    """The cell around a known model, a learned map and learned states; learned entries are 0."""
    nx, names = len(known.states), [state.name for state in known.states]
    parts = [static] if learned is None else [static, learned]
    sizes = [(part.nz, part.nw) for part in parts]
    nz, nw = map(sum, zip(*sizes, strict=True))
    whole = static if learned is None else DirectSum(parts, sizes)
    like: dict[str, Any] = {"dtype": static.p.dtype, "device": static.p.device}
    cell = LFRCell(nu, ny, nx + states, nz, nw, whole, **like, random=False)
    with torch.no_grad():
        cell.Cz[:nx, :nx], cell.Dzu[nx : nx + nu] = torch.eye(nx), torch.eye(nu)
        cell.Bw[:nx, :nx], cell.Dyw[:, nx : nx + ny] = torch.eye(nx), torch.eye(ny)
    x, z, w = (torch.arange(n) for n in (nx + states, nz, nw))
    own_x, own_z, own_w = x < nx, z < static.nz, w < static.nw

    def not_among(some: Sequence[str]) -> Tensor:  # mask of the known states that are not in some
        return torch.tensor([n not in some for n in names] + [False] * states, dtype=torch.bool)

    unseen, alone = not_among(known.sees), not_among(known.acts_on)
    u_unseen, y_alone = "u" not in known.sees, "y" not in known.acts_on
    given = {
        "A": (own_x[:, None] & own_x) | unseen | alone[:, None],
        "Bu": (own_x | u_unseen)[:, None].expand(-1, nu),
        "Bw": own_w | alone[:, None],
        "Cz": own_z[:, None] | unseen,
        "Dzu": (own_z | u_unseen)[:, None].expand(-1, nu),
        "Cy": (own_x | y_alone).expand(ny, -1),
        "Dyu": torch.ones(ny, nu, dtype=torch.bool),
        "Dyw": (own_w | y_alone).expand(ny, -1),
    }
    cell.hold({name: (mask, cell.get_parameter(name).detach()) for name, mask in given.items()})
    return cell


def with_learned(model: Model, records: Sequence[Record], settings: Settings, seed: int) -> Model:
    """A known model with the parts to be learned added, whose output is still zero."""
    old, static = model.lfr.cell, deepcopy(model.lfr.cell.map.known)
    known, nx, states = cast(Known, settings.known), old.nx, cast(int, settings.nx)
    generator = torch.Generator().manual_seed(seed)
    learned = learned_map(settings, generator)
    driven = settings.relaxations + 2 * settings.modes
    cell = around(static, known, old.nu, old.ny, learned=learned, states=states + driven)
    cell.hold(no_feedthrough(cell, z=settings.z_feedthrough, y=settings.feedthrough))

    def uniform(name: str, part: Any, limit: float = 1.0) -> None:
        entries = cell.get_parameter(name)[part]
        entries.uniform_(-limit, limit, generator=generator)
        if name in cell.held:
            entries.masked_fill_(cell.held[name][part], 0.0)

    with torch.no_grad():
        found = [model.signals(record) for record in records]
        x = torch.cat([t.x[0, :-1] for t in found])
        u = torch.cat([torch.as_tensor(model.scaler.normalise(r).u) for r in records])
        if states:
            corners = relaxation_frequencies([record.u for record in records], states)
            decay = torch.as_tensor(np.exp(-corners))
            linear = slice(nx, nx + states)
            cell.A[linear, linear] = torch.diag(decay)
            uniform("Bu", linear)
            cell.Bu[linear] *= (1.0 - decay.square()).sqrt()[:, None]
        own_z, own_w = slice(static.nz, None), slice(static.nw, None)
        if learned is not None:
            uniform("Cz", own_z)
            uniform("Dzu", own_z)
            z = x @ cell.Cz[own_z, :nx].mT + u @ cell.Dzu[own_z].mT
            rms = z.square().mean(dim=0).sqrt().clamp_min(1e-6)
            rms = torch.where(torch.isfinite(rms), rms, 1.0)
            cell.Cz[own_z] /= rms[:, None]
            cell.Dzu[own_z] /= rms[:, None]
            if settings.init != "paper":
                uniform("Bw", (slice(None), own_w), _REACH)
                uniform("Dyw", (slice(None), own_w), _REACH)
                learned.zero_output()
        if driven:
            bands = frequencies(model, records, settings.relaxations, settings.modes)
            begin_driven(cell, *bands, generator, z=own_z, w=own_w)
    K = None if model.K is None else pad(model.K, (0, 0, 0, states + driven))
    return replace(model, lfr=LFR(cell), K=K)


def learned_map(settings: Settings, generator: torch.Generator) -> StaticMap | None:
    """The map that is learned beside a known model; None if the settings ask for none."""
    nz, nw, nn = (cast(int, size) for size in (settings.nz, settings.nw, settings.nn))
    if settings.static != "network":
        return as_map(settings.static_map()["static"].to(torch.float64), nz, nw)
    if nn == 0:
        return None
    found = Network(nz, nw, nn, settings.activation, dtype=torch.float64)
    found.reset_parameters(generator)
    return found


def varied(model: Model, seed: int) -> Model:
    """The known model with each parameter times a random factor, clipped to its bounds."""
    found = deepcopy(model)
    static, random = found.lfr.cell.map.known, np.random.default_rng(seed)
    low, high = static.weight_bounds.numpy().T
    p = static.p.detach().numpy().copy()
    shifted = np.where(p == 0.0, _SPREAD * random.standard_normal(len(p)), p)
    p = np.where(p == 0.0, shifted, p * np.exp(_SPREAD * random.standard_normal(len(p))))
    with torch.no_grad():
        static.p.copy_(torch.as_tensor(np.clip(p, low, high)))
    return found


class FromEquations(Stage):
    """A known model with the given parameters, and copies with parameters near the given ones."""

    def when(self, job: Job) -> bool:
        """Tell if a known model is given."""
        return job.settings.known is not None

    def run(self, job: Job) -> Job:
        """Make the models; the next fit has no ridge, which is for the learned part alone."""
        settings, train = job.settings, job.dataset.train
        known, count = cast(Known, settings.known), _count(settings)
        if begins_at_outputs(train):  # outputs are states: the learned part has no feedthrough
            known, count = copy(known), 1  # one start: short windows lead to the best minimum
            known.acts_on = tuple(name for name in known.acts_on if name != "y")
            settings = replace(settings, known=known)
        model = known_model(known, job.linear, in_windows(train, settings.horizon))
        model = model if settings.noise == "output" else without_innovations(model)
        if known.outputs is None and len(model.outputs) > 1:
            observed = known.observed([y.name for y in model.outputs])
            pairs = zip(model.outputs, observed, strict=True)
            job.observer.say(f"known model: {', '.join(f'{y.name} is {x}' for y, x in pairs)}")
        others = [varied(model, settings.seed + n) for n in range(1, count)]
        return replace(job, settings=settings, models=[model, *others], ridge=0.0)


class Parameters(Stage):
    """The fit of the parameters of a known model alone."""

    name = "the fit of the parameters of the known model"

    def when(self, job: Job) -> bool:
        """Tell if a known model is given and has parameters."""
        return job.settings.known is not None and bool(job.settings.known.parameters)

    def trainer(self, job: Job) -> Trainer:
        """A trainer with enough iterations for few parameters."""
        begun = begins_at_outputs(job.dataset.train)
        return LevenbergMarquardt(max_iter=_FROM_OUTPUTS if begun else _ITERATIONS)

    def run(self, job: Job) -> Job:
        """The job after the fit."""
        try:
            return super().run(job)
        except StartDivergesError:
            raise StartDivergesError(
                "the known model diverges on the training records, both with the given parameters "
                "and with values near them.\nGive parameters with which it is stable, a better "
                "rest state (State(rest=...)), or more steps in a sample (substeps=10)."
            ) from None

    def keep(self, job: Job, result: FitResult) -> Job:
        """The job that goes on from the best parameters."""
        model, error = result.model, result.history[result.chosen_iteration].train
        values = ", ".join(f"{name} {number(value)}" for name, value in physical(model).items())
        job.observer.say(
            f"known model: {values}; error {quantity(error, common_unit(model.outputs))} in "
            f"training, {quantity(result.seconds, 's')}"
        )
        return replace(job, models=[model])


def fitted_equations(job: Job, linear: LinearModel, train: Sequence[Record]) -> Job:
    """The job with a known model whose parameters are fitted to the given records."""
    dataset = replace(job.dataset, train=train, validation=[], selection=[])
    job = replace(job, dataset=dataset, linear=linear, observer=Observer())
    for stage in (FromEquations(), Parameters()):
        job = stage.run(job) if stage.when(job) else job
    return job


class Learned(Stage):
    """Learned parts beside a known model, drawn anew for each start."""

    def when(self, job: Job) -> bool:
        """Tell if there is a known model."""
        return job.settings.known is not None

    def run(self, job: Job) -> Job:
        """The known model with learned parts, one for each start, or the known model alone."""
        settings, model = job.settings, job.models[0]
        if not settings.learns:
            settings, models = replace(settings, starts=1, ridge=0.0), [model]
        else:
            settings = replace(settings, starts=_asked(settings))
            train = in_windows(job.dataset.train, settings.horizon)
            models = [with_learned(model, train, settings, seed) for seed in settings.seeds]
        for model in models:
            model.lfr.to(device=settings.device, dtype=settings.dtype)
        return replace(job, settings=settings, models=models, ridge=None)


def _asked(settings: Settings) -> int:
    """Number of starts that the settings ask for."""
    return _STARTS if settings.starts == "auto" else settings.starts


def _count(settings: Settings) -> int:
    """Number of starts of the fit of the parameters."""
    if not cast(Known, settings.known).parameters:
        return 1
    return _STARTS if settings.learns else _asked(settings)


def physical(model: Model) -> dict[str, float]:
    """The parameters of a known model by name, in their units; empty for any other model."""
    known = model.lfr.cell.map.known
    return {} if known is None else known.physical
