"""The rig file: everything wrong at once; from its options to open, checked devices."""

import pytest

from gradcal_jax.hardware.setup import configs_of
from gradcal_jax.spec.rig import TEMPLATE, parse_rig
from gradcal_jax.tables.problems import SpecError


def test_everything_wrong_with_a_rig_is_said_at_once():
    text = """
format = "gradcal-rig/1"
[chamber]
driver = "linez"
port = "/dev/a"
safe = "standby"
[[axis]]
name = "table"
driver = "lines"
port = "/dev/b"
safe = "hold"
gravity_loaded = false
[axis.options]
home_timout = "3 s"
reply_timeout = 300
zero = "3 s"
direction = "one"
[[imu]]
name = "unit"
driver = "frames"
port = "/dev/c"
[imu.options]
protocol = "stim301"
"""
    with pytest.raises(SpecError) as caught:
        configs_of(parse_rig(text))
    message = str(caught.value)
    for fragment in (
        'chamber.driver = "linez"',
        'nearest: "lines"',
        "axis[0].options.home_timout",
        'nearest: "home_timeout"',
        "axis[0].options.reply_timeout = 300: expected a time as text with a unit",
        "axis[0].options.zero",
        'axis[0].options.direction = "one"',
        "imu[0].options: expected the name of a",
    ):
        assert fragment in message


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (('safe           = "hold"', 'safe           = "drop"'), "axis[0].safe"),
        (
            ("gravity_loaded = false       # true: gravity moves the axis if its motor has no power\n", ""),
            "axis[0].gravity_loaded",
        ),
        (("/dev/ttyUSB2", "/dev/ttyUSB0"), "two devices use this port"),
        (('name   = "imu1"', 'name   = "table"'), "two devices have this name"),
        (("gradcal-rig/1", "gradcal-spec/1"), 'expected "gradcal-rig/1"'),
        (('safe    = "standby"', 'saff    = "standby"'), 'nearest: "safe"'),
    ],
)
def test_a_wrong_rig_is_refused_with_its_key(change, expected):
    assert change[0] in TEMPLATE
    with pytest.raises(SpecError, match=expected.replace("[", r"\[")):
        parse_rig(TEMPLATE.replace(*change))


def test_a_gravity_loaded_axis_is_never_unpowered():
    text = TEMPLATE.replace('safe           = "hold" ', 'safe           = "unpower" ')
    parse_rig(text)
    with pytest.raises(SpecError, match="gravity turns this axis if its motor has no power"):
        parse_rig(text.replace("gravity_loaded = false", "gravity_loaded = true"))
    with pytest.raises(SpecError, match="no device"):
        parse_rig('format = "gradcal-rig/1"')
