"""ROS bags and MCAP: `sensor_msgs/Imu` with a `sensor_msgs/Temperature` of its own clock.

Bags of ROS 1 (.bag) and ROS 2 (a folder, or its .db3 or .mcap) are read by rosbags, .mcap files by mcap. The messages
are decoded here, all of a topic at once, by the layouts of ROS 1 (https://wiki.ros.org/msg) and of CDR as ROS 2
writes it (https://design.ros2.org/articles/generated_interfaces_cpp.html; OMG DDSI-RTPS, clause 10):

    ROS 1    seq u32, stamp u32 s u32 ns, frame_id (length u32, bytes), then the fields without gaps
    ROS 2    4 bytes of representation, stamp i32 s u32 ns, frame_id (length u32 with the final 0), then the fields,
             each at a multiple of its size from the fourth byte on
    Imu      orientation 4 f64, its covariance 9 f64, angular_velocity 3 f64 (rad/s), …
    Temperature   temperature f64 (°C), variance f64

A message does not tell whether a driver has subtracted a bias: this is noted. Topics of mavros come from MAVLink, whose
rates are the estimator's, and are refused.
"""

import itertools
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.records.log import Floats, LogError, library
from gradcal_jax.records.vehicle.streams import GyroStream, interpolated

_IMU: Final = ("sensor_msgs/msg/Imu", "sensor_msgs/Imu")
_TEMPERATURE: Final = ("sensor_msgs/msg/Temperature", "sensor_msgs/Temperature")
_SAME_CLOCK_S: Final = 1.0
"""If the stamps of the header differ from the receiver's by less than this (median), both are from one clock."""


@dataclass
class _Topic:
    """Raw messages of a topic, with the receiver's stamps in ns."""

    name: str
    cdr: bool
    messages: list[bytes] = field(default_factory=list[bytes])
    received_ns: list[int] = field(default_factory=list[int])


def gyros(path: Path) -> Sequence[GyroStream]:
    """Every topic of `sensor_msgs/Imu` by its name, with the temperature whose topic is nearest in name."""
    imus, temperatures = _from_mcap(path) if path.suffix.lower() == ".mcap" else _from_bag(path)
    if not imus:
        raise LogError("the file has no topic of the type sensor_msgs/Imu")
    raw = [topic for topic in imus if "mavros" not in topic.name]
    if not raw:
        raise LogError(
            f"{imus[0].name} comes from MAVLink: its rates are not the sensor's output, because the bias that the "
            "flight controller's estimator determines is subtracted; use the flight controller's own log"
        )
    return [_stream(topic, temperatures) for topic in raw]


def _stream(topic: _Topic, temperatures: Sequence[_Topic]) -> GyroStream:
    stamps, values = _decoded(topic, first=13, count=3)
    received = np.array(topic.received_ns, np.int64)
    notes = [f"{topic.name}: a ROS message does not state whether the driver has subtracted a bias from the rates"]
    if not stamps.any():
        stamps = received
        notes.append(f"{topic.name} has no time stamps of its own: those of the receiver are used")
    time: Floats = (stamps - stamps[0]).astype(np.float64) * 1e-9
    host: Floats = (received - received[0]).astype(np.float64) * 1e-9
    temperature = _temperature(topic.name, time, stamps, received, temperatures)
    return GyroStream(topic.name, time, values, temperature, host, tuple(notes))


def _temperature(
    name: str, time: Floats, stamps: NDArray[np.int64], received: NDArray[np.int64], topics: Sequence[_Topic]
) -> Floats | None:
    near = sorted(topics, key=lambda topic: _shared(topic.name, name), reverse=True)
    if not near or (len(near) > 1 and _shared(near[1].name, name) == _shared(near[0].name, name)):
        return None
    of_stamps, values = _decoded(near[0], first=0, count=1)
    of_received = np.array(near[0].received_ns, np.int64)
    # By the receiver's clock, which both topics have, if their own clocks are two.
    late, of_late = (float(np.median((a - b) * 1e-9)) for a, b in ((received, stamps), (of_received, of_stamps)))
    ours = of_stamps if abs(late - of_late) < _SAME_CLOCK_S else of_received - np.int64(late * 1e9)
    return interpolated(time, (ours - stamps[0]) * 1e-9, values[:, 0])


def _shared(name: str, other: str) -> int:
    """The number of equal parts at the beginning of two topics' names."""
    pairs = zip(name.split("/"), other.split("/"), strict=False)
    return sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], pairs))


def _decoded(topic: _Topic, *, first: int, count: int) -> tuple[NDArray[np.int64], Floats]:
    """Stamps (ns) and `count` numbers from the field `first` on, of every message of a topic."""
    stamps = np.zeros(len(topic.messages), np.int64)
    values = np.full((len(topic.messages), count), np.nan)
    sizes = np.array([len(message) for message in topic.messages])
    for size in np.unique(sizes).tolist():
        rows = np.flatnonzero(sizes == size)
        table = np.frombuffer(b"".join(topic.messages[row] for row in rows.tolist()), np.uint8).reshape(-1, size)
        if topic.cdr and not np.all(table[:, 1] & 1):
            raise LogError(f"{topic.name} is big-endian, which is not supported")
        at = 4  # behind seq, or behind the representation
        seconds = _numbers(table, at, "<i4" if topic.cdr else "<u4", 1)[:, 0].astype(np.int64)
        stamps[rows] = seconds * 1_000_000_000 + _numbers(table, at + 4, "<u4", 1)[:, 0].astype(np.int64)
        names = _numbers(table, at + 8, "<u4", 1)[:, 0]
        for length in np.unique(names).tolist():
            same = names == length
            fields = at + 12 + int(length)
            if topic.cdr:
                fields += -(fields - 4) % 8
            values[rows[same]] = _numbers(table[same], fields + 8 * first, "<f8", count)
    return stamps, values


