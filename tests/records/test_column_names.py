"""Maps from the headers that programs write, and questions where a name contradicts the map."""

import tomllib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gradcal_jax.records.column_map import RateColumn, parse_column_map
from gradcal_jax.records.column_names import contradiction, map_to_fill_in, question_of
from gradcal_jax.records.importers import import_log
from gradcal_jax.records.log import LogError

HEADERS = {
    '"Time (s)","Gyroscope x (rad/s)","Gyroscope z (rad/s)"': {
        "time": ("Time (s)", "s"), "rate.z": ("Gyroscope z (rad/s)", "rad/s")},
    "time, xAccel (m/s^2), zAccel (g), xRate (deg/s)": {
        "rate.x": ("xRate (deg/s)", "deg/s"), "force.z": ("zAccel (g)", "g"), "force.x": ("xAccel (m/s^2)", "m/s^2")},
    "Time\tAcc_X\tGyr_X": {"time": ("Time", "???"), "rate.x": ("Gyr_X", "???")},
    "TimeUS,gyro_x_rads,temp_C": {
        "time": ("TimeUS", "us"), "rate.x": ("gyro_x_rads", "rad/s"), "temperature": ("temp_C", "degC")},
    "timestamp [us];gyro_x (rad/s);gyro_y (rad/s)": {"time": ("timestamp [us]", "us"),
                                                     "rate.y": ("gyro_y (rad/s)", "rad/s")},
}  # fmt: skip


def columns_of(text: str) -> dict[str, tuple[str, str]]:
    """Of a map with its ??? the names and units, by key."""
    held = tomllib.loads(text)
    found = {key: (held[key]["column"], held[key]["unit"]) for key in ("time", "temperature") if key in held}
    for kind in ("rate", "force"):
        found |= {f"{kind}.{a}": (one["column"], one["unit"]) for a, one in held.get(kind, {}).items()}
    return found


@pytest.mark.parametrize("header", HEADERS)
def test_a_map_is_made_from_a_header(header, tmp_path):
    (tmp_path / "a.csv").write_text(header + "\n", encoding="utf-8")
    text = map_to_fill_in(tmp_path / "a.csv")
    assert text is not None
    assert HEADERS[header].items() <= columns_of(text).items()
    assert ('delimiter = "tab"' in text) == ("\t" in header)
    assert "???" in text or parse_column_map(text).rate
    (tmp_path / "a.csv").write_text("one,two,three\n1,2,3\n", encoding="utf-8")
    assert map_to_fill_in(tmp_path / "a.csv") is None


@given(header=st.text(max_size=80))
@settings(max_examples=100, deadline=None)
def test_any_header_gives_a_map_or_none(tmp_path_factory, header):
    path = tmp_path_factory.mktemp("guess") / "a.csv"
    path.write_text(header + ",gx [deg/s],t [s]\n", encoding="utf-8", errors="replace")
    if "???" not in (found := map_to_fill_in(path) or "???"):
        parse_column_map(found)


@pytest.mark.parametrize(
    "name", ["g_x", "w_s", "rate_C", "gyro_s", "t_x", "acc_f", "gyroADC[0]", "x_g", "SampleTimeFine"]
)
def test_letters_that_are_no_unit_of_the_quantity_say_nothing(name):
    assert contradiction(name, "mdeg/s") is None


NAMES = {
    ("gyro_x", "gx", "omega_x", "gyroX", "angular_velocity_x"): {
        "rads": "rad/s", "dps": "deg/s", "mdps": "mdeg/s", "degs": "deg/s", "deg/s": "deg/s", "deg/h": "deg/h"},
    ("acc_x", "ax", "accel_x", "accX"): {"mg": "mg", "m/s2": "m/s^2", "ms2": "m/s^2", "mps2": "m/s^2"},
    ("temp", "temperature", "imu_temp"): {"C": "degC", "F": "degF", "degC": "degC", "degF": "degF", "K": "K"},
    ("time", "t", "timestamp"): {"s": "s", "ms": "ms", "us": "us", "ns": "ns", "sec": "s"},
}  # fmt: skip


@pytest.mark.parametrize("names", NAMES)
def test_units_in_names_of_any_joint_ask_where_they_contradict_and_only_there(names):
    for name in names:
        for written, unit in NAMES[names].items():
            joined = [f"{name}_{written}", f"{name} ({written})", f"{name} [{written}]", f"{name}.{written}"]
            joined += [f"{written}_{name}"] * (len(written) > 1 and "/" not in written)
            for one in joined:
                for stated in set(NAMES[names].values()) - {"K"}:
                    assert (contradiction(one, stated) is None) == (unit == stated), (one, stated)


@pytest.mark.parametrize("start", ["dtheta", "delta_theta", "delta angle", "dAngle", "delta_v", "deltaVelocity"])
@pytest.mark.parametrize("axis", ["_x", "X", " y", "[2]", "_0"])
def test_names_of_increments_ask(start, axis):
    question = question_of(start + axis, RateColumn(column="a", unit="mdeg/s"))
    assert question is not None
    assert 'per = "row"' in question
    assert question_of(start + axis, RateColumn(column="a", unit="mdeg", per="row")) is None


def test_a_column_that_is_named_by_its_number_has_the_name_of_the_header(tmp_path):
    (tmp_path / "a.csv").write_text("t,gx [mdps]\n" + "".join(f"{k},{k % 3}.5\n" for k in range(9)), encoding="utf-8")
    text = 'format = "gradcal-columns/1"\nsample_rate = "1 Hz"\nrate.x = { column = 1, unit = "deg/s" }\n'
    with pytest.raises(LogError, match="states the unit mdps"):
        import_log(tmp_path / "a.csv", text)
