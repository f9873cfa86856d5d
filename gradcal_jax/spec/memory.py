"""Memory that a spec's prediction needs, estimated from the file, to refuse plans that exceed the machine's."""

import contextlib
import math
from typing import Final

from gradcal_jax.spec.schedule import StandardSchedule, row_count
from gradcal_jax.spec.spec_sections import Spec

# For the whitened rows and their computation, by reading and column; measured: 2.6 kB a reading with 39 columns.
_BYTES: Final = 68.0


def needed_bytes(spec: Spec) -> float:
    """Memory that a prediction of the spec takes beside the program's own, to a factor of two."""
    schedule, gyro, forces = spec.schedule, spec.sensor.gyro, spec.sensor.accelerometer
    readings = schedule.readings if isinstance(schedule, StandardSchedule) else row_count(schedule, spec.rig.table)
    columns = 4 + 2 * sum(len(axis.angle.harmonics) for axis in spec.rig.table.axis)
    for triad in (gyro, forces):
        if triad is not None:
            maps = (getattr(part, "size", 1) for part in (triad.bias, triad.scale_factor) if part is not None)
            columns += len(triad.axes) * (sum(maps) + len(triad.drift) + len(triad.scale_factor_instability))
    return _BYTES * readings * columns * sum(len(t.axes) for t in (gyro, forces) if t is not None)


def available_bytes() -> float:
    """Memory that this machine can give; infinite where it does not say."""
    # Linux caches files in unused memory and releases it: "free" alone would be far too little.
    with contextlib.suppress(OSError, ValueError), open("/proc/meminfo", encoding="ascii") as lines:
        for name, amount, *_ in map(str.split, lines):
            if name == "MemAvailable:":
                return 1024.0 * float(amount)
    return math.inf


def too_large(spec: Spec) -> str:
    """A sentence where the spec's readings need more memory than there is; empty otherwise."""
    needed, there = needed_bytes(spec), available_bytes()
    if needed <= there:
        return ""
    return (
        f"the plan's readings need about {needed / 1e9:.3g} GB of memory, and this computer has {there / 1e9:.3g} "
        "GB free: increase read_every, or plan fewer cycles"
    )
