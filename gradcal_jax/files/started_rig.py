"""The rig file of `gradcal start`: the devices that were named in the answers, with their ports to put in."""

import math
from collections.abc import Mapping
from typing import Any, Final

from gradcal_jax.files import line_protocol, presets, register_protocol
from gradcal_jax.files.calibration.text_template import rendered

TABLES: Final = ("grbl", "zaber", "odrive", "hand", "switch", "none")
"""What may turn a table; "none": there is none."""
STREAMS: Final = ("stim300", "vectornav", "text", "own")
"""How samples reach the computer; "own": the IMU logs by itself."""


def chambers() -> tuple[str, ...]:
    """Names of chambers: drivers and descriptions; "none": there is none."""
    return ("espec", "weiss", *_described_chambers(), "none")


def _described_chambers() -> dict[str, str]:
    """The chambers that are described, each with its driver."""
    lines = [name for name in line_protocol.shipped() if line_protocol.protocol_of(name).role == "chamber"]
    registers = line_protocol.shipped(register_protocol.FORMAT)
    return {name: "lines" for name in lines if name != "espec"} | dict.fromkeys(registers, "registers")


def rig_text(answers: Mapping[str, str], known: Mapping[str, tuple[Any, ...]], axes: tuple[str, ...]) -> str:
    """The rig file for the answers of `begin`; `axes`: names of the table's axes."""
    cold, warm, _ = known["chamber"]
    rate, acceleration = (f"{math.degrees(known[name][0]):.6g}" for name in ("rate", "acceleration"))
    values = {"of": answers, "axes": axes, "described": _described_chambers().get(answers["makes"], "")}
    values |= {"above": warm + 10.0, "below": cold - 10.0, "rate_dps": rate, "acceleration_dps2": acceleration}
    return rendered(presets.template("started-rig.toml"), values)
