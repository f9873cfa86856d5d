"""The roles of devices: a chamber, axes of motion (driven, or turned by hand), a stream of an IMU; changed settings.

The roles are `typing` protocols: a driver has the methods and inherits nothing. Units are in the names: temperatures in
°C (`_c`), angles in degrees (`_deg`), rates in deg/s (`_dps`).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.hardware.errors import HardwareError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]
STANDARD_GRAVITY = 9.80665  # m/s² in one g of every data sheet here


class KeptSettings:
    """The settings of one device that its driver changes, by the driver's names, in the device's own spelling of the
    values: those before are kept, and restored at the end, by another process (`on_first_change`) where this one ends.

    `read` asks the device, `write` returns only when the device shows the new value, and `same` compares two values.
    """

    def __init__(
        self,
        read: Callable[[str], str] = str,
        write: Callable[[str, str], object] = lambda name, value: None,
        same: Callable[[str, str], bool] = str.__eq__,
    ) -> None:
        self._read, self._write, self._same = read, write, same
        self.before: dict[str, str] = {}
        self.on_first_change: Callable[[str, str], None] = lambda name, value: None

    def change(self, name: str, value: str) -> None:
        """Change a setting, unless it has that value already."""
        shown = self._read(name)
        if self._same(shown, value):
            return
        if name not in self.before:
            self.before[name] = shown
            self.on_first_change(name, shown)
        self._write(name, value)

    def keep(self, before: Mapping[str, str]) -> None:
        """Take over the values kept by another process."""
        self.before = {**before, **self.before}

    def put_back(self) -> None:
        """Restore every setting, the last change first. All are tried; raises the first problem."""
        problem: HardwareError | None = None
        for name, value in reversed(list(self.before.items())):
            try:
                if not self._same(self._read(name), value):
                    self._write(name, value)
                del self.before[name]
            except HardwareError as error:
                problem = problem or error
        if problem is not None:
            raise problem


@dataclass(frozen=True)
class Identity:
    """A device's identity: compared with the rig file before a run and with the journal when one resumes."""

    driver: str
    model: str
    serial_number: str = ""
    firmware: str = ""


@dataclass(frozen=True)
class ChamberLimits:
    """The limits that the chamber reports. Ramps are rounded to steps of a rate, where not 0."""

    lowest_c: float
    highest_c: float
    hardware_ramp: bool
    slowest_ramp_k_per_min: float = 0.0
    fastest_ramp_k_per_min: float = float("inf")
    ramp_step_k_per_min: float = 0.0

    def beyond(self, temperature_c: float, ramp_k_per_min: float | None = None) -> list[str]:
        """What of a command is beyond the limits, a sentence without its subject each."""
        lowest, highest = self.lowest_c, self.highest_c
        slowest, fastest = max(self.slowest_ramp_k_per_min, 1e-9), self.fastest_ramp_k_per_min
        problems: list[str] = []
        if not lowest <= temperature_c <= highest:
            problems.append(f"sets {temperature_c:g} degC; the chamber accepts {lowest:g} to {highest:g}.")
        if ramp_k_per_min is not None and self.hardware_ramp and not slowest <= ramp_k_per_min <= fastest:
            problems.append(f"ramps at {ramp_k_per_min:g} K/min; the chamber accepts {slowest:g} to {fastest:g}.")
        return problems


@dataclass(frozen=True)
class ChamberReading:
    """One reading; `setpoint_c` is the controller's present set point (it moves while a ramp runs)."""

    time_s: float
    air_c: float
    product_c: float | None
    setpoint_c: float
    mode: str
    conditioning: bool
    alarms: tuple[str, ...]


@dataclass(frozen=True)
class SafeReport:
    """Whether the read-back after `safe()` shows the safe state."""

    verified: bool
    evidence: str


@runtime_checkable
class TemperatureChamber(Protocol):
    """Every command returns only after the read-back has shown it; else it raises `NotVerified`."""

    def identify(self) -> Identity: ...
    def limits(self) -> ChamberLimits: ...
    def read(self) -> ChamberReading: ...
    def hold(self, temperature_c: float) -> None:
        """Condition at `temperature_c`, as fast as the chamber can. Starts the chamber."""

    def set_point(self, temperature_c: float) -> None:
        """Change the set point. Starts nothing: a chamber that is off stays off."""

    def ramp(self, temperature_c: float, rate_k_per_min: float) -> float:
        """Go to `temperature_c` at `rate_k_per_min` (above zero), by the controller's own ramp. Starts the chamber.

        Returns the rate after rounding to the controller's resolution, K/min.
        """
        ...

    def standby(self) -> None: ...
    def safe(self, policy: str, ambient_c: float = 23.0) -> SafeReport:
        """Bring it to the safe state `policy` of the rig file. Starts nothing: a chamber that is off is safe."""
        ...


