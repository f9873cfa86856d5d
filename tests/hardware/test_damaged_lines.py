"""No line that a device prints can take long: 10 000 damaged lines of every description, in linear time."""

import re
import time
from typing import Any

import pytest

from gradcal_jax.hardware.drivers.listening import TextUnitConfig
from gradcal_jax.hardware.line_protocol import LineProtocol, described, reply_pattern, shipped
from gradcal_jax.hardware.text_unit import TextUnitDecoder
from gradcal_jax.tables.problems import SpecError

NAMES = ["gyro_x", "gyro_y", "gyro_z", "acceleration_x", "acceleration_y", "acceleration_z"]
SENSORS = {
    "blanks": " ".join(f"{{{name}}}" for name in NAMES),
    "padded": "    ".join(f"{{{name}}}" for name in NAMES),
    "commas": ", ".join(f"{{{name}}}" for name in NAMES),
    "texts": "$X, {:text}, {:text}, {:text}, {:text}, {gyro_x}, {:text}, {gyro_y}",
}
MOST_S = 5.0


def sensor(line: str) -> TextUnitDecoder:
    tables: dict[str, Any] = {"format": "gradcal-text/1", "line": line, "rate": "200 Hz"}
    return TextUnitDecoder(TextUnitConfig(protocol=tables).described)


def damaged(template: str) -> list[bytes]:
    """10 000 lines with columns of up to 50 blanks, of which each has a character that the template has not."""
    lines: list[bytes] = []
    for number in range(10_000):
        wide = " " * (number % 50)
        line = re.sub(r"\{[^}]*\}", f"{wide}-1.25{wide}", template).replace(" ", f"{wide} ")[:4000]
        place = len(line) - number % 3
        lines.append((line[:place] + "#!" + line[place:]).encode("latin-1"))
    return lines


@pytest.mark.parametrize("line", SENSORS.values(), ids=SENSORS)
def test_damaged_lines_of_a_printing_sensor(line: str) -> None:
    decoder, lines = sensor(line), damaged(line)
    begun = time.process_time()
    for number in range(0, len(lines), 100):
        decoder.push(b"\r\n".join(lines[number : number + 100]) + b"\r\n", 0.0)
    assert time.process_time() - begun < MOST_S
    assert decoder.bad_bytes > 0


@pytest.mark.parametrize("name", shipped())
def test_damaged_replies_of_every_description(name: str) -> None:
    protocol: LineProtocol = described(LineProtocol, name)
    replies = [reply for question in protocol.ask.values() for reply in question.reply]
    replies += [reply for command in protocol.tell.values() for reply in command.reply]
    longest = max(replies, key=len)
    patterns = [reply_pattern(reply) for reply in dict.fromkeys(replies)]
    texts = [line.decode("latin-1") for line in damaged(longest)]
    begun = time.process_time()
    for text in texts:
        for pattern in patterns:
            pattern.fullmatch(text)
    assert time.process_time() - begun < MOST_S


def test_columns_that_are_padded_are_read() -> None:
    for line in (SENSORS["blanks"], SENSORS["padded"]):
        printed = "".join(f"{value:10.3f}" for value in range(1, 7))
        batch = sensor(line).push(f"{printed}\r\n".encode() * 2, 0.0)
        assert batch.gyro_dps.tolist() == [[1.0, 2.0, 3.0]] * 2
    batch = sensor(SENSORS["commas"]).push(b"1,  -2 ,\t3.5 , 4e0, .5,\t6.\n", 0.0)
    assert batch.gyro_dps.tolist() == [[1.0, -2.0, 3.5]]


@pytest.mark.parametrize("reply", ["{air}{setpoint}", "{air}0 {setpoint}", "{air}.{setpoint}"])
def test_numbers_that_run_together_are_refused(reply: str) -> None:
    with pytest.raises(SpecError, match="a number ends at a character that no number has"):
        described(LineProtocol, "cts", {"ask": {"temperature": {"send": "A0", "reply": reply}}})
