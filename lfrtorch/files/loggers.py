"""Files of loggers, each by its format's own library: MDF4, TDMS, MCAP, ROS 2 bags, UFF58."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np

from lfrtorch._support.errors import InputError, brief
from lfrtorch.data.records import Channel
from lfrtorch.files.arrays import optional
from lfrtorch.files.series import Series, SeriesTable
from lfrtorch.files.table import Table
from lfrtorch.files.time_stamps import is_time, time_unit

_LONGEST = 16
"""An array in a message is read as channels if it has at most so many entries."""

_NANOSECONDS = 1e-9

Read = Callable[[Path], Mapping[str, Series | str]]


def _reader(read: Read, kind: str) -> Callable[[Path], Table]:
    """Make a function that opens a file, with one message for all kinds of damage."""

    def opened(path: Path) -> Table:
        file = Path(str(path).rpartition("#")[0]) if not path.is_file() else path
        try:
            found = read(file)
        except InputError:
            raise
        except Exception as error:  # each library has errors of its own
            raise InputError(
                f"'{file}' is not a readable {kind} file ({brief(repr(error))}); write it again."
            ) from error
        return SeriesTable(path, file, found)

    return opened


def _mdf(path: Path) -> dict[str, Series]:
    """The channels of an MDF file; a name that occurs again is followed by the signal's number."""
    asammdf = optional("asammdf")
    found: dict[str, Series] = {}
    with asammdf.MDF(str(path)) as file:
        for number, signal in enumerate(file.iter_channels(raw=True)):
            name = signal.name if signal.name not in found else f"{signal.name} [{number}]"
            values, notes = signal.physical(copy=False).samples, []
            if values.dtype.kind not in "biuf" and signal.samples.dtype.kind in "biuf":
                values = signal.samples
                notes.append(f"{name!r} has words for its numbers: the numbers are read")
            if values.dtype.kind not in "biuf" or values.ndim != 1:
                continue
            invalid = signal.invalidation_bits
            if invalid is not None and np.any(invalid):
                values = np.where(invalid, np.nan, values)
                notes.append(f"{np.sum(invalid)} sample(s) of {name!r} are invalid: no values")
            found[name] = Series(signal.timestamps, values, signal.unit or "", "; ".join(notes))
    return found


def _tdms(path: Path) -> dict[str, Series | str]:
    """The channels of all groups, by name, or by group and name if several have that name."""
    nptdms = optional("nptdms")
    found: dict[str, Series | str] = {}
    begins: dict[str, int] = {}
    with nptdms.TdmsFile.read(str(path)) as file:
        names = [channel.name for group in file.groups() for channel in group.channels()]
        for group in file.groups():
            stamps = next(filter(_is_clock, group.channels()), None)
            for channel in group.channels():
                if channel.dtype.kind not in "biuf" or not len(channel):
                    continue
                twice = names.count(channel.name) > 1
                name = f"{channel.group_name}/{channel.name}" if twice else channel.name
                told, note, begin = channel.properties, "", None
                if told.get("wf_increment", 0) > 0:
                    t = told["wf_increment"] * np.arange(len(channel))
                    t += told.get("wf_start_offset", 0.0)
                    begin = told.get("wf_start_time")
                    if begin is None:
                        note = f"{name!r} has no start time: it begins with the first of the others"
                elif stamps is not None and len(stamps) == len(channel):
                    note = f"{stamps.name!r} is the time of {channel.group_name!r}"
                    t = stamps[:]
                    if stamps.dtype.kind == "M":
                        begin, t = t[0], (t - t[0]) / np.timedelta64(1, "s")
                    else:
                        t = t * time_unit(t, _named(stamps)).seconds
                else:
                    found[name] = (
                        "has neither wf_increment nor a channel of times beside it, so its times "
                        "are not known; export it as text, and give fs"
                    )
                    continue
                if begin is not None:
                    begins[name] = int(np.datetime64(begin, "us").astype(np.int64))
                unit = str(told.get("unit_string", ""))
                found[name] = Series(t, channel[:].astype(np.float64), unit, note)
    first = min(begins.values(), default=0)  # counted from 1970, times would lose digits
    for name, begin in begins.items():
        series = found[name]
        if isinstance(series, Series):
            found[name] = series._replace(t=series.t + 1e-6 * (begin - first))
    return found


def _named(channel: Any) -> Channel:
    """Name and unit of a channel of TDMS."""
    return Channel(channel.name, str(channel.properties.get("unit_string", "")))


def _is_clock(channel: Any) -> bool:
    """Tell whether a channel of TDMS has time stamps, or is named as time is."""
    kind = channel.dtype.kind
    return kind == "M" or (kind in "iuf" and is_time(_named(channel)))


