"""What can go wrong on a simulated line, one way: a port takes such a switchboard for replies and one for commands.

Two ways to ask for it: a probability for every message, or `once(...)` for the very next ones. Delays are real seconds,
because the time-outs they provoke are real. What goes wrong *in* a device (alarm, reboot, a stalled axis) is a method
of that device; `unplug` is one of its port.
"""

import threading
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Fault = Literal["drop", "flip", "noise", "duplicate", "truncate", "delay", "split"]
FAULTS: tuple[Fault, ...] = ("drop", "flip", "noise", "duplicate", "truncate", "delay", "split")


@dataclass
class Faults:
    """Switchboard of one line. `probability` is per message; `mute` swallows everything.

    drop       the message never arrives
    flip       one bit of it is wrong
    noise      random bytes come before it
    duplicate  it comes twice
    truncate   its end is missing
    delay      it comes `delay_s` real seconds late
    split      it comes in two parts, a hundredth of a second apart
    """

    seed: int = 0
    probability: dict[Fault, float] = field(default_factory=dict[Fault, float])
    delay_s: float = 0.3
    mute: bool = False

    def __post_init__(self) -> None:
        if unknown := set(self.probability) - set(FAULTS):
            raise ValueError(f"{', '.join(sorted(unknown))}: no such fault; there are {', '.join(FAULTS)}.")
        self._random = np.random.default_rng(self.seed)
        self._next: deque[Fault] = deque()
        self._lock = threading.Lock()
        self.count: dict[Fault, int] = dict.fromkeys(FAULTS, 0)

    def once(self, *faults: Fault) -> None:
        """The next messages suffer these faults, one each, in this order."""
        with self._lock:
            self._next.extend(faults)

    def __call__(self, message: bytes) -> list[bytes]:
        """The chunks that arrive instead of `message`; sleeps where a fault is one of time."""
        with self._lock:
            if self.mute or not message:
                return []
            fault = self._choose()
            if fault is None:
                return [message]
            self.count[fault] += 1
            place = int(self._random.integers(len(message)))
            bit = int(self._random.integers(8))
            noise = self._random.bytes(int(self._random.integers(1, 20)))
        if fault == "delay":
            time.sleep(self.delay_s)
        arrives: dict[Fault, list[bytes]] = {
            "drop": [],
            "flip": [message[:place] + bytes([message[place] ^ 1 << bit]) + message[place + 1 :]],
            "noise": [noise + message],
            "duplicate": [message + message],
            "truncate": [message[:place]],
            "delay": [message],
            "split": [message[:place], message[place:]],
        }
        return arrives[fault]

    def _choose(self) -> Fault | None:
        if self._next:
            return self._next.popleft()
        if not self.probability:
            return None
        draw = float(self._random.random())
        for fault, share in self.probability.items():
            draw -= share
            if draw < 0.0:
                return fault
        return None
