"""Every byte of a bench with its time, line and direction, in one file: bug report, evidence, a test that is replayed.

One line of text a chunk, append-only, readable without this program:

    # gradcal-transcript/1
    # rig: {"format": "gradcal-rig/1", …}
    12.345678 /dev/ttyUSB0 > TEMP?\\r\\n
    12.361402 /dev/ttyUSB0 < 26.4,0.0,140.0,-50.0\\r\\n
    12.361988 chamber # limits: ChamberLimits(…)

`>` goes to the device, `<` comes from it, `#` is what a driver made of it; seconds are those of the clock of the run.
Bytes other than printable ASCII are written `\\xNN`, `\\r`, `\\n`, the backslash itself `\\\\`.
"""

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TextIO

from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.errors import HardwareError, printable
from gradcal_jax.hardware.guard import put_back
from gradcal_jax.hardware.journal import Direction, Recorder
from gradcal_jax.hardware.roles import AxisSafe, ChamberSafe
from gradcal_jax.hardware.setup import Bench, open_rig
from gradcal_jax.spec.rig import RigFile

HEADER = "# gradcal-transcript/1"
RIG = "# rig: "
_STREAM_S = 2.0
# Of a move that shows that commands take effect: small, slow.
_MOVE_DEG, _MOVE_DPS, _MOVE_DPS2 = 10.0, 10.0, 20.0


class Transcript(AbstractContextManager["Transcript"]):
    """Append-only file. Each chunk reaches the operating system before it returns."""

    def __init__(self, path: Path, rig: RigFile | None = None) -> None:
        fresh = not path.exists() or path.stat().st_size == 0
        self._file: TextIO = path.open("a", encoding="ascii", errors="backslashreplace", newline="\n")
        self._lock = threading.Lock()
        if fresh:
            self._file.write(HEADER + "\n")
        if rig is not None:
            self._file.write(RIG + json.dumps(rig.model_dump(mode="json", exclude_unset=True)) + "\n")
        self._file.flush()

    def recorder(self, line: str) -> Recorder:
        return partial(self._write, line)

    def note(self, time_s: float, device: str, text: str) -> None:
        self._write(device, time_s, "#", text.encode("utf-8"))

    def _write(self, line: str, time_s: float, direction: Direction, data: bytes) -> None:
        with self._lock:
            if not self._file.closed:
                self._file.write(f"{time_s:.6f} {line} {direction} {printable(data, len(data))}\n")
                self._file.flush()

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._file.close()


def conversation(bench: Bench, clock: Clock, *, move: bool) -> Iterator[tuple[str, str, str]]:
    """Device, call and outcome of all that shows whether a driver fits its device. Nothing moves without `move`."""

    def outcome(call: Callable[[], object]) -> str:
        try:
            result = call()
        except HardwareError as problem:
            return f"{type(problem).__name__}: {problem}"
        # Times differ from one conversation to the next.
        return repr(replace(result, time_s=0.0) if hasattr(result, "time_s") else result)  # pyright: ignore[reportArgumentType, reportUnknownArgumentType, reportCallIssue]

    if (chamber := bench.chamber) is not None:
        for name in ("identify", "limits", "read"):
            yield "chamber", name, outcome(getattr(chamber, name))
        if move:
            at_c = 23.0
            with suppress(HardwareError):
                at_c = round(chamber.read().air_c)
            yield "chamber", "hold", outcome(lambda: chamber.hold(at_c))
            yield "chamber", "read", outcome(chamber.read)
            safe = ChamberSafe(bench.rig.chamber.safe) if bench.rig.chamber is not None else ChamberSafe.HOLD
            yield "chamber", "safe", outcome(lambda: chamber.safe(safe, at_c))
    for entry in bench.rig.axis:
        axis = bench.axes[entry.name]
        for name in ("identify", "limits", "read"):
            yield entry.name, name, outcome(getattr(axis, name))
        if move:
            yield entry.name, "home", outcome(axis.home)
            for goal in (_MOVE_DEG, 0.0):
                yield entry.name, f"move_to {goal:g}", outcome(partial(axis.move_to, goal, _MOVE_DPS, _MOVE_DPS2))
                clock.sleep(_MOVE_DEG / _MOVE_DPS + 2.0)
                yield entry.name, "read", outcome(axis.read)
            yield entry.name, "safe", outcome(partial(axis.safe, AxisSafe(entry.safe)))
    for entry in bench.rig.imu:
        unit = bench.imus[entry.name]
        for name in ("identify", "configure", "start"):
            yield entry.name, name, outcome(getattr(unit, name))
        ends_s = clock.now() + _STREAM_S
        while clock.now() < ends_s:
            clock.sleep(0.05)
            unit.read_bytes(0.0)


def record_bench(rig: RigFile, path: Path, clock: Clock, *, move: bool = False) -> list[tuple[str, str, str]]:
    """Talk to all devices of a rig and keep every byte. Returns device, call and outcome; raises `HardwareError` where
    a port cannot be opened."""
    said: list[tuple[str, str, str]] = []
    with Transcript(path, rig) as transcript, open_rig(rig, clock, transcript.recorder) as bench, clock.party():
        try:
            for device, call, text in conversation(bench, clock, move=move):
                transcript.note(clock.now(), device, f"{call}: {text}")
                said.append((device, call, text))
        finally:
            for device, problem in put_back(bench).items():
                transcript.note(clock.now(), device, f"settings put back: {problem or 'all'}")
    return said