def _uff(path: Path) -> dict[str, Series]:
    """The functions of data sets 58 over time, by their labels or nodes."""
    pyuff = optional("pyuff")
    sets = pyuff.UFF(str(path))
    found: dict[str, Series] = {}
    kinds = sets.get_set_types()
    for number in (i for i, kind in enumerate(kinds) if kind == 58):
        one = sets.read_sets(number)
        if one["func_type"] not in (0, 1) or np.iscomplexobj(one["data"]):
            continue  # spectra and responses
        label = one["id1"].strip()
        name = label if label not in ("", "NONE") else f"{one['rsp_node']}:{one['rsp_dir']}"
        name = name if name not in found else f"{name} [{number}]"
        unit = str(one.get("ordinate_axis_units_lab", "")).strip()
        T = int(one["num_pts"])  # zeros may fill the last line
        found[name] = Series(
            np.asarray(one["x"])[:T], np.asarray(one["data"])[:T], "" if unit == "NONE" else unit
        )
    return found


def _mcap(path: Path) -> dict[str, Series]:
    """Fields of messages in JSON or of ROS 2, by topic and name, at the times of their logging."""
    reader = optional("mcap.reader")

    def messages() -> Iterator[tuple[str, int, Any]]:
        stores: dict[int, Callable[[bytes], Any]] = {}
        with path.open("rb") as file:
            for schema, channel, message in reader.make_reader(file).iter_messages(
                log_time_order=False  # else a clock that is set back shuffles them
            ):
                if channel.id not in stores:
                    stores[channel.id] = _decoder(schema, channel.message_encoding)
                yield channel.topic, message.log_time, stores[channel.id](message.data)

    return _fields(messages())


def _decoder(schema: Any, encoding: str) -> Callable[[bytes], Any]:
    """Make a decoder of the bytes of a message."""
    if encoding == "json":
        return json.loads
    if encoding == "cdr" and schema is not None and schema.encoding == "ros2msg":
        typesys = optional("rosbags.typesys")
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        _learn(store, schema.data.decode(), schema.name)
        return lambda data: store.deserialize_cdr(data, schema.name)
    return lambda data: None  # a topic in another encoding has no channels


def _learn(store: Any, definition: str, name: str) -> None:
    """Let a store of message types know a type, and the types that it is made of."""
    known = optional("rosbags.typesys").get_types_from_msg(definition, name)
    store.register({each: one for each, one in known.items() if each not in store.types})


def _bag(path: Path) -> dict[str, Series]:
    """The same for a ROS 2 bag in sqlite, whose folder has metadata.yaml."""
    rosbag2, typesys = optional("rosbags.rosbag2"), optional("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)

    def messages() -> Iterator[tuple[str, int, Any]]:
        with rosbag2.Reader(path.parent) as bag:
            for connection in bag.connections:
                if connection.msgdef.data:
                    _learn(store, connection.msgdef.data, connection.msgtype)
            for connection, time, data in bag.messages():
                yield connection.topic, time, store.deserialize_cdr(data, connection.msgtype)

    return _fields(messages())


def _fields(messages: Iterable[tuple[str, int, Any]]) -> dict[str, Series]:
    """The numbers of messages as channels; seconds count from the first message."""
    columns: dict[str, tuple[list[int], list[float]]] = {}
    for topic, time, message in messages:
        for name, value in _numbers(message, topic.strip("/")):
            times, values = columns.setdefault(name, ([], []))
            times.append(time)
            values.append(value)
    first = min((min(times) for times, _ in columns.values()), default=0)
    return {
        name: Series((np.array(times) - first) * _NANOSECONDS, np.array(values))
        for name, (times, values) in columns.items()
    }


def _numbers(value: Any, name: str) -> Iterator[tuple[str, float]]:
    """The numbers in a message with their names, as ``imu.linear_acceleration.x``."""
    if isinstance(value, Real):
        yield name, float(value)
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _numbers(inner, f"{name}.{key}")
    elif is_dataclass(value):
        for field in fields(value):
            if field.name not in ("header", "__msgtype__"):
                yield from _numbers(getattr(value, field.name), f"{name}.{field.name}")
    elif isinstance(value, list | tuple | np.ndarray) and len(value) <= _LONGEST:
        for i, inner in enumerate(value):
            yield from _numbers(inner, f"{name}[{i}]")


READERS: dict[str, Callable[[Path], Table]] = {
    **dict.fromkeys((".mf4", ".mdf"), _reader(_mdf, "MDF")),
    ".tdms": _reader(_tdms, "TDMS"),
    ".mcap": _reader(_mcap, "MCAP"),
    ".db3": _reader(_bag, "ROS 2 bag"),
    **dict.fromkeys((".uff", ".unv"), _reader(_uff, "UFF")),
}
"""Readers by extension; ``#50Hz`` after the path interpolates all channels to one clock."""
