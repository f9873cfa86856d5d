import h5py
import numpy as np
import pytest
import xarray
from hypothesis import given, settings
from hypothesis import strategies as st

from gradcal_jax.records.examination import Columns, examine
from gradcal_jax.records.log import Log, LogError, Reason, part_of
from gradcal_jax.records.log_file import read_log, write_log
from gradcal_jax.records.stamps import Policy
from gradcal_jax.tables.netcdf import load_netcdf


def whole_log():
    rng = np.random.default_rng(1)
    time = np.arange(60) * 0.1
    status = np.zeros((2, 60), np.uint16)
    status[1, 7] = Reason.SATURATED | Reason.FROZEN_TEMPERATURE
    return Log(
        time_s=time,
        rate_rad_per_s=rng.standard_normal((2, 60, 3)),
        units=("SN-1", "SN-2"),
        axes=("x", "y", "z"),
        temperature_c=20 + rng.standard_normal((2, 60)),
        table_axes=("inner",),
        table_angle_rad=np.cumsum(rng.standard_normal((60, 1)), axis=0),
        table_rate_rad_per_s=rng.standard_normal((60, 1)),
        standstill=np.repeat([0, -1, 1], 20),
        host_time_s=time + 1e9,
        status=status,
        stretch_starts=np.array([0, 30]),
        rows_read=64,
        rows_removed={"duplicate stamp": 4},
        simulated=True,
        provenance={"source": "run 7 °C"},
    )


def columns(rate, time=None, **more):
    """One unit, one axis; `more`: columns by name, or fields."""
    rate = np.asarray(rate, float)
    values = {"gyro x": rate[None], "time": np.arange(len(rate)) * 0.01 if time is None else np.asarray(time, float)}
    fields = {name: more.pop(name) for name in [*more] if name in Columns.__dataclass_fields__}
    return Columns(
        ("s",), values | {name.replace("_", " "): np.asarray(one, float) for name, one in more.items()}, **fields
    )


def kinds(log):
    return {finding.kind: finding for finding in log.findings}


def quiet(count, seed=0):
    return 1e-3 * np.random.default_rng(seed).standard_normal(count)


def test_netcdf_gives_back_the_very_same_log(tmp_path):
    log = whole_log()
    path = tmp_path / "log.nc"
    write_log(log, path)
    back = read_log(path)
    for name, value in vars(log).items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(getattr(back, name), value)
            assert getattr(back, name).dtype == value.dtype
        else:
            assert getattr(back, name) == value, name
    assert back.counts("SN-2") == {"used": 59, "duplicate stamp": 4, "saturated": 1}


def test_the_file_carries_its_units_and_a_mismatch_is_refused(tmp_path):
    path = tmp_path / "log.nc"
    write_log(whole_log(), path)
    with h5py.File(path, "r+") as opened:
        assert opened["rate"].attrs["units"] == "rad s-1"
        opened["rate"].attrs["units"] = "deg s-1"
    with pytest.raises(LogError, match="'rate' is in 'deg s-1', and a log holds it in 'rad s-1'"):
        read_log(path)


def test_the_file_is_what_xarray_makes_of_the_same_variables(tmp_path):
    """Whatever reads what xarray writes reads a log."""
    write_log(whole_log(), tmp_path / "log.nc")
    load_netcdf(tmp_path / "log.nc").to_netcdf(tmp_path / "theirs.nc", engine="h5netcdf")
    with h5py.File(tmp_path / "log.nc") as ours, h5py.File(tmp_path / "theirs.nc") as theirs:
        assert set(ours) == set(theirs)
        for name, variable in theirs.items():
            assert (ours[name].dtype, ours[name].shape, ours[name].chunks) == (variable.dtype, variable.shape, None)
            assert set(ours[name].attrs) == set(variable.attrs), name
    xarray.testing.assert_identical(load_netcdf(tmp_path / "log.nc"), load_netcdf(tmp_path / "theirs.nc"))


def test_other_files_get_a_sentence(tmp_path):
    with pytest.raises(LogError, match="does not exist"):
        read_log(tmp_path / "none.nc")
    with h5py.File(tmp_path / "other.nc", "w") as opened:
        opened["x"] = np.arange(3)
    with pytest.raises(LogError, match="gradcal-log/1"):
        read_log(tmp_path / "other.nc")
    with h5py.File(tmp_path / "half.nc", "w") as opened:
        opened.attrs["format"] = "gradcal-log/1"
    with pytest.raises(LogError, match="no variable 'time'"):
        read_log(tmp_path / "half.nc")
    with pytest.raises(LogError, match="cannot be written"):
        write_log(whole_log(), tmp_path / "nowhere" / "log.nc")


