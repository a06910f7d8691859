"""Saved and loaded to the same bits; everything else is refused with nothing lost."""

import contextlib
import itertools
import json
import os
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from reference import measure, normal, random_cell, random_model
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

import lfrtorch
from lfrtorch._support import checkpoint
from lfrtorch.data.records import Channel
from lfrtorch.maps.network import Network
from lfrtorch.maps.polynomial import Polynomial
from lfrtorch.model.loading import load
from lfrtorch.model.model import Model

U = np.random.default_rng(0).normal(size=(50, 2))


class Cubic(nn.Module):
    def __init__(self):
        super().__init__()
        self.c = nn.Parameter(torch.zeros(1, 2))

    def forward(self, z: Tensor) -> Tensor:
        return z.tanh() ** 3 @ self.c.mT


class Halved(Network):
    """A user's own class that begins with the package's."""

    def forward(self, z: Tensor) -> Tensor:
        return 0.5 * super().forward(z)


def small(**options) -> Model:
    return random_model(random_cell(2, 2, 3, 2, 1, 4, **options), fs=1 / 3)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    return small().save(tmp_path / "saved")


def edit(folder: Path, **changes):
    """Change entries of the description; ``None`` takes one out."""
    description = json.loads((folder / "model.json").read_text()) | changes
    kept = {key: value for key, value in description.items() if value is not None}
    (folder / "model.json").write_text(json.dumps(kept))


def refused(folder: Path, message: str):
    with pytest.raises(ValueError, match=re.escape(message)) as refusal:
        load(folder)
    assert folder.name in str(refusal.value)


# --- there and back -------------------------------------------------------------------------


@pytest.mark.numeric
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("kind", ["tanh", "relu", "polynomial", "linear"])
def test_the_same_bits_come_back(tmp_path: Path, kind: str, dtype: torch.dtype):
    if kind == "linear":
        model = random_model(random_cell(2, 2, 3, 0, 0, dtype=dtype))
    elif kind == "polynomial":
        model = small(static=Polynomial(2, 1, 3), dtype=dtype)
        model.lfr.cell.get_parameter("static.C").detach().mul_(0.1)
    else:
        model = small(activation=kind, dtype=dtype)
    back = load(model.save(tmp_path / "saved"))
    assert repr(back.lfr) == repr(model.lfr)
    mine, other = model.lfr.state_dict(), back.lfr.state_dict()
    assert mine.keys() == other.keys()
    assert all(torch.equal(mine[name], other[name]) for name in mine)
    assert {p.dtype for p in back.lfr.parameters()} == {dtype}
    for name in ("u_offset", "u_scale", "y_offset", "y_scale"):
        assert np.array_equal(getattr(model.scaler, name), getattr(back.scaler, name))
    assert (back.fs, back.inputs, back.outputs) == (model.fs, model.inputs, model.outputs)
    assert isinstance(back.outputs[0], Channel)
    for start in ("zero", "periodic"):
        assert np.array_equal(model.simulate(U, start=start), back.simulate(U, start=start))
    assert np.isfinite(model.simulate(U)).all()
    assert (back.lfr.cell.static is None) == (kind == "linear")


def test_the_folder_of_a_run_and_a_string_will_do(tmp_path: Path):
    model = small()
    model.save(tmp_path / "run" / "model")
    assert np.array_equal(load(tmp_path / "run").simulate(U), model.simulate(U))
    model.save(str(tmp_path / "saved"))
    assert np.array_equal(load(str(tmp_path / "saved")).simulate(U), model.simulate(U))


# --- a user's own static map ----------------------------------------------------------------


def test_own_map_is_filled_with_the_saved_weights(tmp_path: Path):
    model = small(static=Cubic())
    folder = model.save(tmp_path / "saved")
    for static in (Cubic().double(), Cubic()):  # built in torch's single precision
        assert np.array_equal(load(folder, static=static).simulate(U), model.simulate(U))


