"""The TensorBoard events and the checkpoints of a fit."""

import io
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from tensorboard.summary.writer import event_file_writer

import lfrtorch
from lfrtorch.data.records import Channel, Record
from lfrtorch.fitting.trainer import Progress, RestartSummary, Round
from lfrtorch.reporting.monitor import Checkpoint, TensorBoard

U = np.random.default_rng(0).standard_normal(100)
RECORD = Record(U, np.tanh(U), 10.0, outputs=(Channel("y", "m"),))


@pytest.fixture(scope="module")
def model() -> lfrtorch.Model:
    bla = lfrtorch.estimate_bla(RECORD, nx=1)
    return lfrtorch.initialise(bla, RECORD, nz=1, nw=1, nn=2)


def step(iteration: int, **report: float) -> Progress:
    return Progress(iteration, 40, 1.5e-3, 2.5e-3, 2.0 * iteration, iteration == 4, report, 1.0)


def events(folder: Path) -> EventAccumulator:
    """What TensorBoard would show of a folder."""
    found = EventAccumulator(str(folder))
    found.Reload()
    return found


def test_tensorboard_without_a_record_has_scalars_alone(model: lfrtorch.Model, tmp_path: Path):
    board = TensorBoard(tmp_path)
    board(model, step(0))
    board.close()
    assert "rmse/train" in events(tmp_path).Tags()["scalars"]
    assert not events(tmp_path).Tags()["images"]


@pytest.mark.numeric
@pytest.mark.usefixtures("coarse")
def test_tensorboard_holds_scalars_figures_and_texts(model: lfrtorch.Model, tmp_path):
    board = TensorBoard(tmp_path, RECORD, 0.5 * RECORD.y, every=2)
    for iteration in range(3):
        board(model, step(iteration, damping=0.5))
    board.text("scores", "a\nb", 2)
    board.close()
    found = events(tmp_path)
    for name, value in (("rmse/train", 1.5e-3), ("rmse/validation", 2.5e-3)):
        assert [e.value for e in found.Scalars(name)] == pytest.approx([value] * 3)
    assert [e.step for e in found.Scalars("search/damping")] == [0, 1, 2]
    radius = np.abs(np.linalg.eigvals(model.lfr.cell.A.detach().numpy())).max()
    assert found.Scalars("stability/spectral_radius_A")[0].value == pytest.approx(radius)
    for name in ("signals/response", "signals/static_map"):
        assert [e.step for e in found.Images(name)] == [0, 2]
        assert Image.open(io.BytesIO(found.Images(name)[0].encoded_image_string)).size[0] > 100
    groups = {tag.split("/")[0] for tags in ("scalars", "images") for tag in found.Tags()[tags]}
    assert min(groups) == "rmse"  # the first in TensorBoard


def test_a_fit_goes_on_if_tensorboard_cannot_write(model: lfrtorch.Model, tmp_path: Path):
    said: list[str] = []
    (tmp_path / "file").touch()
    board = TensorBoard(tmp_path / "file" / "inside", say=said.append)
    for iteration in range(3):
        board(model, step(iteration))
    board.text("scores", "a", 2)
    board.close()
    assert len(said) == 1
    assert "inside' cannot be written (" in said[0]
    with pytest.warns(UserWarning, match="the fit goes on without it"):
        TensorBoard(tmp_path / "file" / "inside")(model, step(0))


def test_tensorboard_has_a_run_of_finalists_alone(model: lfrtorch.Model, tmp_path: Path):
    boards = [TensorBoard(tmp_path / name, finalist=True) for name in ("early", "late")]
    for board, last in zip(boards, (5, 6), strict=True):  # an eighth of 40 iterations, and more
        for iteration in range(last + 1):
            board(model, step(iteration))
        board.close()
    assert not (tmp_path / "early").exists()
    assert [e.step for e in events(tmp_path / "late").Scalars("rmse/train")] == list(range(7))


def test_iterations_that_are_done_again_are_shown_once(
    model: lfrtorch.Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    files = event_file_writer.AtomicCounter(9)  # number 10 sorts before number 9
    monkeypatch.setattr(event_file_writer, "_global_uid", files)
    for first, last in ((0, 5), (3, 8)):  # a run that ended, and went on from a snapshot
        board = TensorBoard(tmp_path)
        for iteration in range(first, last):
            board(model, step(iteration))
        board.close()
    assert [e.step for e in events(tmp_path).Scalars("rmse/train")] == list(range(8))


def test_checkpoint_holds_the_best_so_far_when_it_is_time(tmp_path, monkeypatch):
    clock = {"now": 0.0}
    monkeypatch.setattr("lfrtorch.reporting.monitor.monotonic", lambda: clock["now"])
    bla = lfrtorch.estimate_bla(RECORD, nx=1)
    model = lfrtorch.initialise(bla, RECORD, nz=1, nw=1, nn=2)
    keep = Checkpoint(tmp_path / "model", every=5.0)
    held = []
    for iteration, (clock["now"], best, score) in enumerate(
        [
            (1.0, True, 9.0),
            (2.0, True, 8.0),
            (5.9, False, 9.0),
            (6.1, False, 9.0),
            (20.0, True, 8.5),  # of another start, which is behind
            (21.0, True, 7.0),
        ]
    ):
        with torch.no_grad():
            model.lfr.cell.A.fill_(float(iteration))
        keep(model, Progress(iteration, 40, 1.0, 1.0, 0.0, best, {}, score))
        held.append(float(lfrtorch.load(tmp_path).lfr.cell.A.detach()))
    assert held == [0, 0, 0, 1, 1, 5]


def test_tensorboard_has_the_run_among_others(tmp_path: Path):
    board = TensorBoard(tmp_path)
    board.hyperparameters({"nn": 4, "trainer": None}, {"validation": 0.5, "test": None}, 3)
    board.close()
    found = events(tmp_path)
    data = found.summary_metadata
    content = data["_hparams_/session_start_info"].plugin_data.content
    assert HParamsPluginData.FromString(content).session_start_info.hparams.keys() == {"nn"}
    assert found.Scalars("total/validation")[0].value == 0.5
    assert "total/test" not in found.Tags()["scalars"]
    # The page opens on the groups in the order of their names.
    assert min("rmse/train", *found.Tags()["scalars"]) == "rmse/train"


def test_rounds_of_several_starts_are_there_before_the_fit_ends(tmp_path: Path):
    board = TensorBoard(tmp_path)
    nan = float("nan")
    starts = tuple(RestartSummary(i, 25, 1.0, e, nan, "") for i, e in ((3, 1e-3), (0, 2e-3)))
    board.round(Round(1, 3, starts, 7.2))
    assert board.begun
    board.close()
    found = events(tmp_path)
    assert found.Scalars("starts/best")[0].step == 25
    assert found.Scalars("starts/worst")[0].value == pytest.approx(2e-3)
