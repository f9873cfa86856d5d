"""The rig file of `gradcal start`: the devices that were named in the answers, with their ports to put in."""

import math
from collections.abc import Mapping
from typing import Any, Final

from gradcal_jax.files import line_protocol, register_protocol

TABLES: Final = ("grbl", "zaber", "odrive", "hand", "switch", "none")
"""What may turn a table; "none": there is none."""
STREAMS: Final = ("stim300", "vectornav", "text", "own")
"""How samples reach the computer; "own": the IMU logs by itself."""

_HEAD: Final = """# Made by gradcal start. Put the ports in; then: gradcal rig check FILE, which moves nothing.
format = "gradcal-rig/1"
"""
_CHAMBER: Final = """
[chamber]
{driver}
port        = "/dev/ttyUSB0"           # COM3; socket://192.168.0.7:10001
safe        = "standby"                # when a run ends badly: standby, hold or ambient
never_above = "{above:g} degC"              # warmer or colder than this, a run ends at once
never_below = "{below:g} degC"
"""
_AXIS: Final = """
[[axis]]
name           = "{name}"
{driver}
safe           = "hold"                # hold, controlled stop or unpower
gravity_loaded = false                 # true: it moves by itself without power
options        = {{ {options} }}
"""
_IMU: Final = {
    "stim300": 'driver = "stim300"\nport   = "/dev/ttyUSB2"\noptions = { sample_rate = "125 Hz" }\n',
    "vectornav": 'driver = "vectornav"\nport   = "/dev/ttyUSB2"\n',
    "text": """driver = "text_unit"
port   = "/dev/ttyACM0"
[imu.options.protocol]                 # a line that it prints, with names in braces where the numbers are
format = "gradcal-text/1"
line   = "{gyro_x},{gyro_y},{gyro_z},{acceleration_x},{acceleration_y},{acceleration_z},{temperature},{time}"
rate   = "100 Hz"
time   = { unit = "us", modulus = 4294967296 }     # micros() of an Arduino, taken where the sample is
boot   = "2 s"                         # the board restarts when its port is opened
""",
}
_BY_ITSELF: Final = """
# The IMU logs by itself, so there is no [[imu]]. Afterwards: gradcal log RUN --recording FILE --columns columns.toml
"""


def chambers() -> tuple[str, ...]:
    """Names of chambers: drivers and descriptions; "none": there is none."""
    return ("espec", "weiss", *_described("chamber"), "none")


def _described(role: str) -> dict[str, str]:
    """The devices of a role that are described, each with its driver."""
    lines = {name: line_protocol.protocol_of(name).role for name in line_protocol.shipped()}
    registers = line_protocol.shipped(register_protocol.FORMAT)
    roles = {name: register_protocol.register_protocol_of(name).role for name in registers}
    return {name: "lines" for name, of in lines.items() if of == role and name != "espec"} | {
        name: "registers" for name, of in roles.items() if of == role
    }


def rig_text(answers: Mapping[str, str], known: Mapping[str, tuple[Any, ...]], axes: tuple[str, ...]) -> str:
    """The rig file for the answers of `begin`; `axes`: names of the table's axes."""
    text = _HEAD
    cold, warm, _ = known["chamber"]
    if (made := answers["makes"]) != "none":
        driver = f'driver      = "{made}"'
        if (described := _described("chamber").get(made)) is not None:
            driver = f'driver      = "{described}"\noptions     = {{ protocol = "{made}" }}'
        text += _CHAMBER.format(driver=driver, above=warm + 10.0, below=cold - 10.0)
    rate, acceleration = (f'"{math.degrees(known[name][0]):.6g} ' for name in ("rate", "acceleration"))
    limits = f'max_rate = {rate}deg/s", max_acceleration = {acceleration}deg/s^2"'
    for number, name in enumerate(axes):
        driver, options = _axis(answers, number, limits)
        text += _AXIS.format(name=name, driver=driver, options=options)
    if answers["stream"] == "own":
        return text + _BY_ITSELF
    block = _IMU[answers["stream"]]
    if answers["kind"] != "imu":
        block = block.replace("{acceleration_x},{acceleration_y},{acceleration_z},", "")
    return f'{text}\n[[imu]]\nname   = "imu1"\n{block}'


def _axis(answers: Mapping[str, str], number: int, limits: str) -> tuple[str, str]:
    """Driver and port of an axis, and its options."""
    table = answers["table"]
    port = 'port           = "/dev/ttyUSB1"'
    if table == "hand":
        angle = ', angle = "none"' if answers["angle"].strip() == "none" else ""
        return (
            'driver         = "operator"             # asks a person to turn\nport           = "terminal"',
            limits + angle,
        )
    if table == "switch":
        rate = limits.split(",")[0].removeprefix("max_")
        return (
            f'driver         = "switch"\n{port}',
            f'{rate}, forward = "forward", backward = "backward", stop = "stop"',
        )
    if table == "grbl":
        return f'driver         = "lines"\n{port}', f'protocol = "grbl", {limits}'
    if table == "zaber":
        return f'driver         = "zaber"\n{port}', f"axis = {number + 1}, {limits}"
    return f'driver         = "odrive"\n{port}', f"motor = {number}, {limits}"
