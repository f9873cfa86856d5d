"""A log and its file."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
import xarray

from gradcal_jax.records.log import Log, LogError, Reason
from gradcal_jax.records.log_file import read_log, write_log
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


def test_netcdf_gives_back_the_very_same_log_as_xarray_writes_it(tmp_path):
    log = whole_log()
    path = tmp_path / "log.nc"
    write_log(log, path)
    back = read_log(path)
    for name, value in vars(log).items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(getattr(back, name), value, strict=True)
        else:
            assert getattr(back, name) == value, name
    assert back.counts("SN-2") == {"used": 59, "duplicate stamp": 4, "saturated": 1}
    load_netcdf(path).to_netcdf(tmp_path / "theirs.nc", engine="h5netcdf")
    with h5py.File(path) as ours, h5py.File(tmp_path / "theirs.nc") as theirs:
        one, other = ({name: (v.dtype, v.shape, {*v.attrs}) for name, v in of.items()} for of in (ours, theirs))
    assert one == other
    xarray.testing.assert_identical(load_netcdf(path), load_netcdf(tmp_path / "theirs.nc"))
    with h5py.File(path, "r+") as opened:
        opened["rate"].attrs["units"] = "deg s-1"
    with pytest.raises(LogError, match="'rate' is in 'deg s-1', and a log holds it in 'rad s-1'"):
        read_log(path)


def test_other_files_get_a_sentence(tmp_path):
    with pytest.raises(LogError, match="does not exist"):
        read_log(tmp_path / "none.nc")
    for attributes, sentence in (({}, "gradcal-log/1"), ({"format": "gradcal-log/1"}, "no variable 'time'")):
        with h5py.File(tmp_path / "other.nc", "w") as opened:
            opened["x"] = np.arange(3)
            opened.attrs.update(attributes)
        with pytest.raises(LogError, match=sentence):
            read_log(tmp_path / "other.nc")
    with pytest.raises(LogError, match="cannot be written"):
        write_log(whole_log(), tmp_path / "nowhere" / "log.nc")
    write_log(whole_log(), tmp_path / "whole.nc")
    content, _, _ = (tmp_path / "whole.nc").read_bytes().rpartition(b"\ngradcal_jax sha256")
    for length in np.linspace(0, len(content) - 1, 9).astype(int):
        (tmp_path / "cut.nc").write_bytes(content[:length])
        with pytest.raises(LogError):
            read_log(tmp_path / "cut.nc")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"time_s": np.array([0.0, 2.0, 1.0])}, "must increase"),
        ({"time_s": np.zeros(1), "rate_rad_per_s": np.zeros((1, 1, 1))}, "at least two rows"),
        ({"rate_rad_per_s": np.zeros((1, 3, 2))}, "shape"),
        ({"units": ("a", "a"), "rate_rad_per_s": np.zeros((2, 3, 1))}, "labels are the same"),
        ({"temperature_c": np.zeros((1, 4))}, "temperature has the shape"),
        ({"stretch_starts": np.array([1])}, "stretch_starts"),
        ({"rows_read": 9}, "9 rows were read, but 3 kept"),
    ],
)
def test_a_log_refuses_what_does_not_fit(change, sentence):
    sound = {"time_s": np.arange(3.0), "rate_rad_per_s": np.zeros((1, 3, 1)), "units": ("a",), "axes": ("x",)}
    with pytest.raises(LogError, match="no gyro X in this log; nearest: 'gyro x'"):
        Log(**sound).channel("gyro X")
    with pytest.raises(LogError, match=sentence):
        Log(**{**sound, **change})


def test_even_grid_marks_each_gap_with_one_invalid_point():
    status = (np.arange(10) < 1).astype(np.uint16)[None]
    log = Log(np.arange(10) * 0.5, np.arange(10.0)[None, :, None], ("a",), ("x",), status=status)
    log = replace(log, time_s=log.time_s + 1000.0 * (np.arange(10) > 5), stretch_starts=np.array([0, 6]))
    even = log.even("gyro x")
    assert even.sample_interval_s == 0.5
    assert even.valid.tolist() == [False] + [True] * 5 + [False] + [True] * 4
    assert even.row.tolist() == [0, 1, 2, 3, 4, 5, -1, 6, 7, 8, 9]
    assert even.rate_rad_per_s[even.valid].tolist() == [1, 2, 3, 4, 5, 6, 7, 8, 9]
