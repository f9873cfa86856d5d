"""Errors between the program and a device, classified by the possible response.

Reads may be repeated after `ReplyTimeout` and `FramingError`. Writes are repeated only after a
read-back has shown that they did not take effect. `Rejected` and `DeviceFault` are statements of the device and are
never repeated blindly. Every message says what was observed and what to do.
"""


def printable(data: bytes, limit: int = 160) -> str:
    """Bytes as text for a message: printable ASCII as it is, the rest as Python writes it, cut at `limit` bytes."""
    text = repr(data[:limit])[2:-1]
    return text + (f"… ({len(data)} bytes)" if len(data) > limit else "")


class HardwareError(Exception):
    """Any failure of a port, a device or a run. The message is for the operator."""


def sentence_of(problem: BaseException) -> str:
    """Any error for the operator: ours say what to do, of others the kind is needed."""
    return str(problem) if isinstance(problem, HardwareError) else f"{type(problem).__name__}: {problem}"


class PortRefused(HardwareError):
    """The port does not exist, cannot be opened, or belongs to another program."""


class PortTaken(PortRefused):
    """Another run holds the port."""


class Disconnected(HardwareError):
    """The port vanished while it was open: a cable, an adapter or the peer was removed."""


class ReplyTimeout(HardwareError):
    """The device did not answer within its time."""


class FramingError(HardwareError):
    """The bytes received are not a message of this protocol, or a damaged one."""


class Rejected(HardwareError):
    """The device refused a valid message; its own code or word is in the sentence."""


class DeviceFault(HardwareError):
    """The device reports an alarm, a limit, an emergency stop or a failed self-test."""


class NotVerified(HardwareError):
    """A command was sent, and the read-back shows that it did not take effect."""


class WrongIdentity(HardwareError):
    """The device that answers is not the one that the rig file or the journal names."""


class LimitExceeded(HardwareError, ValueError):
    """What was asked lies outside the limits that the device reports; nothing was sent."""


class StepNotDone(Exception):
    """A step was not executed as written, and is to be repeated: the step of this `number`, or the one under way;
    `unit`: the one whose samples it lacks."""

    def __init__(self, why: str, number: int | None = None, unit: str = "") -> None:
        Exception.__init__(self, why)
        self.number, self.unit = number, unit