def _numbers(table: NDArray[np.uint8], at: int, kind: str, count: int) -> NDArray[Any]:
    size = np.dtype(kind).itemsize * count
    if at + size > table.shape[1]:
        raise LogError("a message is shorter than its type requires")
    return np.ascontiguousarray(table[:, at : at + size]).view(kind)


def _gather(
    messages: Iterator[tuple[str, str, bool, int, bytes]],
) -> tuple[list[_Topic], list[_Topic]]:
    """(topic, type, whether CDR, received ns, bytes) -> topics of Imu, and of Temperature."""
    topics: dict[tuple[str, str], _Topic] = {}
    for name, kind, cdr, received, content in messages:
        topic = topics.setdefault((name, kind), _Topic(name, cdr))
        topic.messages.append(content)
        topic.received_ns.append(received)
    imus = [topic for (_, kind), topic in topics.items() if kind in _IMU]
    return imus, [topic for (_, kind), topic in topics.items() if kind in _TEMPERATURE]


def _from_bag(path: Path) -> tuple[list[_Topic], list[_Topic]]:
    reader: Any = library("rosbags.highlevel", "rosbags").AnyReader
    stores: Any = library("rosbags.typesys", "rosbags")
    folder = path.parent if path.suffix.lower() == ".db3" else path
    if folder.is_dir() and not (folder / "metadata.yaml").exists():
        raise LogError("a bag of ROS 2 is a folder with metadata.yaml, which is missing here")
    with reader([folder], default_typestore=stores.get_typestore(stores.Stores.ROS2_HUMBLE)) as bag:
        wanted = [one for one in bag.connections if one.msgtype in (*_IMU, *_TEMPERATURE)]
        cdr = folder.suffix.lower() != ".bag"
        rows = bag.messages(connections=wanted) if wanted else ()
        return _gather((one.topic, one.msgtype, cdr, stamp, bytes(content)) for one, stamp, content in rows)


def _from_mcap(path: Path) -> tuple[list[_Topic], list[_Topic]]:
    make_reader: Callable[..., Any] = library("mcap.reader", "mcap").make_reader
    with path.open("rb") as opened:
        bag = make_reader(opened)
        summary = bag.get_summary()
        wanted = None
        if summary is not None:
            kinds = {number: schema.name for number, schema in summary.schemas.items()}
            chosen = [c for c in summary.channels.values() if kinds.get(c.schema_id) in (*_IMU, *_TEMPERATURE)]
            strange = sorted({c.message_encoding for c in chosen} - {"cdr", "ros1"})
            if strange:
                raise LogError(f"its messages are encoded as {', '.join(strange)}; this program reads cdr and ros1")
            wanted = [channel.topic for channel in chosen]
            if not wanted:
                return [], []
            if summary.chunk_indexes and summary.statistics is not None:
                named = {c.id: (c.topic, kinds[c.schema_id], c.message_encoding == "cdr") for c in chosen}
                topics = _gather(
                    (*named[number], ns, data) for number, ns, data in _of_chunks(opened, summary, set(named))
                )
                counts = summary.statistics.channel_message_counts
                if sum(len(t.messages) for part in topics for t in part) == sum(counts.get(n, 0) for n in named):
                    return topics
        rows = bag.iter_messages(topics=wanted, log_time_order=False)
        return _gather(
            (channel.topic, schema.name, channel.message_encoding == "cdr", message.log_time, message.data)
            for schema, channel, message in rows
            if schema is not None and channel.message_encoding in ("cdr", "ros1")
        )


_RECORD: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<HIQQ")


def _of_chunks(opened: BinaryIO, summary: Any, wanted: set[int]) -> Iterator[tuple[int, int, bytes]]:
    """(channel, stamp of the receiver in ns, bytes) of the messages in the chunks that the summary lists.

    The library makes an object of every message, for half a minute of an hour at 1 kHz; here it unpacks the chunks, and
    the messages (opcode 5: channel u16, sequence u32, two stamps u64, then the data) are cut out.
    """
    records: Any = library("mcap.records", "mcap")
    chunks: Any = library("mcap.stream_reader", "mcap")
    streams: Any = library("mcap.data_stream", "mcap")
    for index in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
        opened.seek(index.chunk_start_offset + _RECORD.size)
        stream, size = chunks.get_chunk_data_stream(records.Chunk.read(streams.ReadDataStream(opened)))
        content, at = stream.read(size), 0
        while at < size:
            kind, length = _RECORD.unpack_from(content, at)
            at += _RECORD.size
            if kind == 5:
                channel, _, stamp, _ = _MESSAGE.unpack_from(content, at)
                if channel in wanted:
                    yield channel, stamp, content[at + _MESSAGE.size : at + length]
            at += length
