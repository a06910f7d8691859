"""Measurements looked at from the command line: columns, remarks, table, notes, figure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command_line import configuration
from matplotlib.figure import Figure
from matplotlib.image import imread
from scipy.io import savemat
from scipy.signal import lfilter

from lfrtorch._support.tables import number
from lfrtorch.cli import command, config, preview
from lfrtorch.data.records import Channel
from lfrtorch.files import measurement
from lfrtorch.files.formats import open_table
from lfrtorch.files.measurement import look_at
from lfrtorch.reporting.survey_plots import survey_figure
from lfrtorch.survey.measurement import survey_measurement
from lfrtorch.survey.notes import examine

ROOT = Path(__file__).resolve().parents[2]
T, FS = 1000, 50.0


@pytest.fixture(scope="module")
def signals() -> dict[str, np.ndarray]:
    """Times, an input and the clipped output of a first-order system, NaN in one sample."""
    u = np.random.default_rng(0).standard_normal(T)
    y = np.minimum(lfilter([0, 0.1], [1, -0.9], u), 0.3)
    y[5] = np.nan
    return {"time": np.arange(T) / FS, "force": u, "level": y}


def written(path: Path, columns: dict[str, np.ndarray], **units: str) -> Path:
    heads = [f"{name} ({units[name]})" if name in units else name for name in columns]
    rows = np.stack([*columns.values()], axis=1)
    lines = [",".join("" if np.isnan(v) else f"{v:.10g}" for v in row) for row in rows]
    path.write_text("\n".join([",".join(heads), *lines, ""]))
    return path


@pytest.fixture
def file(tmp_path: Path, signals, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return written(tmp_path / "lab.csv", signals, force="N", level="mm")


@pytest.fixture
def run(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def run(*words: str | Path) -> str:
        monkeypatch.setattr("sys.argv", ["lfrtorch preview", *map(str, words)])
        command.start("preview")
        printed = capsys.readouterr()
        assert printed.err == ""
        return printed.out

    return run


@pytest.fixture
def undrawn(monkeypatch):
    """An empty figure, which is written in no time, and no trial of starts."""
    monkeypatch.setattr(preview, "survey_figure", lambda *_: Figure(figsize=(0.1, 0.1)))
    monkeypatch.setattr(preview, "beginning", lambda *_: [])


def refused(capsys, *words: str | Path) -> str:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["lfrtorch preview", *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            command.start("preview")
    assert stop.value.code == 1
    return capsys.readouterr().err


@pytest.mark.numeric
def test_one_command_gives_table_notes_and_figure(file: Path, run):
    out = run(file, "data.inputs=[force]", "data.outputs=[level]")
    assert f"{file}: {T} samples at 50 Hz" in out
    assert "'time' is taken for the time, 50 Hz" in out
    assert "at rest, and by" in " ".join(out.split())
    head, rule, force, level = out.splitlines()[4:8]
    assert head.split()[:4] == ["signal", "use", "samples", "missing"]
    assert set(rule) == {"-", " "}
    assert force.split()[:5] == ["force", "(N)", "input", str(T), "0"]
    assert level.split()[:5] == ["level", "(mm)", "output", str(T), "1"]
    said = " ".join(out.split())
    assert f"- 'level' misses 1 of {T} samples" in said
    assert "- output 'level' has its largest value 0.3" in said
    assert out.count("\n- ") == 2
    assert len(np.asarray(imread(file.parent / "lab_preview.png"))[0]) > 1000


def test_numbers_of_small_signals_have_a_prefix(signals):
    small = 1e-5 * signals["level"]
    found = survey_measurement(signals["force"], small, FS, outputs=(Channel("level", "m"),))
    row = found.table()[1][1]
    assert row[0] == "level (µm)"
    assert row[7] == pytest.approx(3.0)
    assert str(row[-1]).startswith(f"~ {number(1e6 * (found.outputs[0].noise or 0), 4)}")


@pytest.mark.numeric
def test_numbers_of_the_table(signals):
    found = survey_measurement(signals["force"], signals["level"], FS)
    row = dict(zip(["mean", "rms", "min", "max"], found.table()[1][1][4:8], strict=True))
    y = signals["level"]
    assert (row.pop("min"), row.pop("max")) == (np.nanmin(y), 0.3)
    expected = {"mean": np.nanmean(y), "rms": np.nanstd(y)}
    assert row == pytest.approx(expected, rel=1e-9, abs=1e-12)  # sums in another order
    top = np.nansum(y == 0.3)
    assert found.table()[1][1][9] == pytest.approx(100 * top / T)
    assert "~" in str(found)


@pytest.mark.usefixtures("undrawn")
def test_without_roles_all_columns_are_shown(file: Path, run):
    out = run(file, "out=sub/look.svg")
    assert "without inputs and outputs what lies between them is not" in out
    assert "- 'level' has its largest value 0.3" in out
    assert (file.parent / "sub" / "look.svg").read_text().lstrip().startswith("<?xml")
    assert not list(file.parent.glob("*.png"))


@pytest.mark.usefixtures("undrawn")
def test_columns_that_are_called_as_signals_are(file: Path, signals, run):
    named = written(file, {"u": signals["force"], "y": signals["level"]})
    out = run(named, "fs=50")
    assert "inputs=u, outputs=y, by the names of the columns" in out
    assert "what lies between them is not looked at" not in out
    assert "outputs: u, all other columns" in run(named, "inputs=y")
    out = run(written(file, {"y": signals["level"]}), "outputs=y", "fs=50")
    assert "no column is left for inputs" in out
    assert "all other columns" not in out


@pytest.mark.usefixtures("undrawn")
def test_the_other_columns_are_outputs(file: Path, run):
    assert "outputs: level, all other columns" in run(file, "data.inputs=[1]")
    assert "inputs: force, all other columns" in run(file, "data.outputs=[level]")


@pytest.mark.usefixtures("undrawn")
def test_another_sampling_frequency_than_the_times_say(file: Path, run):
    out = run(file, "data.inputs=[force]", "data.fs=750")
    assert "- fs is 750 Hz and the column 'time' says 50 Hz; if that is right, give" in out
    assert "at 750 Hz" in out
    assert "outputs: level, all other columns" in out
    assert "fs is" not in run(file, "data.inputs=[force]", "data.fs=50")


@pytest.mark.usefixtures("undrawn")
def test_times_in_milliseconds(tmp_path: Path, signals, run):
    columns = signals | {"time": 1000 * signals["time"]}
    assert "at 50 Hz" in run(written(tmp_path / "a.csv", columns, time="ms"))
    out = run(written(tmp_path / "b.csv", columns), "data.fs=50")
    assert "unless it is in milliseconds" in " ".join(out.split())


@pytest.mark.usefixtures("undrawn")
def test_sample_numbers_and_uneven_times(tmp_path: Path, signals, run):
    numbered = {"n": np.arange(T, dtype=float), **signals}
    del numbered["time"]
    out = run(written(tmp_path / "a.csv", numbered))
    assert "'n' is taken for sample numbers" in out
    assert "no sampling frequency: give fs=HZ" in out
    steps = np.random.default_rng(1).uniform(0.5, 1.5, T) / FS
    out = run(written(tmp_path / "b.csv", signals | {"time": np.cumsum(steps)}))
    assert "the time column 'time' is not evenly spaced: its steps go from" in out
    assert "signals are interpolated to even times of" in out
    gaps = np.delete(np.arange(T + 9) / FS, [*range(500, 508), 900])
    out = run(written(tmp_path / "c.csv", signals | {"time": gaps}))
    said = " ".join(out.split())
    assert (
        "- the time stamps have 1 gap(s) of 8 sample(s) in all, the first before line 502" in said
    )
    assert "1 sample(s) are missing between the others, the first before line 894" in said
    assert "at 50 Hz" in out
    out = run(written(tmp_path / "d.csv", signals), "data.time=force")
    assert "- the time column 'force' does not rise" in out


def test_gaps_in_time_are_drawn(tmp_path: Path):
    t = np.delete(np.arange(400.0), [*range(200, 207), 300])
    table = open_table(written(tmp_path / "a.csv", {"t": t, "y": np.cos(t)}))
    seen = look_at(table)
    assert np.array_equal(np.flatnonzero(np.isnan(seen.y[:, 0])), [*range(200, 207), 300])


@pytest.mark.usefixtures("undrawn")
def test_several_files_and_patterns(file: Path, signals, run):
    savemat(file.parent / "other.mat", {"force": signals["force"], "level": signals["force"]})
    words = "data.inputs=[force]", "data.outputs=[level]", "data.fs=50"
    out = run(file.parent / "*.*", file, *words)
    assert out.count("Figure in") == 2
    assert {p.name for p in file.parent.glob("*.png")} == {"lab_preview.png", "other_preview.png"}
    run(file, file.parent / "other.mat", "out=x.png")
    assert {p.name for p in file.parent.glob("x*")} == {"x_lab.png", "x_other.png"}


@pytest.mark.usefixtures("undrawn")
def test_figures_of_files_of_one_name_overwrite_no_other(file: Path, signals, run, monkeypatch):
    for folder in ("a", "b"):
        (file.parent / folder).mkdir()
        written(file.parent / folder / "lab.csv", signals)
    savemat(file.parent / "lab.mat", {"force": signals["force"]})
    run("a/lab.csv")
    run(file.parent / "b" / "lab.csv")
    run("lab.csv", "lab.mat")
    names = ["a_lab", "b_lab", "lab.csv", "lab.mat"]
    assert sorted(p.name for p in file.parent.glob("*.png")) == [f"{n}_preview.png" for n in names]
    monkeypatch.chdir(file.parent / "a")
    run(file)
    (figure,) = Path().glob("*.png")
    assert figure.name.endswith(f"{file.parent.name}_lab_preview.png")


@pytest.mark.usefixtures("undrawn")
def test_empty_lines_at_the_end_are_no_samples(tmp_path: Path, signals, run):
    longer = {name: np.append(values, np.full(30, np.nan)) for name, values in signals.items()}
    path = written(tmp_path / "a.csv", longer)
    assert f"{path}: {T} samples at 50 Hz" in run(path)


@pytest.mark.usefixtures("undrawn")
def test_all_variables_of_a_file_of_arrays_are_listed(tmp_path: Path, signals, run):
    both = np.stack([signals["force"], signals["force"] + 1])
    arrays = {"F": signals["force"], "acc": both, "Fs": FS, "rig": "left", "f": np.ones(7)}
    savemat(tmp_path / "a.mat", arrays)
    out = run(tmp_path / "a.mat")
    assert f"{T} samples at 50 Hz" in out
    assert "fs is 50 Hz, as 'Fs' in the file says" in out
    assert f"left out: f, of other lengths than {T} samples" in out
    listed = [" ".join(line.split()) for line in out.splitlines()]
    assert f"acc 2 × {T} signals acc1 .. acc2" in listed
    assert "Fs 1 × 1 sampling frequency, 50 Hz" in listed
    assert any(line.startswith("rig 1 × 4 nothing: it has no numbers") for line in listed)
    out = run(tmp_path / "a.mat", "data.inputs=[F]", "data.outputs=[acc[1]]")
    assert {line.split()[0] for line in out.splitlines() if " output " in line} == {"acc2"}


def test_columns_without_values_are_refused(tmp_path: Path, capsys):
    savemat(tmp_path / "a.mat", {"u": np.full((30, 1), np.nan)})
    assert "has no values in the columns to show" in refused(capsys, tmp_path / "a.mat")


@pytest.mark.usefixtures("undrawn")
def test_a_column_of_text_is_left_out(tmp_path: Path, run):
    lines = [f"{v:.6f},good" for v in np.random.default_rng(0).standard_normal(400)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["u,state", *lines]))
    out = run(path)
    assert "left out: " in out
    assert "'state'" in out


@pytest.mark.usefixtures("undrawn")
def test_only_the_beginning_of_a_long_file_is_read(file: Path, run, monkeypatch):
    monkeypatch.setattr(measurement, "LARGEST", 3 * 700)
    out = run(file, "data.inputs=[force]", "data.outputs=[level]")
    assert "only the first 700 samples are read" in out
    assert f"{file}: 700 samples" in out
    monkeypatch.setattr(measurement, "LARGEST", 3 * T)
    assert "no more" not in run(file, "data.inputs=[force]", "data.outputs=[level]")


@pytest.mark.usefixtures("undrawn")
def test_the_words_of_other_commands_are_understood(file: Path, signals, run, capsys):
    words = ["data.inputs=[force]", "data.outputs=level", "data.fs=50", "data.time=time"]
    expected = run("data=file", f"data.path={file}", *words)
    assert "force" in expected
    assert run(file, "data.inputs=1", *words[1:]) == expected
    other = written(file.parent / "ü.csv", {"Füllstand (a)": signals["force"]})
    assert "Füllstand" in run(f"data.path=[{other}]", "data.outputs=[Füllstand (a)]")
    for word, message in (
        ("sizes=2", "there is no setting 'sizes'"),
        ("data.inputs=a,b", "has no column 'a', named in inputs"),
        ("data.fs=1,2", "data.fs=1,2 has several values: for a list write data.fs=[1,2]"),
        (f"data.path={file}", "data.path is given twice"),
        ("data.inputs=[a", "is not understood"),
        ("data.fs=-3", "fs is -3; give a positive number"),
        ("data.fs=1e-320", "fs is 1e-320 Hz; give one between 1e-100"),
    ):
        assert message in refused(capsys, file, word)
    assert "add a file" in refused(capsys, "data.fs=3")
    for words in ([], ["+bench=boucwen"]):
        assert "no file is named" in refused(capsys, *words)
    for value in ("5", "0.5", "true", "[1]"):
        assert "give the path of a file, a pattern" in refused(capsys, f"data.path={value}")
    loud = written(file.parent / "loud.csv", {"y": 1e200 * signals["force"]})
    assert "'y' goes up to 3." in refused(capsys, loud)  # was a traceback of the figure


@pytest.mark.usefixtures("undrawn")
def test_the_command_line_of_a_fit_is_that_of_a_preview(file: Path, signals, run, capsys):
    other = written(file.parent / "other.csv", signals)
    third = written(file.parent / "third.csv", signals)
    words = ["inputs=force", "outputs=level", "start=zero", "nx=2", "trainer.max_iter=9"]
    out = run(file, f"test={other}", f"validation=[lab,{third}]", *words, "figures=false")
    assert [out.count(f"{path}: {T} samples at 50 Hz") for path in (file, other, third)] == [1] * 3
    assert run(file, "test=all", *words).count("samples at") == 1
    assert "there is no file 'gone.csv'" in refused(capsys, file, "test=gone.csv")


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["data.inputs=mass"], "has no column 'mass', named in inputs"),
        (
            ["data.inputs=force", "data.outputs=force"],
            "'force (N)' stands twice in inputs, outputs",
        ),
        (["data.inputs=[force,level]", "data.time=time"], "no column is left for the outputs;"),
        (["out=x.csv"], "out is 'x.csv'; give a name that ends with .png"),
        (["nothing*.csv"], "no file matches 'nothing*.csv'"),
        (["gone.csv"], "there is no file 'gone.csv'"),
    ],
)
def test_user_errors_are_one_message(words, message, file: Path, capsys):
    assert message in refused(capsys, file, *words)


@pytest.mark.numeric
def test_how_a_fit_would_take_the_record_to_begin(tmp_path: Path, run, monkeypatch):
    monkeypatch.setattr(preview, "survey_figure", lambda *_: Figure(figsize=(0.1, 0.1)))
    noise, u = np.random.default_rng(0).standard_normal((2, 1400))
    y = lfilter([1.0], [1, -1.96, 0.9702], u) + 0.5 * noise
    y[1010] = np.nan
    words = ["data.inputs=[u]", "data.outputs=[y]", "data.fs=50"]
    motion = written(tmp_path / "motion.csv", {"u": u[1000:], "y": y[1000:]})
    assert "with an estimated start: start is estimated" in run(motion, *words)
    assert "start is" not in run(motion, *words, "start=zero")
    assert "start is" not in run(written(tmp_path / "few.csv", {"u": u[:30], "y": y[:30]}), *words)


def test_figure_of_signals_that_say_little():
    signals = np.column_stack([np.full(40, np.nan), np.ones(40), np.arange(40.0)])
    found = survey_measurement(signals[:, :1], signals[:, 1:])
    figure = survey_figure(found, signals, "odd")
    figure.draw_without_rendering()
    assert len(figure.axes) == 9


def test_figure_marks_where_a_signal_is_clipped(signals):
    found = survey_measurement(signals["force"], signals["level"], FS)
    figure = survey_figure(found, np.column_stack([signals["force"], signals["level"]]))
    time = figure.axes[3]
    assert np.asarray(time.lines[-1].get_ydata())[0] == 0.3
    assert "clipped" in figure.axes[0].get_title()
    assert examine(found, signals["force"][:, None], signals["level"][:, None])


def test_train_says_the_notes_of_a_file(file: Path, signals, capsys):
    delayed, whole = np.roll(signals["force"], 1), np.nan_to_num(signals["level"])
    clean = written(file.parent / "clean.csv", signals | {"level": delayed})
    clipped = written(file.parent / "clipped.csv", signals | {"level": whole})
    words = ["data=file", "data.inputs=[force]", "data.outputs=[level]", "data.fs=50"]
    words.append("data.start=zero")
    config.loaded(configuration(*words, f"data.path={clipped}"))
    assert "note: output 'level' has its largest value 0.3" in capsys.readouterr().out
    config.loaded(configuration(*words, f"data.path={clean}"))
    assert "note: output" not in capsys.readouterr().out