def test_own_map_is_asked_for_and_must_fit(tmp_path: Path):
    folder = small(static=Cubic()).save(tmp_path / "saved")
    refused(folder, "class Cubic, which is not part of this package; pass an instance of it: load(")
    with pytest.raises(ValueError, match="its description and weights do not fit"):
        load(folder, static=nn.Linear(2, 1))


def test_own_class_derived_from_the_network_is_not_the_network(tmp_path: Path):
    model = small(static=Halved(2, 1, 4))
    folder = model.save(tmp_path / "saved")
    refused(folder, "class Halved, which is not part of this package")
    back = load(folder, static=Halved(2, 1, 4, dtype=torch.float64))
    assert np.array_equal(back.simulate(U), model.simulate(U))


def test_own_class_that_is_called_like_the_network(tmp_path: Path):
    own = type("Network", (Cubic,), {})
    model = small(static=own())
    back = load(model.save(tmp_path / "saved"), static=own().double())
    assert np.array_equal(back.simulate(U), model.simulate(U))


# --- refusals of load -----------------------------------------------------------------------


def test_no_checkpoint(tmp_path: Path):
    refused(tmp_path / "nowhere", "nowhere'; give the folder of a run")
    with pytest.raises(ValueError, match=r"is not a path \(File name too long\)"):
        load("n" * 400)
    refused(tmp_path, "is not a checkpoint")


DAMAGED = b"", b'{"format": "lfrt', b"\xff\xfe\x00", b"{]", b"[" * 100_000, b"9" * 5000
OTHERS = b"[]", b"null", b"{}", b'{"format": "other", "version": 1}'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        *((text, "is damaged") for text in DAMAGED),
        *((text, "was not written by lfrtorch") for text in OTHERS),
    ],
)
def test_damaged_description_and_that_of_another_program(saved: Path, text: bytes, message: str):
    (saved / "model.json").write_bytes(text)
    refused(saved, message)


def test_newer_version_and_none(saved: Path):
    edit(saved, version=checkpoint.VERSION + 1)
    refused(saved, f"has checkpoint version {checkpoint.VERSION + 1} and this program reads up to")
    edit(saved, version=None)
    refused(saved, "is damaged (version None)")


@pytest.mark.parametrize("entry", ["sizes", "static", "dtype", "fs", "inputs", "outputs"])
def test_description_that_lacks_an_entry(saved: Path, entry: str):
    edit(saved, **{entry: None})
    refused(saved, "is damaged")


@pytest.mark.parametrize(
    "change",
    [
        {"sizes": {"nu": 2, "ny": 2, "nx": 4, "nz": 2, "nw": 1}},
        {"sizes": {"nu": 2, "ny": 2, "nx": "3", "nz": 2, "nw": 1}},
        {"sizes": {"nu": 2}},
        {"static": {"type": "Network", "nn": 5, "activation": "tanh"}},
        {"static": {"type": "Network"}},
        {"static": {"type": "Polynomial"}},
        {"static": {"type": "Polynomial", "degree": 3}},
        {"static": {"type": "Polynomial", "degree": 0}},
        {"dtype": "float65"},
        {"fs": []},
        {"inputs": [{"label": "u"}]},
        {"inputs": [{"name": "u1", "unit": ""}]},
        {"inputs": [{"name": name, "unit": ""} for name in (1, 2)]},
        {"sizes": {"nu": 2, "ny": 2, "nx": 10**6, "nz": 2, "nw": 1}},
        {"outputs": [{"name": f"y{i}", "unit": ""} for i in range(3)]},
        {"dtype": "load"},
        {"dtype": "int64"},
        {"fs": 0.0},
        {"fs": float("nan")},
    ],
)
def test_description_that_does_not_fit_the_weights(saved: Path, change: dict):
    edit(saved, **change)
    refused(saved, "its description and weights do not fit")


def test_one_layer_of_before_is_read_and_several_are_refused(saved: Path):
    network = {"type": "Network", "nn": 4, "activation": "tanh"}
    edit(saved, static=network | {"layers": 1})
    assert np.array_equal(load(saved).simulate(U), small().simulate(U))
    edit(saved, static={"type": "Beyond", "base": network | {"layers": 3}})
    refused(saved, "a network of 3 hidden layers, and this version has networks of one")
    refused(saved, "before 2026-11-25 (commit 84a9d8a) read it")


