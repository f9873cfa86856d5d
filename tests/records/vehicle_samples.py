"""Logs of vehicles for the tests: ULog and DataFlash byte by byte, as they are described."""

import struct

import numpy as np


def framed(kind, payload):
    return struct.pack("<HB", len(payload), ord(kind)) + payload


_ULOG_TYPES = {"u8": "uint64_t", "u4": "uint32_t", "f4": "float", "u1": "uint8_t", "i2": "int16_t"}


def ulog(path, *topics):
    """Topics: (name, instance, structured array without gaps). https://docs.px4.io/main/en/dev_log/ulog_file_format"""
    content = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1_000_000), framed("B", bytes(40))]
    for name in dict.fromkeys(name for name, _, _ in topics):
        rows = next(rows for other, _, rows in topics if other == name)
        fields = []
        for field in rows.dtype.names:
            kind, shape = rows.dtype[field].base.str[1:], rows.dtype[field].shape
            fields.append(_ULOG_TYPES[kind] + (f"[{shape[0]}]" if shape else "") + " " + field)
        content.append(framed("F", f"{name}:{';'.join(fields)};".encode()))
    content += [
        framed("A", struct.pack("<BH", instance, number) + name.encode())
        for number, (name, instance, _) in enumerate(topics)
    ]
    for number, (_, _, rows) in enumerate(topics):
        size = rows.dtype.itemsize
        head = np.dtype([("size", "<u2"), ("kind", "u1"), ("number", "<u2"), ("data", f"V{size}")])
        messages = np.zeros(len(rows), head)
        messages["size"], messages["kind"], messages["number"] = size + 2, ord("D"), number
        messages["data"] = np.ascontiguousarray(rows).view(f"V{size}")
        content.append(messages.tobytes())
    path.write_bytes(b"".join(content))
    return path


def sensor_gyro(stamps_us, rate, temperature, device):
    rows = np.zeros(
        len(stamps_us),
        [("timestamp", "<u8"), ("timestamp_sample", "<u8"), ("device_id", "<u4"), ("x", "<f4"), ("y", "<f4"),
         ("z", "<f4"), ("temperature", "<f4"), ("error_count", "<u4")],
    )  # fmt: skip
    rows["timestamp"], rows["timestamp_sample"] = np.asarray(stamps_us) + 150, stamps_us
    rows["device_id"], rows["temperature"] = device, temperature
    for axis, name in enumerate("xyz"):
        rows[name] = rate[:, axis]
    return rows


IMU_FIELDS = [
    ("TimeUS", "<u8", "Q"), ("I", "u1", "B"), ("GyrX", "<f4", "f"), ("GyrY", "<f4", "f"), ("GyrZ", "<f4", "f"),
    ("AccX", "<f4", "f"), ("AccY", "<f4", "f"), ("AccZ", "<f4", "f"), ("EG", "<u4", "I"), ("EA", "<u4", "I"),
    ("T", "<f4", "f"),
]  # fmt: skip


def _format_message(number, length, name, letters, columns):
    return b"\xa3\x95\x80" + struct.pack(
        "<BB4s16s64s", number, length, name.encode(), letters.encode(), ",".join(columns).encode()
    )


def dataflash(path, imu, parameters, start_us=0):
    """`imu`: a structured array of `IMU_FIELDS`; `parameters`: (time in µs, name, value), or names with values."""
    if isinstance(parameters, dict):
        parameters = [(start_us, name, value) for name, value in parameters.items()]
    letters, names = "".join(f[2] for f in IMU_FIELDS), [f[0] for f in IMU_FIELDS]
    size = imu.dtype.itemsize
    content = [
        _format_message(128, 89, "FMT", "BBnNZ", ["Type", "Length", "Name", "Format", "Columns"]),
        _format_message(64, 3 + 28, "PARM", "QNf", ["TimeUS", "Name", "Value"]),
        _format_message(65, 3 + size, "IMU", letters, names),
    ]
    content += [b"\xa3\x95\x40" + struct.pack("<Q16sf", time, name.encode(), value) for time, name, value in parameters]
    messages = np.zeros(len(imu), [("head", "V3"), ("data", f"V{size}")])
    messages["head"], messages["data"] = np.void(b"\xa3\x95\x41"), np.ascontiguousarray(imu).view(f"V{size}")
    path.write_bytes(b"".join([*content, messages.tobytes()]))
    return path


def at_rest(rows):
    """Specific forces of a vehicle at rest, m/s²."""
    return np.array([0.3, -0.2, 9.8]) + 0.02 * np.random.default_rng(rows).standard_normal((rows, 3))


def imu_rows(time_us, which, rate, temperature, force=None):
    rows = np.zeros(len(time_us), [(name, kind) for name, kind, _ in IMU_FIELDS])
    rows["TimeUS"], rows["I"], rows["T"] = time_us, which, temperature
    for axis, letter in enumerate("XYZ"):
        rows[f"Gyr{letter}"] = rate[:, axis]
        rows[f"Acc{letter}"] = (at_rest(len(rows)) if force is None else force)[:, axis]
    return rows
