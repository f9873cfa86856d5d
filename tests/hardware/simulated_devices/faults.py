"""What can go wrong on a simulated line, one way: a port takes such a switchboard for replies and one for commands.

Two ways to ask for it: a probability for every message, or `once(...)` for the very next ones. What goes wrong *in* a
device (alarm, reboot, a stalled axis) is a method of that device; `unplug` is one of its port.
"""

import threading
from collections import deque
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Fault = Literal["drop", "flip", "noise", "duplicate", "truncate", "delay", "split"]


@dataclass
class Faults:
    """Switchboard of one line. `probability` is per message; `mute` swallows everything.

    drop       the message never arrives
    flip       one bit of it is wrong
    noise      random bytes come before it
    duplicate  it comes twice
    truncate   its end is missing
    delay      it comes `delay_s` late
    split      it comes in two parts
    """

    seed: int = 0
    probability: dict[Fault, float] = field(default_factory=dict[Fault, float])
    delay_s: float = 0.3
    mute: bool = False

    def __post_init__(self):
        self._random = np.random.default_rng(self.seed)
        self._next = deque()
        self._lock = threading.Lock()

    def once(self, *faults):
        """The next messages suffer these faults, one each, in this order."""
        with self._lock:
            self._next.extend(faults)

    def __call__(self, message):
        with self._lock:
            if self.mute or not message:
                return []
            fault = self._choose()
            if fault is None:
                return [(0.0, message)]
            place = int(self._random.integers(len(message)))
            bit = int(self._random.integers(8))
            noise = self._random.bytes(int(self._random.integers(1, 20)))
        flipped = message[:place] + bytes([message[place] ^ 1 << bit]) + message[place + 1 :]
        arrives = {
            "drop": [],
            "flip": [(0.0, flipped)],
            "noise": [(0.0, noise + message)],
            "duplicate": [(0.0, message + message)],
            "truncate": [(0.0, message[:place])],
            "delay": [(self.delay_s, message)],
            "split": [(0.0, message[:place]), (0.0, message[place:])],
        }
        return arrives[fault]

    def _choose(self):
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


def arrivals(spoils, message):
    """The bytes that arrive in place of a message, each with how much later (s) than it was sent."""
    return [(0.0, message)] if spoils is None else spoils(message)
