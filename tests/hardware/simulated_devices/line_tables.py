"""Simulated axes that speak in lines: a board with GRBL 1.1, and a table with a language like Ideal Aerosmith's.

Written from public descriptions (see the heads of `spec/presets/devices`), not from the driver.
"""

import re
from collections import deque

_FRICTION_DPS2 = 20.0  # alone slows what has no power


class SimulatedGrbl:
    """The X axis of a board. With its homing cycle on it begins, always anew, in ALARM, and takes nothing but $H, $X
    and questions; while it homes it answers nothing, not even "?"; a hard limit silences it until a reset; jogs queue;
    $ settings are taken only when idle. With an encoder it tells what that reads, and counts steps otherwise."""

    def __init__(self, plant, clock, *, has_encoder=False):
        self.plant, self.has_encoder = plant, has_encoder
        self._clock = clock
        self._buffer = b""
        self.settings = {13: 0.0, 22: 1.0, 100: 250.0, 110: 21600.0, 120: 300.0, 130: 36000.0, 27: 1.0, 25: 3600.0}
        self._state = "Alarm"
        self._silent = False
        self._homed_s = None
        self._jogs = deque()
        self._zero_deg = 0.0
        self._incremental_deg = 0.0
        self.homing_s = 0.3
        self.finds_switch = True
        self.lines = []

    # What it says by itself: the reply to $H.

    def next_emission_s(self):
        return self._homed_s

    def emit(self, now_s):
        if self._homed_s is None or now_s < self._homed_s:
            return []
        self._homed_s = None
        if not self.finds_switch:
            self._state = "Alarm"
            return [b"ALARM:9\r\n", b"ok\r\n"]
        self.plant.set_zero(now_s)
        self._zero_deg = self._incremental_deg = 0.0
        self._state = "Idle"
        return [b"ok\r\n"]

    def receive(self, data):
        replies = []
        for byte in data:
            letter = bytes([byte])
            if letter == b"\x18":
                replies += self._reset()
            elif letter == b"?":
                replies += self._status()
            elif letter == b"\x85":
                self._cancel_jog()
            elif letter in b"\r\n":
                line, self._buffer = self._buffer, b""
                if letter == b"\n" or line:
                    replies += self._line(line.decode("latin-1").strip())
            else:
                self._buffer += letter
        return replies

    def hard_limit(self):
        """A switch at the end of travel: stands at once, its counts no longer true, and says no more."""
        now = self._clock.now()
        self.plant.set_zero(now, self.plant.state(now)[0])
        self._jogs.clear()
        self._state, self._silent = "Alarm", True
        return [b"ALARM:1\r\n", b"[MSG:Reset to continue]\r\n"]

    def reboot(self):
        """Power cut: the motor stands, what was counted is forgotten."""
        now = self._clock.now()
        self.plant.set_zero(now, self.plant.state(now)[0])
        self._zero_deg = self.plant.state(now)[0]
        self._reset()

    # -------------------------------------------------------------------------------------------------------- parts

    def _reset(self):
        now = self._clock.now()
        lost = self.plant.moving(now) or self._homed_s is not None
        if lost:
            self.plant.set_zero(now, self.plant.state(now)[0])
        self._buffer, self._silent, self._homed_s = b"", False, None
        self._jogs.clear()
        self._state = "Alarm" if lost or self.settings[22] or self._state == "Alarm" else "Idle"
        banner = [b"\r\nGrbl 1.1h ['$' for help]\r\n"]
        return banner + ([b"[MSG:'$H'|'$X' to unlock]\r\n"] if self._state == "Alarm" else [])

    def _now(self):
        """Jogs that were queued begin where the one before ends."""
        now = self._clock.now()
        while self._jogs and self.plant.ends_s <= now:
            self._jog(self.plant.ends_s, *self._jogs.popleft())
        if self._state == "Jog" and not self.plant.moving(now):
            self._state = "Idle"
        return now

    def _counted(self, now):
        step = 1.0 / self.settings[100]
        return round((self.plant.state(now)[0] - self._zero_deg) / step) * step

    def _status(self):
        if self._homed_s is not None or self._silent:
            return []
        now = self._now()
        rate = abs(self.plant.state(now)[1]) * 60.0
        angle = self.plant.reading(now) - self._zero_deg if self.has_encoder else self._counted(now)
        return [f"<{self._state}|MPos:{angle:.3f},0.000,0.000|FS:{rate:.0f},0>\r\n".encode()]

    def _cancel_jog(self):
        now = self._now()
        if self._state == "Jog":
            self._jogs.clear()
            self.plant.spin(now, 0.0, self.settings[120])

    def _line(self, text):
        if self._homed_s is not None or self._silent:
            return []
        self._now()
        self.lines.append(text)
        idle = self._state in ("Idle", "Alarm")
        if text == "$$":
            shown = [f"${number}={value:.3f}\r\n".encode() for number, value in sorted(self.settings.items())]
            return [*shown, b"ok\r\n"] if idle else [b"error:8\r\n"]
        if text == "$I":
            return [b"[VER:1.1h.20190830:]\r\n", b"[OPT:V,15,128]\r\n", b"ok\r\n"]
        if text == "$H" and idle and self.settings[22]:
            self._state, self._homed_s = "Home", self._clock.now() + self.homing_s
            return []
        if text == "$X":
            self._state = "Idle" if self._state == "Alarm" else self._state
            return [b"[MSG:Caution: Unlocked]\r\n", b"ok\r\n"]
        if (match := re.fullmatch(r"\$(\d+)=(\d+(?:\.\d+)?)", text)) is not None:
            return [self._set(int(match[1]), float(match[2]))]
        if text.startswith("$J="):
            return [self._jog_line(text[3:])]
        return [b"error:3\r\n" if text else b"ok\r\n"]

    def _set(self, number, value):
        if self._state not in ("Idle", "Alarm"):
            return b"error:8\r\n"
        if number not in self.settings:
            return b"error:3\r\n"
        self.settings[number] = value
        return b"ok\r\n"

    def _jog_line(self, block):
        if (words := re.fullmatch(r"(G90|G91) G21(?: G53)? X(-?\d+(?:\.\d+)?) F(\d+(?:\.\d+)?)", block)) is None:
            return b"error:2\r\n"
        if self._state not in ("Idle", "Jog"):
            return b"error:9\r\n"
        begins = self._jogs[-1][0] if self._jogs else self._incremental_deg
        if self._state == "Idle":
            begins = self._counted(self._clock.now())
        goal = float(words[2]) + (begins if words[1] == "G91" else 0.0)
        rate = min(float(words[3]), self.settings[110]) / 60.0
        if self._state == "Jog":
            self._jogs.append((goal, rate))
        else:
            self._jog(self._clock.now(), goal, rate)
        return b"ok\r\n"

    def _jog(self, at_s, goal, rate_dps):
        step = 1.0 / self.settings[100]
        self._incremental_deg = goal
        if abs(goal - self._counted(at_s)) >= step:
            self.plant.move_to(at_s, round(goal / step) * step + self._zero_deg, rate_dps, self.settings[120])
            self._state = "Jog"