@given(content=st.binary(max_size=300), honest=st.booleans())
@settings(max_examples=20, deadline=None)
def test_arbitrary_bytes_are_no_log(tmp_path_factory, content, honest):
    path = tmp_path_factory.mktemp("bytes") / "log.nc"
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + content if honest else content)
    with pytest.raises(LogError):
        read_log(path)


def test_a_file_that_was_cut_off_is_a_sentence(tmp_path):
    write_log(whole_log(), tmp_path / "whole.nc")
    content, _, _ = (tmp_path / "whole.nc").read_bytes().rpartition(b"\ngradcal_jax sha256")
    for length in np.linspace(0, len(content) - 1, 9).astype(int):
        (tmp_path / "cut.nc").write_bytes(content[:length])
        with pytest.raises(LogError):
            read_log(tmp_path / "cut.nc")


def test_a_log_refuses_what_does_not_fit():
    sound = {"time_s": np.arange(3.0), "rate_rad_per_s": np.zeros((1, 3, 1)), "units": ("a",), "axes": ("x",)}
    assert Log(**sound).rows_read == 3
    for change, sentence in [
        ({"time_s": np.array([0.0, 2.0, 1.0])}, "must increase"),
        ({"time_s": np.zeros(1), "rate_rad_per_s": np.zeros((1, 1, 1))}, "at least two rows"),
        ({"rate_rad_per_s": np.zeros((1, 3, 2))}, "shape"),
        ({"units": ("a", "a"), "rate_rad_per_s": np.zeros((2, 3, 1))}, "labels are the same"),
        ({"temperature_c": np.zeros((1, 4))}, "temperature has the shape"),
        ({"stretch_starts": np.array([1])}, "stretch_starts"),
        ({"rows_read": 9}, "9 rows were read, but 3 kept"),
    ]:
        with pytest.raises(LogError, match=sentence):
            Log(**{**sound, **change})
    with pytest.raises(LogError, match="no axis 'X' in this log; nearest: 'x'"):
        Log(**sound).axis_index("X")
    with pytest.raises(LogError, match="no unit number 1"):
        Log(**sound).unit_index(1)


def test_even_grid_marks_each_gap_with_one_invalid_point():
    rate = np.arange(10.0)
    time = np.arange(10) * 0.5
    time[6:] += 1000.0
    log = examine(columns(rate, time, marked=np.arange(10)[None] < 1))
    even = log.even("x")
    assert log.stretch_starts.tolist() == [0, 6]
    assert even.sample_interval_s == 0.5
    assert even.valid.tolist() == [False] + [True] * 5 + [False] + [True] * 4
    assert even.row.tolist() == [0, 1, 2, 3, 4, 5, -1, 6, 7, 8, 9]
    assert even.rate_rad_per_s[even.valid].tolist() == [1, 2, 3, 4, 5, 6, 7, 8, 9]
    assert log.counts() == {"used": 9, "marked": 1}


def test_stamps_that_repeat_or_step_back_or_are_none_are_removed_and_counted():
    time = np.arange(100) * 0.01
    time[10], time[50], time[70] = time[9], time[20], np.nan
    log = examine(columns(quiet(100), time))
    assert log.counts() == {"used": 97, "unreadable row": 1, "duplicate stamp": 1, "unordered stamp": 1}
    assert kinds(log)["duplicate stamp"].message == "1 row with the time stamp of an earlier row, first row 10"


def test_a_clock_that_restarts_or_wraps_late_in_the_record_is_refused_too():
    """Fewer rows after the step than before it, which nobody may drop in silence."""
    for time, words in (
        (np.concatenate([np.arange(300), np.arange(100)]) * 0.01, "did the clock restart"),
        ((np.arange(4000) * 0.02 + 10) % 65.536, "16 bits of ms"),
        ((np.arange(400) * 0.01 + 4293.0) % (2**32 * 1e-6), "32 bits of µs"),
    ):
        with pytest.raises(LogError, match=words):
            examine(columns(quiet(len(time)), time))
    time = np.arange(400) * 0.01
    time[200:230] -= 0.5  # a packet that came late: what follows is on time
    assert examine(columns(quiet(400), time)).counts()["unordered stamp"] == 30