@dataclass(frozen=True)
class AxisLimits:
    """The axis's limits. Travel is None for an endless axis; accelerations are multiples of `acceleration_step_dps2`
    (0: any). `by_hand`: the operator turns it; `typed`: and types its angle; `told`: nothing reads the angle, and a
    reading is where the axis was told to go."""

    max_rate_dps: float
    max_acceleration_dps2: float
    lowest_deg: float | None
    highest_deg: float | None
    resolution_deg: float
    by_hand: bool = False
    acceleration_step_dps2: float = 0.0
    typed: bool = False
    told: bool = False

    @property
    def travel_deg(self) -> tuple[float, float]:
        """Infinite where it has no end."""
        lowest, highest = self.lowest_deg, self.highest_deg
        return -math.inf if lowest is None else lowest, math.inf if highest is None else highest

    def beyond(self, rate_dps: float, acceleration_dps2: float, position_deg: float | None = None) -> list[str]:
        """What of a command is beyond the limits, a sentence without its subject each."""
        fastest, strongest = self.max_rate_dps, self.max_acceleration_dps2
        lowest, highest = self.travel_deg
        problems: list[str] = []
        if not 0.0 < rate_dps <= fastest * (1.0 + 1e-9):
            problems.append(f"turns at {rate_dps:g} deg/s; the axis accepts up to {fastest:g}.")
        if not 0.0 < acceleration_dps2 <= strongest * (1.0 + 1e-9):
            problems.append(f"accelerates at {acceleration_dps2:g} deg/s²; the axis accepts up to {strongest:g}.")
        if position_deg is not None and not lowest - 1e-6 <= position_deg <= highest + 1e-6:
            problems.append(f"goes to {position_deg:g} deg; its travel is {lowest:g} to {highest:g} deg.")
        return problems


@dataclass(frozen=True)
class AxisReading:
    """One reading. `position_deg` is unwrapped: it counts over whole turns; NaN while it is unknown."""

    time_s: float
    position_deg: float
    rate_dps: float
    moving: bool
    referenced: bool
    faults: tuple[str, ...]


@runtime_checkable
class MotionAxis(Protocol):
    settings: KeptSettings

    def identify(self) -> Identity: ...
    def limits(self) -> AxisLimits: ...
    def read(self) -> AxisReading: ...
    def home(self) -> None:
        """Find the reference; returns at the end, raises `DeviceFault` on failure."""

    def move_to(self, position_deg: float, rate_dps: float, acceleration_dps2: float) -> None:
        """Start a trapezoidal move to an absolute position and return at once; `read().moving` shows its end."""

    def spin(self, rate_dps: float, acceleration_dps2: float) -> None:
        """Start turning at a signed constant rate and return at once."""

    def stop(self) -> None:
        """Controlled stop; returns when the axis stands."""

    def safe(self, policy: str) -> SafeReport:
        """Bring it to the safe state `policy` of the rig file, from a controlled stop."""
        ...


class OperatorAsked(Protocol):
    """A person at a terminal, who is asked one question at a time."""

    def ask(self, question: str) -> None: ...
    def answer(self) -> tuple[str, float] | None:
        """The typed line and the time of its end; None until there is one."""

    def withdraw(self, why: str) -> None:
        """Take back a question, if there is one."""


@dataclass(frozen=True)
class ImuSettings:
    """The unit's configuration, read back, for the log."""

    sample_rate_hz: float
    registers: dict[str, str]


@dataclass(frozen=True)
class ImuBatch:
    """Samples decoded together. `n` of them, three axes; a quantity that the unit does not send is NaN.

    host_time_s     (n,)   clock of the run when the last byte of the sample was in hand
    device_time_s   (n,)   the unit's own time, unwrapped, from its counter or clock
    gyro_dps        (n, 3) angular rate, deg/s
    acceleration_g  (n, 3) specific force, in g0 = 9.80665 m/s²
    temperature_c   (n, 3) of the gyro axes
    status          (n,)   status bits, 0 = good; the meaning is the driver's
    gap_before      (n,)   number of samples missing just before this one, as far as the decoder has seen
    disturbed       (n,)   whether bytes just before it belong to no sound frame; False where stamps are absolute
    restarted       (n,)   whether the IMU restarted before it, so that its own time is not continuous
    """

    host_time_s: Floats
    device_time_s: Floats
    gyro_dps: Floats
    acceleration_g: Floats
    temperature_c: Floats
    status: Integers
    gap_before: Integers
    disturbed: Flags
    restarted: Flags

    def __len__(self) -> int:
        return self.host_time_s.shape[0]


def join(batches: Sequence[ImuBatch]) -> ImuBatch:
    """One batch of several; an empty one of none."""
    if not batches:
        times, vectors, numbers, flags = np.zeros(0), np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.bool_)
        return ImuBatch(times, times, vectors, vectors, vectors, numbers, numbers, flags, flags)
    names = ImuBatch.__dataclass_fields__
    return ImuBatch(**{name: np.concatenate([getattr(batch, name) for batch in batches]) for name in names})


class ImuDecoder(Protocol):
    """Pure: the samples depend on the bytes and their stamps only, not on how the stream was cut."""

    resolution_s: float
    """Resolution of the IMU's own time stamps."""
    sample_s: float
    """Sampling interval by the IMU's own clock."""
    round_samples: int
    """The number of samples after which the IMU's counter wraps; 0 if its time stamps are absolute."""

    def push(self, data: bytes, host_time_s: float) -> ImuBatch: ...

    @property
    def bad_bytes(self) -> int:
        """Bytes outside sound frames, which are ignored."""
        ...


@runtime_checkable
class ImuStream(Protocol):
    """A unit that streams; it has no unsafe state."""

    def identify(self) -> Identity: ...
    def configure(self) -> ImuSettings:
        """Bring the unit to the profile of the rig file, verify by read-back; nothing is saved to its flash."""
        ...

    def start(self) -> None: ...
    def read_bytes(self, timeout_s: float) -> tuple[bytes, float]:
        """Raw bytes of the stream with their time: they go to disk before they are decoded."""
        ...

    def decoder(self) -> ImuDecoder:
        """A new decoder for this unit's settings."""
        ...