@pytest.mark.numeric
def test_a_map_less_a_linear_one_of_before_is_read_as_the_map(tmp_path: Path):
    """w = W (f(Z z) - L Z z), f of the same kind once more, as canonical forms were written."""
    model = small()
    record = measure(model, 60)
    model = model.reaching(record)
    assert model.reach is not None
    folder = model.save(tmp_path / "saved")
    weights = load_file(folder / "weights.safetensors")
    own = json.loads((folder / "model.json").read_text())["static"]
    for seed in range(2):
        L, Z, W = (0.5 * normal(*shape, seed=seed) for shape in ((1, 2), (2, 2), (1, 1)))
        for into, of_x, of_u in (("Bw", "A", "Bu"), ("Dyw", "Cy", "Dyu")):
            weights[of_x] = weights[of_x] + weights[into] @ L @ weights["Cz"]
            weights[of_u] = weights[of_u] + weights[into] @ L @ weights["Dzu"]
            weights[into] = weights[into] @ W.inverse()
        for name in ("Cz", "Dzu", "reach.middle"):
            weights[name] = Z.inverse() @ weights[name]
        weights["reach.axes"] = weights["reach.axes"] @ Z
        weights = {re.sub(r"^static\.", "static.base.", name): w for name, w in weights.items()}
        weights |= {"static.slope": L, "static.into": Z, "static.out": W}
        own = {"type": "Beyond", "base": own}
    edit(folder, static=own)
    save_file({name: w.contiguous() for name, w in weights.items()}, folder / "weights.safetensors")
    again = load(folder)
    np.testing.assert_allclose(again.simulate(record), record.y, rtol=0, atol=1e-9)
    assert isinstance(again.lfr.cell.static, Network)
    assert again.reach is not None
    np.testing.assert_allclose(again.reach.z.middle, model.reach.z.middle, atol=1e-9)
    np.testing.assert_allclose(again.reach.z.axes, model.reach.z.axes, atol=1e-9)


@pytest.mark.parametrize("kept", [0, 4, 0.5, 0.99])
def test_truncated_weights(saved: Path, kept: float):
    file = saved / "weights.safetensors"
    whole = file.read_bytes()
    file.write_bytes(whole[: int(kept if kept > 1 else kept * len(whole))])
    refused(saved, "is damaged or missing")
    file.unlink()
    refused(saved, "is damaged or missing")


@pytest.mark.parametrize("at", [-1, -100, -500])
def test_weights_that_are_not_those_that_were_saved(saved: Path, at: int):
    """A flipped bit of a number is a number: the digest tells."""
    file = saved / "weights.safetensors"
    content = bytearray(file.read_bytes())
    content[at] ^= 1
    file.write_bytes(content)
    refused(saved, "its numbers are not those that were written")


def test_weights_of_before_have_no_digest(saved: Path):
    file = saved / "weights.safetensors"
    save_file(load_file(file), file)
    assert np.array_equal(load(saved).simulate(U), small().simulate(U))


def test_the_covariance_of_the_states_comes_back_and_was_1_before(tmp_path: Path):
    model = small()
    P = model.state_covariance + 0.5
    model.lfr.cell.state_covariance.copy_(torch.tensor(P))
    folder = model.save(tmp_path / "saved")
    assert np.array_equal(load(folder).state_covariance, P)
    file = folder / "weights.safetensors"
    save_file({k: t for k, t in load_file(file).items() if k != "state_covariance"}, file)
    assert np.array_equal(load(folder).state_covariance, P - 0.5)


@pytest.mark.parametrize("name", ["model.json", "weights.safetensors"])
def test_a_file_that_no_memory_holds(saved: Path, name: str):
    os.truncate(saved / name, 10**13)
    refused(saved, "it takes 10 TB of memory")