@pytest.mark.parametrize(
    ("time", "factor"),
    [
        (np.arange(4000) * 10.0, 1.0),  # ms as s
        (np.arange(4000) * 1e-5, 1.0),  # s as ms
        (np.arange(2_000_000) * 1.0, 1.0),  # ms as s at 1 kHz: 23 days
        (np.arange(4000) * 0.01, 3600.0),  # deg/h as deg/s
    ],
)
def test_intervals_durations_and_noise_that_no_gyro_has_are_a_question(time, factor):
    noise = np.random.default_rng(1).standard_normal(len(time)) * np.radians(0.05) * factor
    with pytest.raises(LogError, match=r"another unit\?|no gyro is so noisy"):
        examine(columns(noise, time))
    assert examine(columns(noise, time), Policy(values="keep")).counts() == {"used": len(time)}


def test_a_part_of_a_log_keeps_its_clock_and_counts_what_is_left_out():
    time = np.arange(1000) * 0.01
    time[600:] += 1.0
    log = examine(columns(quiet(1000), time, temperature=20 + np.arange(1000)[None] / 500))
    part = part_of(log, begin_s=2.0, end_s=8.0)
    assert part.time_s[0] == pytest.approx(2.0)
    assert part.stretch_starts.tolist() == [0, 400]
    assert part.counts() == {"used": 501, "left out": 499}
    np.testing.assert_array_equal(part.rate_rad_per_s, log.rate_rad_per_s[:, 200:701])
    np.testing.assert_array_equal(part_of(log, rows=(10, 20)).temperature_c, log.temperature_c[:, 10:20])
    assert part_of(log) is log
    with pytest.raises(LogError, match="fewer than two rows"):
        part_of(log, begin_s=50.0)


@given(first=st.integers(0, 60), length=st.integers(2, 60), gap=st.integers(1, 49))
@settings(max_examples=60, deadline=None)
def test_any_part_of_rows_accounts_for_every_row(first, length, gap):
    time = np.arange(50) * 0.01
    time[gap:] += 0.3
    raw = columns(quiet(50), time, temperature=np.arange(50.0)[None], marked=np.zeros((1, 50), bool))
    try:
        log = examine(raw.part((first, first + length)))
    except LogError:
        assert min(first + length, 50) - first < 2
        return
    kept = min(length, 50 - first)
    assert sum(log.counts().values()) == log.rows_read == 50
    assert log.counts()["used"] == kept
    assert log.temperature_c[0].tolist() == list(range(first, first + kept))


def test_gaps_split_and_jitter_does_not():
    rng = np.random.default_rng(5)
    time = np.arange(2000) * 0.01 + 0.004 * rng.random(2000)
    time[500] += 0.0095  # late by a whole sample, but the next ones are on time
    log = examine(columns(quiet(2000), np.sort(time)))
    assert "gap" not in kinds(log)
    time = np.arange(2000) * 0.01
    time[300:] += 0.02
    time[1200:] += 3.0
    log = examine(columns(quiet(2000), time))
    assert log.stretch_starts.tolist() == [0, 300, 1200]
    assert "2 gaps with about 302 samples dropped" in kinds(log)["gap"].message
    assert log.sample_interval_s == pytest.approx(0.01, rel=1e-9)


def test_missing_saturated_and_marked_rows_are_masked_by_unit():
    rate = quiet(1000)
    rate[[5, 6]] = np.nan
    rate[100:110] = 4.36
    marked = np.zeros((1, 1000), bool)
    marked[0, [5, 700]] = True
    log = examine(columns(rate, marked=marked))
    # What a marked row holds, or that it lacks it, is of no matter.
    assert log.counts() == {"used": 987, "missing rate": 1, "saturated": 10, "marked": 2}
    stated = examine(columns(np.where(np.isnan(rate), 0.0, rate), full_scale_rad_per_s=4.36))
    assert stated.counts() == {"used": 990, "saturated": 10}
    clean = examine(columns(np.rint(quiet(1000) * 3000) / 3000))  # few counts, whose extremes repeat
    assert clean.counts() == {"used": 1000}


