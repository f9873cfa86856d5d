"""Files with wrong bytes in them: whatever the HDF5 library does with them, the reader comes back with a sentence."""

import sys

import numpy as np
import pytest
import xarray

from gradcal_jax.files.log import Log, LogError, read_log, write_log
from gradcal_jax.files.netcdf import NetcdfError, load_netcdf


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    path = tmp_path_factory.mktemp("sound") / "log.nc"
    rng = np.random.default_rng(3)
    write_log(
        Log(
            np.arange(60) * 0.1,
            rng.standard_normal((2, 60, 3)),
            ("SN-1", "SN-2"),
            ("x", "y", "z"),
            temperature_c=20 + rng.standard_normal((2, 60)),
        ),
        path,
    )
    return path


def read_with_wrong_bytes(sound, path, wrong):
    """What becomes of the sound file with some bytes changed: a log or a sentence; anything else is raised."""
    content = bytearray(sound.read_bytes())
    for at, value in wrong:
        content[at] = value
    path.write_bytes(content)
    try:
        return read_log(path)
    except LogError as error:
        return str(error)


def test_a_sound_file_is_read_as_it_is(sound):
    with xarray.open_dataset(sound, engine="h5netcdf", decode_times=False) as expected:
        xarray.testing.assert_identical(load_netcdf(sound), expected.load())


def test_a_block_of_the_user_before_the_data_is_none_of_our_business(sound, tmp_path):
    (tmp_path / "block.nc").write_bytes(bytes(1024) + sound.read_bytes())
    xarray.testing.assert_identical(load_netcdf(tmp_path / "block.nc"), load_netcdf(sound))


@pytest.fixture(scope="module")
def foreign(sound):
    """The same file as another program writes it, which is tried in another process first."""
    path = sound.with_name("foreign.nc")
    with xarray.open_dataset(sound, engine="h5netcdf", decode_times=False) as contents:
        contents.to_netcdf(path, engine="h5netcdf")
    return path


def test_bytes_as_they_were_written_are_read_at_once_and_others_are_tried_first(sound, foreign, tmp_path, monkeypatch):
    expected = load_netcdf(foreign)
    monkeypatch.setattr(sys, "executable", "no such program")
    xarray.testing.assert_identical(load_netcdf(sound), expected)
    content = sound.read_bytes()
    for wrong in (content[:-1], content[:-1] + b"x", content[:2000] + b"x" + content[2001:], b"x" + content):
        (tmp_path / "wrong.nc").write_bytes(wrong)
        with pytest.raises((FileNotFoundError, NetcdfError)):
            load_netcdf(tmp_path / "wrong.nc")


def test_reading_without_end_is_ended(foreign):
    with pytest.raises(NetcdfError, match="comes to no end"):
        load_netcdf(foreign, trial_s=-1.0)  # no time at all: what a reading that does not end always runs into


@pytest.mark.parametrize(
    ("does", "sentence"),
    [("kill -SEGV $$", "does not survive it .signal 11"), ("exit 3", "could not run")],
)
def test_a_library_that_dies_takes_nobody_with_it(foreign, tmp_path, monkeypatch, does, sentence):
    """A crash of HDF5 cannot be ordered; that of the process that tries the file can."""
    program = tmp_path / "python"
    program.write_text(f"#!/bin/sh\n{does}\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    with pytest.raises(NetcdfError, match=sentence):
        load_netcdf(foreign)


def test_some_wrong_bytes_give_a_log_or_a_sentence(sound, tmp_path):
    rng = np.random.default_rng(1)
    size = sound.stat().st_size
    ends = [
        read_with_wrong_bytes(sound, tmp_path / "wrong.nc", [(rng.integers(size), rng.integers(256)) for _ in range(9)])
        for _ in range(5)
    ]
    assert any(isinstance(end, str) for end in ends)


@pytest.mark.evidence
def test_each_of_many_wrong_bytes_gives_a_log_or_a_sentence(sound, tmp_path):
    """Of random bytes about one in 600 sends HDF5 round in circles, so that these are likely to meet it."""
    rng = np.random.default_rng(2)
    size = sound.stat().st_size
    ends = [
        read_with_wrong_bytes(sound, tmp_path / "wrong.nc", [(rng.integers(size), rng.integers(256))])
        for _ in range(400)
    ]
    sentences = [end for end in ends if isinstance(end, str)]
    assert 100 < len(sentences) < 300
