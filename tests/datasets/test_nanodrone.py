"""NanoDrone: files, kinds of flight, and sums over the horizon."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lfrtorch
from lfrtorch import InputError
from lfrtorch.cli.composition import composed
from lfrtorch.datasets import nanodrone
from lfrtorch.known_systems import nanodrone as equations
from lfrtorch.reporting.scores import table


def write(folder: Path, name: str, samples: int = 80, seed: int = 0) -> None:
    rng = np.random.default_rng(seed)
    u = 1750 + 100 * rng.standard_normal((samples, 4))
    u[0] = np.nan
    y = 0.1 * np.cumsum(rng.standard_normal((samples, 12)), axis=0)
    y[40:, 8] += 2 * np.pi  # a yaw that jumps
    np.savez(folder / f"{name}.npz", u=u, y=y, fs=100.0)


@pytest.fixture
def flights(tmp_path: Path) -> Path:
    folder = tmp_path / "nanodrone"
    folder.mkdir()
    for kind in ("chirp", "random", "square"):
        for run in (1, 2):
            write(folder, f"train_{kind}_run{run}", seed=run)
    return tmp_path


def test_flights_by_kind(flights: Path) -> None:
    data = nanodrone.load(root=flights)
    assert [r.name for r in data.train] == ["chirp_run1", "random_run1", "square_run1"]
    assert [r.name for r in data.validation] == ["chirp_run2", "random_run2", "square_run2"]
    assert data.tests == []
    assert "no flight of the test" in data.notes[0]
    record = data.train[0]
    assert record.start == "measured"
    assert (record.u.shape, record.y.shape, record.fs) == ((80, 4), (80, 12), 100.0)
    np.testing.assert_array_equal(record.u[0], record.u[1])
    assert np.abs(np.diff(record.y[:, 8])).max() < np.pi
    for run in (1, 2, 3):
        write(flights / "nanodrone", f"test_melon_run{run}", seed=run)
    tested = nanodrone.load(root=flights)
    assert tested.groups == {"melon": ("melon_run1", "melon_run2", "melon_run3")}
    assert tested.published[0].scores["melon position"] == 2.322


def test_files_of_the_release_say_the_same(flights: Path) -> None:
    """Their quaternions are the angles of the arrays."""
    expected = nanodrone.load(root=flights).train[0]
    released = flights / "release" / "nanodrone"
    for use, kinds in (("train", ("chirp", "random", "square")), ("test", ("melon",))):
        (released / use).mkdir(parents=True)
        for kind in kinds:
            for run in (1, 2):
                u, y = expected.u.copy(), expected.y
                u[0] = np.nan  # as in the release
                attitude = Rotation.from_euler("xyz", y[:, 6:9]).as_quat()
                t = 0.01 * np.arange(len(u))[:, None]
                acceleration = np.zeros((len(u), 3))
                columns = [t, y[:, :3], attitude, y[:, 3:6], y[:, 9:], u, acceleration]
                np.savetxt(
                    released / use / f"{kind}_20251017_run{run}.csv",
                    np.hstack(columns),
                    delimiter=",",
                    comments="",
                    header="t,x,y,z,qx,qy,qz,qw,vx,vy,vz,wx,wy,wz,m1_rads,m2_rads,m3_rads,m4_rads,"
                    "ax_body,ay_body,az_body",
                )
    data = nanodrone.load(root=flights / "release")
    assert data.groups == {"melon": ("melon_20251017_run1", "melon_20251017_run2")}
    record = data.train[0]
    assert record.fs == pytest.approx(100.0)
    np.testing.assert_allclose(record.u, expected.u)
    tilt = np.abs(expected.y[:, 7]).max()
    assert tilt < np.pi / 2, "the pitch of the test's flight is one that angles tell"
    np.testing.assert_allclose(np.exp(1j * record.y), np.exp(1j * expected.y), atol=1e-9)
    path = released / "train" / "chirp_20251017_run1.csv"
    path.write_text("t,x\n0,1\n1,2\n")
    with pytest.raises(InputError, match="holds no readable columns t, x, y, z, qx to qw"):
        nanodrone.load(root=flights / "release")


def test_a_kind_that_is_left_out_is_the_test(flights: Path) -> None:
    data = nanodrone.load(root=flights, left_out="random")
    assert {r.name.split("_")[0] for r in (*data.train, *data.validation)} == {"chirp", "square"}
    assert data.groups == {"random": ("random_run1", "random_run2")}
    assert data.published == ()


def test_what_is_wrong_with_files_is_said(flights: Path) -> None:
    with pytest.raises(InputError, match="left_out is 'melon'; give one of chirp"):
        nanodrone.load(root=flights, left_out="melon")
    with pytest.raises(FileNotFoundError, match="holds 2 flights chirp"):
        nanodrone.load(root=flights, validation=2)
    with pytest.raises(FileNotFoundError, match="holds 0 flights chirp"):
        nanodrone.load(root=flights / "elsewhere")
    path = flights / "nanodrone" / "train_chirp_run1.npz"
    np.savez(path, u=np.zeros((5, 3)), y=np.zeros((5, 12)), fs=100.0)
    with pytest.raises(InputError, match=r"u of shape \(5, 3\)"):
        nanodrone.load(root=flights)
    path.write_bytes(b"no archive")
    with pytest.raises(InputError, match="no readable arrays"):
        nanodrone.load(root=flights)


def test_errors_are_lengths_and_angles() -> None:
    y = np.zeros((1, 2, 12))
    y_hat = y.copy()
    y_hat[0, 0, :3] = [1.0, 2.0, 2.0]
    y_hat[0, 1, 6:9] = [0.0, 0.3, 0.0]
    assert nanodrone.MEASURES["position"](y_hat, y).tolist() == [[3.0, 0.0]]
    np.testing.assert_allclose(nanodrone.MEASURES["attitude"](y_hat, y), [[0.0, 0.3]])
    # Whole turns are no errors, and a model that diverges is not scored as well.
    y_hat[0, 1, 8] = 2 * np.pi
    np.testing.assert_allclose(nanodrone.MEASURES["attitude"](y_hat, y), [[0.0, 0.3]])
    y_hat[0, 0, 0] = np.inf
    assert nanodrone.MEASURES["attitude"](y_hat, y)[0, 0] == np.inf


def test_the_body_turns_as_rotations_do() -> None:
    """One sample of the equations beside the matrix exponential of the rates."""
    static = equations().map(4, [name for name, _ in nanodrone.OUTPUTS], 100.0)
    z = np.zeros(16)
    z[6:9], z[9:12], z[12:] = [0.3, -0.2, 0.5], [1.0, -2.0, 0.7], 1750.0
    w = static(static.p.new_tensor(z)).detach().numpy()
    rates = 0.5 * (z[9:12] + w[9:12])  # in the middle of the sample
    turned = Rotation.from_euler("xyz", z[6:9]) * Rotation.from_rotvec(0.01 * rates)
    assert (turned.inv() * Rotation.from_euler("xyz", w[6:9])).magnitude() < 2e-4
    thrust = static.physical["thrust"] * 4 * 1.75**2
    pull = Rotation.from_euler("xyz", z[6:9]).apply([0.0, 0.0, thrust]) - [0.0, 0.0, 9.81]
    np.testing.assert_allclose(w[3:6], 0.01 * pull, atol=1e-12)


def test_a_run_has_the_sums_of_the_kind_that_is_left_out(flights: Path) -> None:
    data = nanodrone.load(root=flights, left_out="random")
    short = lfrtorch.LevenbergMarquardt(max_iter=2)
    settings = lfrtorch.Settings(nx="auto", nz=1, nw=1, nn=2, starts=1, horizon=10, trainer=short)
    run = lfrtorch.identify(data, settings)
    score = run.metrics["scores"]["random"]
    y = [record.y for record in data.tests]
    moved = [
        np.linalg.norm((one[h:] - one[:-h])[:70, :3], axis=1) for one in y for h in range(1, 11)
    ]
    assert score["hold_position"] == pytest.approx(sum(each.mean() for each in moved) / 2)
    assert all(score[name] > 0 for name in nanodrone.MEASURES)
    assert score["records"] == 2
    shown = table(run.evaluation)
    assert "position" in shown.split("summed over the horizon")[1]
    assert shown.startswith("RMSE of predictions 10 samples ahead")


def test_attitude_errors_count_twice(flights: Path) -> None:
    (weight,) = {tuple(np.ravel(r.weight)) for r in nanodrone.load(root=flights).train}
    assert weight == (*6 * [1.0], *3 * [4.0], *3 * [1.0])


def test_the_benchmark_has_its_equations_and_horizon() -> None:
    cfg = composed("config", ["+bench=nanodrone"])
    assert cfg.horizon == nanodrone.HORIZON
    assert cfg.known._target_ == "lfrtorch.known_systems.nanodrone"
