"""Files of loggers, each written by the library that reads it."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lfrtorch import InputError, load_records
from lfrtorch.data.dataset import Dataset
from lfrtorch.files.formats import open_table
from lfrtorch.files.series import Series, SeriesTable

asammdf = pytest.importorskip("asammdf", reason="lfrtorch[files] is not installed")
mcap_writer = pytest.importorskip("mcap.writer")
nptdms = pytest.importorskip("nptdms")
pyuff = pytest.importorskip("pyuff")
rosbag2 = pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")

# pyuff leaves its files to the collector.
pytestmark = [
    pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

T, FS = 600, 100.0
TIMES = np.arange(T) / FS
U = np.random.default_rng(0).normal(size=T)
Y = np.convolve(U, [0.0, 0.5, 0.3])[:T]


def mdf(path: Path) -> None:
    with asammdf.MDF(version="4.10") as file:
        signals = [
            asammdf.Signal(U, TIMES, name="Torque", unit="Nm"),
            asammdf.Signal(Y, TIMES, name="Speed", unit="rad/s"),
        ]
        file.append(signals)
        slow = asammdf.Signal(Y[::10], TIMES[::10], name="Temperature", unit="°C")
        file.append([slow])
        file.save(path, overwrite=True)


def tdms(path: Path) -> None:
    channels = []
    for name, values, unit in (("Torque", U, "Nm"), ("Speed", Y, "rad/s")):
        options: dict[str, Any] = {
            "wf_increment": 1 / FS, "wf_samples": T, "unit_string": unit,
            "wf_start_time": np.datetime64("2026-01-05T08:00:00", "us"),
        }  # fmt: skip
        channels.append(nptdms.ChannelObject("rig", name, values, properties=options))
    slow = {"wf_increment": 10 / FS, "wf_start_time": np.datetime64("2026-01-05T08:00:00", "us")}
    channels.append(nptdms.ChannelObject("slow", "Temperature", Y[::10], properties=slow))
    with nptdms.TdmsWriter(str(path)) as writer:
        writer.write_segment(channels)


def uff(path: Path) -> None:
    file = pyuff.UFF(str(path))
    for i, (name, t, values, unit) in enumerate(
        (("Torque", TIMES, U, "Nm"), ("Speed", TIMES, Y, "rad/s"),
         ("Temperature", TIMES[::10], Y[::10], "degC"))
    ):  # fmt: skip
        unused = {
            f"{axis}_{what}": 0
            for axis in ("abscissa", "ordinate", "orddenom", "z_axis")
            for what in ("spec_data_type", "len_unit_exp", "force_unit_exp", "temp_unit_exp")
        }
        labels = {"orddenom_axis_units_lab": "NONE", "z_axis_axis_units_lab": "NONE"}
        one = pyuff.prepare_58(
            **unused, **labels, binary=0, func_type=1, ver_num=0, load_case_id=0,
            rsp_node=i + 1, rsp_dir=1, ref_dir=0, ref_node=0, data=values, x=t, id1=name,
            id2="NONE", id3="NONE", id4="NONE", id5="NONE", rsp_ent_name="NONE",
            ref_ent_name="NONE", abscissa_spacing=1, abscissa_min=0.0, abscissa_inc=float(t[1]),
            z_axis_value=0.0, ordinate_axis_units_lab=unit, abscissa_axis_units_lab="s",
        )  # fmt: skip
        file.write_sets(one, "add" if i else "overwrite")


def mcap(path: Path) -> None:
    """Topics in JSON, as Foxglove records them, each with instants of its own."""
    jitter = np.random.default_rng(1).uniform(-0.5e-3, 0.5e-3, size=T)
    with path.open("wb") as file:
        writer = mcap_writer.Writer(file)
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b"{}")
        topics = [writer.register_channel(f"/rig/{name}", "json", schema) for name in "abc"]
        for k, t in enumerate(TIMES + jitter):
            for topic, message, late in (
                (0, {"Torque": U[k], "note": "x"}, 0.0),
                (1, {"state": {"Speed": Y[k]}}, 1e-6),
                (2, {"Temperature": Y[k]}, 0.0),
            ):
                if topic < 2 or k % 10 == 0:
                    stamp = 1_700_000_000_000_000_000 + int((t + late) * 1e9)
                    data = json.dumps(message).encode()
                    writer.add_message(topics[topic], stamp, data, stamp)
        writer.finish()


def bag(folder: Path, plugin: Any) -> None:
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    Wrench, Vector3 = (store.types[f"geometry_msgs/msg/{n}"] for n in ("Wrench", "Vector3"))
    Float64 = store.types["std_msgs/msg/Float64"]
    with rosbag2.Writer(folder, version=9, storage_plugin=plugin) as writer:
        force, speed = (
            writer.add_connection(topic, kind, typestore=store)
            for topic, kind in (("/cmd", Wrench.__msgtype__), ("/speed", Float64.__msgtype__))
        )
        zero = Vector3(0.0, 0.0, 0.0)
        for k, t in enumerate(TIMES):
            stamp = 1_700_000_000_000_000_000 + round(t * 1e9)
            wrench = Wrench(zero, Vector3(0.0, 0.0, U[k]))
            writer.write(force, stamp, store.serialize_cdr(wrench, wrench.__msgtype__))
            writer.write(speed, stamp, store.serialize_cdr(Float64(Y[k]), Float64.__msgtype__))


@pytest.mark.parametrize(
    ("name", "write", "inputs", "outputs"),
    [
        ("a.mf4", mdf, "Torque", "Speed"),
        ("a.tdms", tdms, "Torque", "Speed"),
        ("a.uff", uff, "Torque", "Speed"),
    ],
)
def test_channels_by_name_at_their_rate(
    tmp_path: Path, name: str, write: Callable[[Path], None], inputs: str, outputs: str
):
    path = tmp_path / name
    write(path)
    data = load_records(path, inputs=inputs, outputs=outputs, start="zero", test="all")
    record = data.tests[0]
    assert record.fs == pytest.approx(FS)
    assert [str(c) for c in (*record.inputs, *record.outputs)] == ["Torque (Nm)", "Speed (rad/s)"]
    np.testing.assert_allclose(record.u[:, 0], U, atol=1e-9)  # text of 12 digits
    np.testing.assert_allclose(record.y[:, 0], Y, atol=1e-9)
    with pytest.raises(InputError, match=rf"for one clock write '{name}#10Hz'"):
        load_records(path, inputs="Torque", outputs="Temperature")
    slow = load_records(
        f"{path}#10Hz", inputs="Torque", outputs=["Speed", "Temperature"], start="zero", test="all"
    ).tests[0]
    assert (slow.fs, slow.samples, slow.name) == (pytest.approx(10.0), 60, path.stem + "_10Hz")
    np.testing.assert_allclose(slow.y[:, 0], slow.y[:, 1], atol=1e-8)
    with pytest.raises(InputError, match="'#fast' behind the file is not a rate"):
        load_records(f"{path}#fast", inputs="Torque", outputs="Speed")


def test_messages_in_json_are_put_on_one_clock(tmp_path: Path):
    mcap(tmp_path / "a.mcap")
    inputs, outputs = "rig/a.Torque", "rig/b.state.Speed"
    data = load_records(
        tmp_path / "a.mcap", inputs=inputs, outputs=outputs, start="zero", test="all"
    )
    record = data.tests[0]
    assert record.fs == pytest.approx(FS, rel=1e-3)
    assert any("interpolated to even times" in note for note in data.notes)
    np.testing.assert_allclose(record.u[:, 0], U[: record.samples], atol=0.4)  # moved by jitter
    with pytest.raises(InputError, match="#10Hz"):
        load_records(tmp_path / "a.mcap", inputs="rig/a.Torque", outputs="rig/c.Temperature")


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
def test_bags_of_ros_2(tmp_path: Path, plugin: str):
    bag(tmp_path / "bag", rosbag2.StoragePlugin[plugin])
    (path,) = [p for p in (tmp_path / "bag").iterdir() if p.suffix in (".db3", ".mcap")]
    data = load_records(path, inputs="cmd.torque.z", outputs="speed.data", test="all")
    np.testing.assert_array_equal(data.tests[0].u[:, 0], U)
    np.testing.assert_array_equal(data.tests[0].y[:, 0], Y)
    assert data.tests[0].fs == pytest.approx(FS)


@pytest.mark.parametrize("name", ["a.mf4", "a.tdms", "a.mcap", "a.uff", "a.db3"])
def test_damaged_files_and_missing_packages(tmp_path: Path, monkeypatch, name: str):
    (tmp_path / name).write_bytes(b"nothing of the kind" * 40)
    with pytest.raises(InputError, match=r"is not a readable|no channel of two samples"):
        open_table(tmp_path / name)
    package = {"a.mf4": "asammdf", "a.tdms": "nptdms", "a.mcap": "mcap.reader", "a.uff": "pyuff"}
    monkeypatch.setitem(sys.modules, package.get(name, "rosbags.rosbag2"), None)
    with pytest.raises(InputError, match=r"is not installed: pip install 'lfrtorch\[files\]'"):
        open_table(tmp_path / name)


def test_only_channels_that_are_read_cut_one_another():
    found = {
        "u": Series(TIMES, U),
        "y": Series(TIMES + 1e-3, Y),
        "event": Series(TIMES[300:340] + 2e-3, Y[300:340]),
        "time": Series(TIMES, TIMES),
    }
    table = SeriesTable(Path("a.mf4"), Path("a.mf4"), found)
    u, y, event, time = (table.find(n, "inputs")[0] for n in ("u", "y", "event", "channel time"))
    (block,) = table.blocks([u, y, time])
    assert len(block) == T - 1
    assert not any("left out" in note for note in table.notes)
    slow = SeriesTable(Path("a.mf4#50Hz"), Path("a.mf4"), found)
    for each, samples in ((table, 40), (slow, 20)):
        (block,) = each.blocks([u, event] if each is table else [1, 3])
        assert len(block) == samples
        assert np.isfinite(block).all()
        assert "the channels run together from 3.002 s to 3.392 s only: the rest is left out" in (
            each.notes
        )


def test_gaps_stay_gaps():
    t = np.delete(TIMES, slice(200, 260))
    table = SeriesTable(Path("a"), Path("a"), {"u": Series(t, t), "y": Series(t, 2 * t)})
    (block,) = table.blocks([0, 1, 2])
    np.testing.assert_array_equal(block, np.column_stack([t, t, 2 * t]))
    assert not table.notes


def mf4(path: Path, **channels: tuple[np.ndarray, np.ndarray]) -> Path:
    """A file in which every channel, of times and values, has a clock of its own."""
    with asammdf.MDF(version="4.10") as file:
        for name, (t, values) in channels.items():
            file.append([asammdf.Signal(values, t, name=name)])
        file.save(path, overwrite=True)
    return path


def all_of(path: Path | str, **options: Any) -> Dataset:
    return load_records(path, inputs="u", outputs="y", start="zero", test="all", **options)


HOLE = np.delete(np.arange(T), slice(200, 350))


@pytest.mark.parametrize("rate", ["", "#100Hz", "#80Hz"])
def test_a_hole_in_a_channel_is_not_filled(tmp_path: Path, rate: str):
    wave = np.sin(7 * TIMES)
    path = f"{mf4(tmp_path / 'a.mf4', u=(TIMES[HOLE], wave[HOLE]), y=(TIMES, Y))}{rate}"
    with pytest.raises(InputError, match=r"the first at 2 s.* 'u', for .* \(1.5 s\).\n.*'split'"):
        all_of(path)
    records = all_of(path, gaps="split").tests
    assert sum(record.samples for record in records) / records[0].fs == pytest.approx(4.5)
    for record, begin in zip(records, (0.0, 3.5), strict=True):
        t = begin + np.arange(record.samples) / record.fs
        np.testing.assert_allclose(record.u[:, 0], np.sin(7 * t), atol=1e-3)  # (7 / 100)² / 8


@pytest.mark.parametrize("rate", ["", "#100Hz"])
def test_a_hole_in_an_output_is_simulated_through(tmp_path: Path, rate: str):
    path = mf4(tmp_path / "a.mf4", u=(TIMES, U), y=(TIMES[HOLE], Y[HOLE]))
    data = all_of(f"{path}{rate}")
    (record,) = data.tests
    assert record.valid is not None
    np.testing.assert_array_equal(np.flatnonzero(~record.valid[:, 0]), np.arange(200, 350))
    np.testing.assert_array_equal(record.u[:, 0], U)
    assert any("150 output sample(s) have no value, the first at 2 s" in n for n in data.notes)


def test_a_hole_in_jittering_messages_of_one_topic_is_a_hole():
    t = (TIMES + np.random.default_rng(1).uniform(-2e-3, 2e-3, T))[HOLE]
    table = SeriesTable(Path("a"), Path("a"), {"u": Series(t, t), "y": Series(t, 2 * t)})
    (block,) = table.blocks([0, 1, 2])
    missing = np.isnan(block).any(axis=1)
    assert 148 <= missing.sum() <= 151
    np.testing.assert_allclose(block[~missing], block[~missing, :1] * [1, 1, 2], atol=1e-9)


@pytest.mark.parametrize("rate", ["", "#100Hz"])
def test_channels_of_different_times_are_refused(tmp_path: Path, rate: str):
    path = mf4(tmp_path / "a.mf4", u=(TIMES, U), y=(TIMES + 7, Y))
    with pytest.raises(InputError, match=r"'u' ends at 5\.99 s and 'y' begins at 7 s") as error:
        all_of(f"{path}{rate}")
    assert "Hz" not in str(error.value).replace("#100Hz'", "")


def on_change() -> tuple[np.ndarray, np.ndarray]:
    """Samples of a command at which it changes, the last one second before the end."""
    dwell = np.random.default_rng(2).integers(3, 40, size=100)
    at = np.concatenate([[0], np.cumsum(dwell)])
    at = at[at < T - 100]
    return at, np.random.default_rng(3).choice([0.0, 1.0, 3.0], size=len(at))


@pytest.mark.parametrize("rate", ["", "#100Hz"])
def test_a_channel_on_change_is_held_to_the_end(tmp_path: Path, rate: str):
    at, levels = on_change()
    path = mf4(tmp_path / "a.mf4", u=(TIMES[at], levels), y=(TIMES, Y))
    data = all_of(f"{path}{rate}")
    (record,) = data.tests
    np.testing.assert_array_equal(record.u[:, 0], np.repeat(levels, np.diff(at, append=T)))
    assert record.fs == pytest.approx(FS)
    assert "'u' is logged on change and held between its samples" in data.notes


@pytest.mark.parametrize("levels", [[0.0, 1.0], [0.0, 2.0, 1.0, 3.0]])
def test_a_step_of_few_samples_is_held(tmp_path: Path, levels: list[float]):
    at = 100 * np.arange(len(levels))
    path = mf4(tmp_path / "a.mf4", u=(TIMES[at], np.array(levels)), y=(TIMES, Y))
    (record,) = all_of(path).tests
    np.testing.assert_array_equal(record.u[:, 0], np.repeat(levels, np.diff(at, append=T)))


def test_a_record_begins_with_the_first_value_of_what_is_held(tmp_path: Path):
    at, levels = on_change()
    path = mf4(tmp_path / "a.mf4", u=(TIMES[at[1:]], levels[1:]), y=(TIMES, Y))
    data = all_of(path)
    (record,) = data.tests
    np.testing.assert_array_equal(record.y[:, 0], Y[at[1] :])
    assert record.u[0, 0] == levels[1]
    assert any(f"run together from {TIMES[at[1]]:g} s" in note for note in data.notes)


def test_slow_messages_with_jitter_or_lost_ones_are_not_held():
    generator = np.random.default_rng(4)
    jitter = np.arange(0, 6, 0.1) + generator.uniform(-0.02, 0.02, 60)
    lost = np.sort(generator.choice(TIMES[::10], 50, replace=False))
    hole = np.delete(TIMES[::10], slice(20, 40))
    for t in (jitter, lost, hole):
        table = SeriesTable(Path("a"), Path("a"), {"u": Series(t, t), "y": Series(TIMES, Y)})
        u, y = (table.find(name, "inputs")[0] for name in "uy")
        with pytest.raises(InputError, match=r"'u' at .* Hz and 'y' at 100 Hz; for one clock"):
            next(table.blocks([u, y]))
        table = SeriesTable(Path("a#100Hz"), Path("a"), {"u": Series(t, t), "y": Series(TIMES, Y)})
        (block,) = table.blocks([0, 1])
        joined = block[np.isfinite(block[:, 1])]
        np.testing.assert_allclose(joined[:, 1], joined[:, 0], atol=1e-9)
        # The hole is from 1.9 to 4 s.
        assert np.isnan(block[:, 1]).sum() == (209 if t is hole else 0)


def test_a_channel_without_another_beside_it_is_not_held():
    at, levels = on_change()
    found = {"u": Series(TIMES[at], levels), "y": Series(TIMES[at], 2 * levels)}
    table = SeriesTable(Path("a#100Hz"), Path("a"), found)
    (block,) = table.blocks([1, 2])
    np.testing.assert_allclose(block[:, 1], 2 * block[:, 0])
    assert not any("held" in note for note in table.notes)


def test_the_times_of_any_rate_are_found(tmp_path: Path):
    path = mf4(tmp_path / "a.mf4", slow=(TIMES[::10], Y[::10]), u=(TIMES, U), y=(TIMES, Y))
    assert all_of(path).tests[0].fs == pytest.approx(FS)


def test_a_clock_that_is_set_back_is_named(tmp_path: Path):
    back = np.where(TIMES < 3, TIMES, TIMES - 1.5)
    path = mf4(tmp_path / "a.mf4", u=(back, U), y=(back, Y), other=(TIMES, U), more=(TIMES, Y))
    with pytest.raises(InputError, match=r"clock that is set back, from 2.99 s to 1.5 s after 300"):
        all_of(path)
    load_records(path, inputs="other", outputs="more", start="zero", test="all")
    late = np.arange(T)
    late[[100, 101]] = [101, 100]  # messages overtake one another
    path = mf4(tmp_path / "b.mf4", u=(TIMES[late], U[late]), y=(TIMES, Y))
    np.testing.assert_array_equal(all_of(path).tests[0].u[:, 0], U)


def test_messages_of_a_clock_that_is_set_back_are_not_shuffled(tmp_path: Path):
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = mcap_writer.Writer(file)
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b"{}")
        topic = writer.register_channel("/rig", "json", schema)
        for k, t in enumerate(TIMES):
            stamp = 1_700_000_000_000_000_000 + round((t if t < 3 else t - 1.5) * 1e9)
            writer.add_message(topic, stamp, json.dumps({"u": U[k], "y": Y[k]}).encode(), stamp)
        writer.finish()
    with pytest.raises(InputError, match=r"'rig.u'.* clock that is set back, from 2.99 s to 1.5 s"):
        load_records(tmp_path / "a.mcap", inputs="rig.u", outputs="rig.y")


def test_rates_in_messages_are_rates_behind_files(tmp_path: Path):
    k = np.arange(T)
    path = mf4(tmp_path / "a.mf4", u=(k / 51200, U), y=(k[:-1] / 102400, Y[:-1]))
    with pytest.raises(InputError, match=r"for one clock write 'a\.mf4#51200Hz'"):
        all_of(path)
    for rate in ("51200Hz", "5.12e4Hz", "5.12E+04 Hz", "51.2kHz"):
        assert all_of(f"{path}#{rate}").tests[0].fs == pytest.approx(51200)
    for rate in ("1.2.3Hz", "0Hz", "1e999Hz", "eHz", ".Hz"):
        with pytest.raises(InputError, match="is not a rate"):
            all_of(f"{path}#{rate}")
    with pytest.raises(InputError, match=r"takes .* of memory"):
        open_table(f"{path}#1.7e308Hz").read([1, 2])


def test_values_of_mdf_that_are_invalid_or_have_words(tmp_path: Path):
    invalid = np.zeros(T, bool)
    invalid[200:210] = True
    gears = (np.arange(T) // 50).astype(np.uint8)
    words: dict[str, Any] = {f"val_{i}": float(i) for i in range(12)}
    words |= {f"text_{i}": f"gear {i}".encode() for i in range(12)} | {"default": b"?"}
    with asammdf.MDF(version="4.10") as file:
        wrong = np.where(invalid, 1e6, Y)
        file.append([asammdf.Signal(wrong, TIMES, name="y", invalidation_bits=invalid)])
        file.append([asammdf.Signal(gears, TIMES, name="u", conversion=words)])
        half = {"a": 0.5, "b": 1.0}  # a x + b
        file.append([asammdf.Signal(gears, TIMES, name="scaled", conversion=half)])
        file.save(tmp_path / "a.mf4")
    data = load_records(
        tmp_path / "a.mf4", inputs="u", outputs=["y", "scaled"], start="zero", test="all"
    )
    (record,) = data.tests
    np.testing.assert_array_equal(record.u[:, 0], gears)
    np.testing.assert_array_equal(record.y[:, 1], 0.5 * gears + 1.0)
    assert record.valid is not None
    np.testing.assert_array_equal(~record.valid[:, 0], invalid)
    np.testing.assert_array_equal(record.y[~invalid, 0], Y[~invalid])
    assert "10 sample(s) of 'y' are invalid: no values" in data.notes
    assert "'u' has words for its numbers: the numbers are read" in data.notes


STARTED = {"wf_increment": 1 / FS, "wf_start_time": np.datetime64("2026-01-05T08:00:00", "us")}
STAMPS = STARTED["wf_start_time"] + np.arange(T) * np.timedelta64(10_000, "us")


@pytest.mark.parametrize(
    ("u", "y", "beside", "said"),
    [
        (STARTED, STARTED, {"status": np.zeros(3)}, ""),
        (STARTED, {"wf_increment": 1 / FS}, {}, "'y' has no start time"),
        ({}, {}, {"Time": TIMES}, "'Time' is the time of 'rig'"),
        ({}, {}, {"time_ms": 1e3 * TIMES}, "'time_ms' is the time of 'rig'"),
        ({}, {}, {"Stamp": STAMPS}, "'Stamp' is the time of 'rig'"),
    ],
)
def test_times_of_tdms(tmp_path: Path, u: Any, y: Any, beside: dict[str, Any], said: str):
    channels = [
        nptdms.ChannelObject("rig", "u", U, properties=u),
        nptdms.ChannelObject("rig", "y", Y, properties=y),
        *(nptdms.ChannelObject("rig", name, values) for name, values in beside.items()),
    ]
    with nptdms.TdmsWriter(str(tmp_path / "a.tdms")) as writer:
        writer.write_segment(channels)
    data = all_of(tmp_path / "a.tdms")
    (record,) = data.tests
    assert record.fs == pytest.approx(FS)
    np.testing.assert_array_equal(record.u[:, 0], U)
    np.testing.assert_array_equal(record.y[:, 0], Y)
    assert any(said in note for note in data.notes)
    if "status" in beside:
        with pytest.raises(InputError, match="'status', named in inputs, has neither wf_increment"):
            load_records(tmp_path / "a.tdms", inputs="status", outputs="y")


def test_zeros_that_fill_the_last_line_of_uff_are_no_samples(tmp_path: Path):
    uff(tmp_path / "a.uff")
    lines = (tmp_path / "a.uff").read_text().splitlines()
    ends = [i for i, line in enumerate(lines) if line == "    -1"][1::2]
    for end in ends:
        lines[end - 1] += f"{0.0:20.12e}" * (4 - len(lines[end - 1]) // 20)
        lines[end - 1] = "".join([lines[end - 1], "\n", f"{0.0:20.12e}" * 3])
    (tmp_path / "a.uff").write_text("\n".join(lines) + "\n")
    data = load_records(tmp_path / "a.uff", inputs="Torque", outputs="Speed", test="all")
    assert data.tests[0].samples == T