def test_scales_of_another_model(saved: Path):
    for sizes in ((1, 2), (2, 1)):
        other = random_model(random_cell(*sizes, 3, 2, 1, 4)).save(saved.with_name("other"))
        mixed = load_file(saved / "weights.safetensors")
        scales = load_file(other / "weights.safetensors").items()
        mixed |= {name: scale for name, scale in scales if name.startswith("scaler.")}
        save_file(mixed, saved / "weights.safetensors")
        refused(saved, "offsets of shape")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("A", float("nan"), "A have numbers that are not finite"),
        ("scaler.y_scale", float("inf"), "scaler.y_scale have numbers that are not finite"),
        ("scaler.u_scale", 0.0, "a scale is not positive"),
        ("scaler.u_scale", 1e-320, "a scale is not positive"),
        ("scaler.y_scale", -1.0, "a scale is not positive"),
    ],
)
def test_weights_that_make_no_model(saved: Path, name: str, value: float, message: str):
    weights = load_file(saved / "weights.safetensors")
    weights[name] = torch.full_like(weights[name], value)
    save_file(weights, saved / "weights.safetensors")
    refused(saved, message)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_weights_that_are_no_file_are_not_waited_for(saved: Path):
    (saved / "weights.safetensors").unlink()
    os.mkfifo(saved / "weights.safetensors")
    refused(saved, "is damaged or missing (it is not a file)")


# --- code is never run ----------------------------------------------------------------------


