"""Fits of models that are partly known: what is found, what is kept, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import lfrtorch
from lfrtorch import Dataset, InputError, Known, Parameter, Record, Settings, State
from lfrtorch.analysis import PhysicalParameters, canonical, physical_parameters, uncertainty
from lfrtorch.analysis.model_plots import static_figure
from lfrtorch.fitting.known_start import known_model, varied

FS, DAMPING, GRAVITY = 20.0, 0.3, 5.0


def pendulum(x: Any, u: Any, p: Any) -> Any:
    return x.speed, u[0] - p.damping * x.speed - p.gravity * torch.sin(x.angle)


def swing(x: Any, u: Any, p: Any) -> Any:
    return x.speed, u[0] - GRAVITY * torch.sin(x.angle)


def angle(x: Any, u: Any, p: Any) -> Any:
    return (x.angle,)


def known(**options: Any) -> Known:
    usual: dict[str, Any] = {
        "states": ["angle", State("speed", unit="rad/s")], "outputs": angle,
        "parameters": {
            "damping": Parameter(0.1, low=0.0, unit="1/s"), "gravity": Parameter(8.0, unit="1/s²"),
        },
        "sees": ["speed"], "acts_on": ["speed"],
    }  # fmt: skip
    return Known(pendulum, **{**usual, **options})


def record(drag: float, samples: int = 400, seed: int = 0, noise: float = 1e-3) -> Record:
    """A pendulum with a drag that its equations do not have."""
    rng = np.random.default_rng(seed)
    u = np.repeat(1.5 * rng.standard_normal(samples // 8), 8)
    x, y = np.zeros(2), []
    for force in u:
        y.append(x[0])
        for _ in range(20):
            rate = force - DAMPING * x[1] - drag * x[1] * abs(x[1]) - GRAVITY * np.sin(x[0])
            x = x + np.array([x[1], rate]) / (20 * FS)
    return Record(u, np.array(y) + noise * rng.standard_normal(len(u)), fs=FS)


def identified(train: Record, **settings: Any) -> lfrtorch.Run:
    usual: dict[str, Any] = {"known": known(), "starts": 2}
    dataset = Dataset("pendulum", [train], [], [])
    return lfrtorch.identify(dataset, Settings(**{**usual, **settings}))


@pytest.fixture(scope="module")
def grey() -> lfrtorch.Run:
    return identified(record(drag=0.0), nn=0)


@pytest.fixture(scope="module")
def both() -> lfrtorch.Run:
    return identified(record(drag=0.3), nz=1, nw=1, nn=4, ridge=1e-2)


def test_a_grey_box_finds_its_parameters_within_their_errors(grey: lfrtorch.Run):
    found = grey.parameters
    assert found is not None
    assert found.names == ("damping", "gravity")
    assert found.units == ("1/s", "1/s²")
    # The integration of the record, by Euler, is 1 % off.
    np.testing.assert_allclose(found.values, [DAMPING, GRAVITY], atol=0.06)
    assert np.all((found.errors > 0) & (found.errors < 0.05))
    assert found.notes == ()
    assert grey.model.parameter_count == 2
    assert grey.metrics["known"]["values"]["gravity"]["unit"] == "1/s²"
    assert "gravity" in str(grey)


def test_standard_errors_are_those_over_many_noises():
    found = [identified(record(0.0, seed=7, noise=0.0), nn=0)]
    exact = found[0].model
    rng, rec = np.random.default_rng(1), record(0.0, seed=7, noise=0.0)
    values, told = [], []
    for _ in range(12):
        noisy = Record(rec.u, exact.simulate(rec) + 0.01 * rng.standard_normal(rec.y.shape), fs=FS)
        run = identified(noisy, nn=0, starts=1)
        assert run.parameters is not None
        values.append(run.parameters.values)
        told.append(run.parameters.errors)
    ratio = np.std(values, axis=0, ddof=1) / np.mean(told, axis=0)
    assert np.all((ratio > 0.5) & (ratio < 1.9))  # 99 % of 12 are within 0.49 and 1.56


def test_what_is_learned_sees_and_acts_where_it_may(both: lfrtorch.Run):
    cell, own = both.model.lfr.cell, 3
    assert (cell.nx, cell.nz, cell.nw) == (2, own + 1, own + 1)
    assert cell.Cz[own, 0] == 0 and cell.Cz[own, 1] != 0  # noqa: PT018
    assert cell.Dzu[own, 0] == 0
    assert cell.Bw[0, own] == 0 and cell.Bw[1, own] != 0  # noqa: PT018
    assert cell.Dyw[0, own] == 0
    torch.testing.assert_close(cell.Cz[:2], torch.eye(2, dtype=torch.float64))


def test_a_learned_part_finds_what_the_equations_do_not_have(both: lfrtorch.Run):
    train, other = record(drag=0.3), record(drag=0.3, seed=5)
    alone = identified(train, nn=0)
    errors = [lfrtorch.rmse(other, run.model.simulate(other)) for run in (both, alone)]
    assert errors[0] < 0.25 * errors[1]


def test_bounds_hold_and_are_told():
    bounded = known(parameters={"damping": Parameter(0.6, low=0.5), "gravity": GRAVITY})
    run = identified(record(drag=0.0), known=bounded, nn=0)
    assert run.parameters is not None
    assert run.parameters.values[0] == pytest.approx(0.5)
    assert any("at a bound" in note and "damping" in note for note in run.parameters.notes)


def test_a_learned_part_that_says_the_same_is_noted():
    run = identified(record(drag=0.0), nz=1, nw=1, nn=4, starts=1)
    assert run.parameters is not None
    assert any("can take the place of damping" in note for note in run.parameters.notes)


@pytest.mark.parametrize("settings", [{"nx": 1, "nz": 2, "nw": 1, "nn": 3}, {"nn": 0}])
def test_a_checkpoint_holds_the_equations(settings: dict[str, Any], tmp_path: Path):
    train = record(drag=0.0)
    model = identified(train, starts=1, **settings).model
    model.save(tmp_path / "model")
    again = lfrtorch.load(tmp_path / "model")
    np.testing.assert_array_equal(again.simulate(train), model.simulate(train))
    assert again.lfr.cell.held.keys() == model.lfr.cell.held.keys()
    np.testing.assert_array_equal(again.lfr.cell.map.known.bounds[0], [0.0, np.inf])
    found = physical_parameters(again, train)
    assert isinstance(found, PhysicalParameters)


@pytest.mark.parametrize(
    "settings",
    [
        {"nz": 1, "nw": 1, "nn": 3, "horizon": 100},
        {"nx": 1, "nz": 2, "nw": 1, "static": "polynomial", "degree": 2},
        {"nz": 1, "nw": 1, "nn": 3, "trainer": lfrtorch.Adam(max_iter=3)},
        {"nn": 0, "dtype": torch.float32},
        {"nx": 1, "nz": 1, "nw": 1, "nn": 3, "dtype": torch.float32},
        {
            "known": Known(swing, states=["angle", "speed"], outputs=angle),
            "nz": 1,
            "nw": 1,
            "nn": 3,
        },
        {"known": known(method="euler", substeps=5), "nn": 0},
        {"known": known(intersample="bl"), "nn": 0},
    ],
    ids=["windows", "polynomial", "adam", "float32", "learned", "no parameters", "euler", "bl"],
)
def test_other_features_work_with_it(settings: dict[str, Any]):
    train = record(drag=0.1)
    run = identified(train, starts=1, **settings)
    assert lfrtorch.rmse(train, run.model.simulate(train)) < 0.3 * np.std(train.y)


def test_it_is_printed_with_its_parameters(both: lfrtorch.Run, grey: lfrtorch.Run):
    assert "2 known states, nx=0" in repr(both.model)
    assert "KnownModel(angle, speed; damping=" in str(both.model)
    assert "beside it   Network(nz=1, nw=1, nn=4" in str(both.model)
    assert "linear part" not in str(grey.model)


def test_a_figure_of_the_map_is_of_what_is_learned(both: lfrtorch.Run, grey: lfrtorch.Run):
    titles = [ax.get_title() for ax in static_figure(both.model, record(drag=0.3)).axes]
    assert [title[:3] for title in titles if title] == ["w1:"]
    assert len([ax for ax in static_figure(grey.model).axes if ax.get_title()]) == 3


def test_it_is_refitted_with_validation_and_has_bands_and_a_canonical_form(both: lfrtorch.Run):
    train, held_out = record(0.3), record(0.3, seed=3)
    dataset = Dataset("pendulum", [train], [held_out], [])
    run = lfrtorch.identify(
        dataset, Settings(known=known(), nz=1, nw=1, nn=3, starts=1, refit=True)
    )
    assert run.refit is not None
    assert np.isfinite(uncertainty(both.model, train).simulate(train).y).all()
    form = canonical(both.model, train).model
    difference = form.simulate(train) - both.model.simulate(train)
    assert np.abs(difference).max() < 1e-8


def test_sizes_that_are_auto_are_those_of_what_it_sees_and_acts_on():
    settings = Settings(known=known(), nx="auto", nz="auto", nw="auto", nn="auto")
    assert (settings.nx, settings.nz, settings.nw, settings.nn) == (0, 1, 1, 0)
    everything = known(sees=None, acts_on=None)
    settings = Settings(known=everything, nx=1, nz="auto", nw="auto", nn=3)
    assert (settings.nx, settings.nz, settings.nw, settings.nn) == (1, 4, 3, 3)


def test_starts_vary_within_the_bounds():
    train = record(drag=0.0)
    narrow = {"damping": Parameter(0.3, low=0.25, high=0.35), "gravity": Parameter(0.0, scale=2.0)}
    linear = lfrtorch.estimate_bla(train, nx=2)
    model = known_model(known(parameters=narrow), linear, [train])
    for seed in range(5):
        values = varied(model, seed).lfr.cell.map.known.physical
        assert 0.25 - 1e-9 <= values["damping"] <= 0.35 + 1e-9
        assert values["gravity"] != 0.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Parameter(1.0, low=2.0), "value 1.0 and bounds 2.0, inf"),
        (lambda: Parameter(float("nan")), "value is nan; give a finite number"),
        (lambda: State("a", scale=-1.0), "scale"),
        (lambda: known(states=[]), "states is empty"),
        (lambda: known(states=["a b"]), "a state or a parameter has an invalid name"),
        (lambda: known(method="bdf"), "method"),
        (lambda: known(method="discrete", substeps=2), "substeps=1 with 'discrete'"),
        (lambda: known(method="discrete", intersample="bl"), "nothing between samples"),
        (lambda: known(sees=["position"]), "give some of angle, speed, u"),
        (lambda: known(acts_on=[]), "give some of angle, speed, y"),
        (lambda: known(outputs=None).equations(1, ["a", "b", "c"]), "has 2 state"),
        (
            lambda: Known(lambda x, u, p: (x.a,), states=["a", "b"]).equations(1, ["y"]),
            "returns 1 values; give 2",
        ),
        (
            lambda: Known(lambda x, u, p: (u * x.a,), states=["a"]).equations(1, ["y"]),
            r"it uses \(<a number>,\), which is not a single number",
        ),
        (
            lambda: Known(lambda x, u, p: torch.cat([x.a, x.a]), states=["a"]).equations(1, ["y"]),
            "it calls cat with a list; use single numbers",
        ),
        (
            lambda: Known(lambda x, u, p: (x.b,), states=["a"]).equations(1, ["y"]),
            "f of the known model fails: .*has no attribute 'b'",
        ),
        (
            lambda: Known(lambda x, u, p: (x.a if x.a > 0 else 0,), states=["a"]).equations(
                1, ["y"]
            ),
            "it branches in Python on a value; use torch.where",
        ),
    ],
)
def test_what_cannot_be_is_refused(make: Any, message: str):
    with pytest.raises(InputError, match=message):
        make()


def driven(*outputs: str, states: tuple[str, ...] = ("current", "speed")) -> list[str]:
    """The states of a motor that outputs of these names are, as a figure of each tells."""
    known = Known(lambda x, u, p: [0.0 * u[0]] * len(x), states=[*states], method="discrete")
    static = known.map(1, outputs, 1.0)
    z = torch.arange(float(len(states) + 1), dtype=torch.float64)
    return [states[int(i)] for i in static(z)[len(states) :]]


def test_outputs_are_the_states_of_their_names_and_others_those_that_are_left():
    assert driven("speed") == ["speed"]
    assert driven("speed", "current") == ["speed", "current"]
    assert driven("speed", "i") == ["speed", "current"]
    assert driven("y1", "y2") == ["current", "speed"]
    assert driven("y", states=("level",)) == ["level"]
    with pytest.raises(
        InputError, match=r"2 state\(s\), current, speed, .* 1 output\(s\), y;\s+name"
    ):
        driven("y")
    with pytest.raises(InputError, match="outputs=, a function"):
        driven("speed", "y", states=("a", "b", "speed"))


def test_a_fit_takes_the_state_that_the_output_is_called_after():
    def lags(x: Any, u: Any, p: Any) -> Any:
        return 0.5 * x.current + u[0], p.stays * x.speed + 0.1 * x.current

    u, x, y = np.random.default_rng(0).standard_normal(200), np.zeros(2), []
    for value in u:
        y.append(x[1])
        x = np.array([0.5 * x[0] + value, 0.9 * x[1] + 0.1 * x[0]])
    motor = Known(lags, states=["current", "speed"], parameters={"stays": 0.7}, method="discrete")
    train = Record(u, np.array(y), outputs=(lfrtorch.Channel("speed"),))
    run = identified(train, known=motor, nn=0, starts=1)
    assert run.parameters is not None
    assert run.parameters.values == pytest.approx([0.9], abs=1e-6)


def test_a_parameter_that_does_not_matter_has_no_error():
    idle = Known(lambda x, u, p: (u[0] - x.a,), states=["a"], parameters={"k": 5.0})
    run = identified(record(0.0), known=idle, nn=0)
    assert run.parameters is not None
    assert run.parameters.values.tolist() == [5.0]
    assert any("tell 0 of 1 directions" in note for note in run.parameters.notes)


def test_a_slope_that_is_not_finite_is_told_with_its_place():
    """A tank that is empty at first: the root has a value there, and no derivative."""
    u, h, y = np.abs(np.random.default_rng(0).standard_normal(100)), 0.0, []
    for value in u:
        y.append(h)
        h = max(h + 0.3 * value - 0.4 * np.sqrt(h), 0.0)
    tank = Known(
        lambda x, u, p: (x.h + 0.3 * u[0] - p.out * torch.sqrt(torch.relu(x.h)),),
        states=["h"], parameters={"out": 0.3}, method="discrete",
    )  # fmt: skip
    run = identified(Record(u, np.array(y), name="filling"), known=tank, starts=1, nn=0)
    told = "the next h is not finite in sample 0 of record 'filling', by h, which is 0; keep roots"
    assert run.fit.reason == lfrtorch.Reason.JACOBIAN_VANISHES
    assert told in run.fit.outcome
    assert run.parameters is not None
    assert told in run.parameters.notes[0]


def test_equations_that_run_away_are_refused_with_what_may_help():
    stiff = Known(lambda x, u, p: (u[0] - p.k * x.a,), states=["a"], parameters={"k": 500.0})
    with pytest.raises(InputError, match=r"the known model diverges .*\n.*substeps=10"):
        identified(record(0.0), known=stiff, nn=0)


def test_another_thing_than_known_equations_is_refused():
    with pytest.raises(InputError, match=r"known is .pendulum.; give an lfrtorch\.Known"):
        identified(record(0.0), known="pendulum")


@pytest.mark.parametrize(
    "searched",
    [
        {"nz": 1, "nw": 1, "nn": 4, "ridge": "auto"},
        {"nz": 1, "nw": 1, "static": "polynomial", "degree": "auto"},
    ],
    ids=str,
)
@pytest.mark.usefixtures("short_paths")
def test_what_is_learned_beside_equations_is_searched(grey: lfrtorch.Run, searched: dict[str, Any]):
    """The equations are fitted again without each stretch that judges."""
    run = identified(record(drag=0.3), **searched)
    assert run.choice is not None
    assert run.choice.chosen.ratio < 0.5  # of the linear model's error where it was left out
    assert run.settings.searched == ()
    assert run.settings.nx == 0
    test = record(drag=0.3, seed=1)
    errors = [lfrtorch.rmse(test, model.simulate(test)) for model in (run.model, grey.model)]
    assert errors[0] < 0.5 * errors[1]
    assert all(c.sizes["nx"] == 2 for c in run.choice.candidates)


def test_a_ridge_of_nothing_that_is_learned_is_none():
    assert Settings(known=known(), nn=0, ridge="auto").ridge == 0.0


def test_a_ridge_tells_apart_what_the_data_do_not(both: lfrtorch.Run):
    train = record(drag=0.3)
    free, kept = physical_parameters(both.model, train), both.parameters
    assert kept is not None
    assert np.all(kept.errors <= 1.001 * free.errors)
    tight = physical_parameters(both.model, train, ridge=1e9)
    assert np.all(tight.errors < 1e-3 * free.errors)