def test_a_frozen_temperature_is_found_and_a_coarse_one_is_not():
    time = np.arange(6000) * 0.1
    smooth = 20 + time / 60 + 0.01 * np.random.default_rng(3).standard_normal(6000)
    frozen = smooth.copy()
    frozen[2000:3000] = frozen[2000]
    log = examine(columns(quiet(6000), time, temperature=frozen[None]))
    assert log.counts() == {"used": 5000, "frozen temperature": 1000}
    coarse = np.rint(smooth / 0.25) * 0.25
    assert examine(columns(quiet(6000), time, temperature=coarse[None])).counts() == {"used": 6000}
    missing = smooth.copy()
    missing[10:20] = np.nan
    assert examine(columns(quiet(6000), time, temperature=missing[None])).counts()["missing temperature"] == 10
    constant = examine(columns(quiet(6000), time, temperature=np.full((1, 6000), 21.5)))
    assert constant.counts() == {"used": 6000}
    assert "never changes" in kinds(constant)["constant temperature"].message


def test_wrong_units_are_found_by_size_and_against_the_table():
    time = np.arange(3000) * 0.01
    turning = np.sin(time)
    for arguments, sentence in [
        ({"rate": 300 * np.sin(time)}, "column map state a unit that is too large"),
        ({"rate": quiet(3000), "temperature": np.full((1, 3000), 293.0) + time}, "K, degF, or counts"),
        ({"rate": quiet(3000), "sample_rate_hz": 1e5}, "times those of the stated rate"),
        ({"rate": quiet(3000), "time": time * 1e9}, "another unit"),
        ({"rate": np.degrees(turning), "table_rate_inner": turning}, "deg instead of rad"),
        ({"rate": turning / 57.2958, "table_angle_inner": -np.cos(time)}, "deg instead of rad"),
    ]:
        arguments = {"time": time, **arguments}
        raw = columns(arguments.pop("rate"), arguments.pop("time"), **arguments)
        with pytest.raises(LogError, match=sentence):
            examine(raw)
        assert kinds(examine(raw, Policy(values="keep")))["question"].done == "keep"
    right = columns(1.004 * turning, time, table_rate_inner=turning)
    assert examine(right).findings == ()


def test_clock_drift_is_found_three_ways():
    time = np.arange(20_000) * 0.01
    rng = np.random.default_rng(0)
    jitter = 1e-3 * rng.random(20_000)
    stated = kinds(examine(columns(quiet(20_000), time * 1.0003, sample_rate_hz=100.0)))
    assert "+300 ppm longer on average" in stated["clock drift"].message
    host = kinds(examine(columns(quiet(20_000), time, host_time=7e8 + time * (1 - 4e-4) + jitter)))
    assert "+400 ppm fast" in host["clock drift"].message
    wandering = np.cumsum(0.01 * (1 + 5e-4 * np.sin(time / 30)))
    assert "varies by" in kinds(examine(columns(quiet(20_000), wandering)))["clock drift"].message
    assert examine(columns(quiet(20_000), time, sample_rate_hz=100.0, host_time=time + jitter)).findings == ()


def test_standstills_are_numbered_from_truth_values_or_as_given():
    flags = np.array([1.0, 1, 0, 0, 1, 0])
    assert examine(columns(quiet(6), standstill=flags)).standstill.tolist() == [0, 0, -1, -1, 1, -1]
    numbers = np.array([4.0, 4, -1, np.nan, 5, -7])
    assert examine(columns(quiet(6), standstill=numbers)).standstill.tolist() == [4, 4, -1, -1, 5, -1]


numbers = st.one_of(st.floats(width=64), st.floats(-10, 10), st.sampled_from([0.0, 1.0, 1e308, -1e308, np.nan, np.inf]))


@given(data=st.data(), rows=st.integers(2, 40))
@settings(max_examples=200, deadline=None)
def test_whatever_the_numbers_nothing_is_dropped_silently(data, rows):
    array = lambda: np.array(data.draw(st.lists(numbers, min_size=rows, max_size=rows)))  # noqa: E731
    raw = columns(
        array(),
        array() if data.draw(st.booleans()) else np.cumsum(np.abs(np.nan_to_num(array(), posinf=1.0, neginf=1.0)) % 7),
        temperature=array()[None],
        host_time=array(),
        standstill=array(),
        table_angle_t=array(),
        sample_rate_hz=data.draw(st.one_of(st.none(), st.floats(1e-6, 1e6))),
    )
    try:
        log = examine(raw, Policy(values="keep"))
    except LogError:
        return
    assert sum(log.counts().values()) == rows == log.rows_read
    assert np.isfinite(log.rate_rad_per_s[0][log.usable()]).all()
    even = log.even()
    assert np.count_nonzero(even.valid) == log.counts()["used"]