class Trap:
    """Makes a folder when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.mkdir, (self.path,)


@pytest.fixture
def trap(tmp_path: Path) -> Path:
    """Files that run code when they are unpickled: trap.pkl and the zip archive trap.pt."""
    folder = tmp_path / "traps"
    folder.mkdir()
    sprung = folder / "sprung"
    (folder / "trap.pkl").write_bytes(pickle.dumps(Trap(sprung)))
    torch.save(Trap(sprung), folder / "trap.pt")
    with pytest.raises(FileNotFoundError):  # so the trap works, where its folder is
        pickle.loads(pickle.dumps(Trap(sprung / "deeper")))
    return sprung


@pytest.mark.parametrize("name", ["trap.pkl", "trap.pt"])
def test_pickle_is_never_opened(trap: Path, saved: Path, name: str):
    """As the checkpoint, in a folder that is none, in the place of the weights, and beside them."""
    pickled, folder = trap.with_name(name), "is a file, and a checkpoint is a folder"
    refused(pickled, "carry code and are never opened")
    with pytest.raises(ValueError, match=folder):
        lfrtorch.LinearModel.load(pickled)
    refused(trap.parent, "is not a checkpoint: no model.json in it or in its model/ or linear/ fo")
    refused(trap.parent, "trap.pkl, trap.pt may carry code and is never opened")
    weights = saved / "weights.safetensors"
    whole = weights.read_bytes()
    weights.write_bytes(pickled.read_bytes())
    refused(saved, "is damaged or missing")
    weights.write_bytes(whole)
    pickled.rename(saved / name)
    refused(saved, f"holds {name} beside the model: a checkpoint carries no code")
    with pytest.raises(ValueError, match=folder):
        load(saved / "model.json")
    assert not trap.exists()


# --- the two models of a run ----------------------------------------------------------------


@pytest.mark.numeric
def test_each_kind_of_model_is_found_in_a_run(tmp_path: Path):
    model, run = random_model(random_cell(2, 1, 3, 0, 0)), tmp_path / "run"
    linear = lfrtorch.LinearModel(
        *(getattr(model.lfr.cell, name).detach().numpy() for name in ("A", "Bu", "Cy", "Dyu")),
        fs=1.0, u_offset=np.zeros(2), y_offset=np.zeros(1),
        inputs=model.inputs, outputs=model.outputs,
    )  # fmt: skip
    linear.save(run / "linear")
    assert np.array_equal(load(run).simulate(U), linear.simulate(U))
    model.save(run / "model")
    assert np.array_equal(lfrtorch.LinearModel.load(run).simulate(U), linear.simulate(U))
    assert np.array_equal(load(run).simulate(U), model.simulate(U))
    assert np.array_equal(linear.to_model().simulate(U), linear.simulate(U))


# --- refusals of save -----------------------------------------------------------------------


def test_foreign_folder_and_file_are_left_alone(tmp_path: Path):
    (tmp_path / "thesis.txt").write_text("three years")
    for path in (tmp_path, tmp_path / "thesis.txt"):
        with pytest.raises(ValueError, match="exists and is not a checkpoint; choose another fold"):
            small().save(path)
        assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]
        assert (tmp_path / "thesis.txt").read_text() == "three years"


def test_empty_folder_is_taken(tmp_path: Path):
    (tmp_path / "saved").mkdir()
    assert np.array_equal(load(small().save(tmp_path / "saved")).simulate(U), small().simulate(U))


def test_other_weights_of_the_same_model_replace_one_file(saved: Path):
    files = saved / "model.json", saved / "weights.safetensors"
    before, newer = [file.stat().st_ino for file in files], small(seed=1)
    newer.save(saved)
    after = [file.stat().st_ino for file in files]
    assert after[0] == before[0]  # so that at no moment there is none
    assert after[1] != before[1]
    assert np.array_equal(load(saved).simulate(U), newer.simulate(U))
    assert [p.name for p in saved.parent.iterdir()] == ["saved"]
    assert sorted(p.name for p in saved.iterdir()) == ["model.json", "weights.safetensors"]


def test_another_model_replaces_both_files_and_no_other(saved: Path):
    (saved / "notes.txt").write_text("three years")
    newer = random_model(random_cell(2, 2, 2))
    newer.save(saved)
    assert np.array_equal(load(saved).simulate(U), newer.simulate(U))
    names = sorted(p.name for p in saved.iterdir())
    assert names == ["model.json", "notes.txt", "weights.safetensors"]
    assert [p.name for p in saved.parent.iterdir()] == ["saved"]


def test_a_checkpoint_is_readable_wherever_a_save_stops(tmp_path, monkeypatch):
    """Power fails after each of the renames; then a third model is saved, and power fails again."""
    models = [small(), random_model(random_cell(2, 2, 2)), small(activation="relu")]
    whole = [model.simulate(U) for model in models]
    rename, left = os.replace, 0

    def failing(source: Path, target: Path) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise KeyboardInterrupt
        rename(source, target)

    def saved_until(model: Model, renames: int) -> None:
        nonlocal left
        left = renames
        with contextlib.suppress(KeyboardInterrupt):
            model.save(folder)

    monkeypatch.setattr(os, "replace", failing)
    for first, second in itertools.product(range(5), (1, 2, 3)):
        folder = tmp_path / f"{first}{second}"
        saved_until(models[0], 1)
        for model, renames in zip(models[1:], (first, second), strict=True):
            saved_until(model, renames)
            assert any(np.array_equal(load(folder).simulate(U), y) for y in whole)
        saved_until(models[1], 9)
        assert np.array_equal(load(folder).simulate(U), whole[1])
        assert sorted(p.name for p in folder.iterdir()) == ["model.json", "weights.safetensors"]


def test_link_to_a_checkpoint_is_replaced(saved: Path):
    link = saved.with_name("latest")
    link.symlink_to(saved)
    newer = small(seed=1)
    newer.save(link)
    assert np.array_equal(load(link).simulate(U), newer.simulate(U))
    assert sorted(p.name for p in saved.parent.iterdir()) == ["latest", "saved"]


def test_save_that_fails_keeps_the_old_checkpoint(saved: Path, monkeypatch: pytest.MonkeyPatch):
    def full(*_, **__):
        raise OSError("no space left on device")

    monkeypatch.setattr(checkpoint, "save_file", full)
    with pytest.raises(OSError, match="no space left"):
        small(seed=1).save(saved)
    assert np.array_equal(load(saved).simulate(U), small().simulate(U))
    assert [p.name for p in saved.parent.iterdir()] == ["saved"]