class SimulatedAerosmith:
    """A table whose prompt ends every reply. Words of motion are not understood while the servo is off, nor P while it
    homes or jogs; acceleration and velocity are remembered."""

    _WORD = re.compile(r"(PPO|MCO5|SRV\?|ACL\?|VEL\?|JOG\?|HOM|STO)|(SRV|ACL|VEL|JOG|P)(-?\d+(?:\.\d+)?)")

    def __init__(self, plant, clock):
        self.plant = plant
        self._clock = clock
        self._buffer = b""
        self.servo = False
        self.acceleration = self.velocity = 10.0
        self.jog = 0.0
        self._homed_s = None

    def receive(self, data):
        *lines, self._buffer = (self._buffer + data).split(b"\r")
        return [self._line(line.decode("latin-1").strip()).encode("latin-1") + b"\r\n>" for line in lines]

    def _line(self, text):
        now = self._clock.now()
        if self._homed_s is not None and now >= self._homed_s:
            self._homed_s = None
            self.plant.set_zero(now)
        busy = self._homed_s is not None or self.plant.moving(now)
        match = self._WORD.fullmatch(text)
        answers = {
            "PPO": f"{self.plant.reading(now):.4f}",
            "MCO5": str(int(busy)),
            "SRV?": str(int(self.servo)),
            "ACL?": f"{self.acceleration:.3f}",
            "VEL?": f"{self.velocity:.3f}",
            "JOG?": f"{self.jog:.3f}",
        }
        if match is not None and match[1] in answers:
            return answers[match[1]]
        if match is not None and self._obeys(match[1] or match[2], float(match[3] or 0.0), now, busy):
            return ""
        return f"{text} ?"

    def _obeys(self, word, value, now, busy):
        if word == "SRV":
            if value not in (0.0, 1.0):
                return False
            if self.servo and not value:
                self.plant.spin(now, 0.0, _FRICTION_DPS2)
            self.servo, self.jog = bool(value), 0.0
        elif word in ("ACL", "VEL"):
            if not 0.0 < value <= 1000.0:
                return False
            self.acceleration, self.velocity = (value, self.velocity) if word == "ACL" else (self.acceleration, value)
        elif word == "STO":
            self._homed_s, self.jog = None, 0.0
            self.plant.spin(now, 0.0, self.acceleration)
        elif not self.servo:
            return False
        elif word == "JOG":
            self.jog = value
            self.plant.spin(now, value, self.acceleration)
        elif busy:
            return False
        elif word == "P":
            self.plant.move_to(now, value, self.velocity, self.acceleration)
        else:
            self.jog, self._homed_s = 0.0, now + 1.0
        return True
