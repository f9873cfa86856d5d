"""netCDF files are read as they are; damaged ones get a sentence."""

import numpy as np
import pytest
import xarray

from gradcal_jax.records.log import Log, LogError
from gradcal_jax.records.log_file import read_log, write_log
from gradcal_jax.tables.netcdf import load_netcdf


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


def test_a_block_of_the_user_before_the_data_is_none_of_our_business(sound, tmp_path):
    (tmp_path / "block.nc").write_bytes(bytes(1024) + sound.read_bytes())
    xarray.testing.assert_identical(load_netcdf(tmp_path / "block.nc"), load_netcdf(sound))


@pytest.mark.parametrize("share", [0.02, 0.5, 0.98])
def test_a_file_that_was_cut_off_gets_a_sentence(sound, tmp_path, share):
    content = sound.read_bytes()
    (tmp_path / "cut.nc").write_bytes(content[: int(share * len(content))])
    with pytest.raises(LogError, match="it is damaged"):
        read_log(tmp_path / "cut.nc")
