"""Data that may come from anybody: sizes are checked before they are believed, links to other files are refused."""

import time

import h5py
import numpy as np
import pytest

from gradcal_jax.records.column_map import parse_column_map
from gradcal_jax.records.log import LogError
from gradcal_jax.records.table_files import read_table
from gradcal_jax.tables.document import read_toml
from gradcal_jax.tables.netcdf import NetcdfError, load_netcdf
from gradcal_jax.tables.problems import SpecError


def test_a_key_of_many_parts_is_refused_at_once():
    plain, quoted, inline = ".".join("a" * 100_000), ".".join(['"a"'] * 100_000), "b." * 9999
    for text in (f"{plain} = 1", f"[{quoted}]", f"a = {{{inline}b = 1}}"):
        begun = time.process_time()
        with pytest.raises(SpecError, match="parts"):
            read_toml(text)
        assert time.process_time() - begun < 2.0


def test_declared_sizes_are_checked_before_they_are_read(tmp_path):
    columns = parse_column_map(
        'format = "gradcal-columns/1"\nsample_rate = "1 Hz"\nrate.x = { column = "x", unit = "deg/s" }'
    )
    np.savez_compressed(tmp_path / "bomb.npz", x=np.zeros(50_000_000))
    with h5py.File(tmp_path / "bomb.nc", "w") as file:
        file.create_dataset("x", (10**12,), np.float64, chunks=(10**6,))
    with pytest.raises(LogError, match=r"MB of data in a file of|the limit"):
        read_table(tmp_path / "bomb.npz", columns)
    with pytest.raises(NetcdfError, match=r"MB of data in a file of|the limit"):
        load_netcdf(tmp_path / "bomb.nc")


def test_data_of_other_files_are_refused(tmp_path):
    (tmp_path / "secret").write_bytes(bytes(80))
    with h5py.File(tmp_path / "linked.nc", "w") as file:
        file["x"] = h5py.ExternalLink("secret.nc", "/x")
    with h5py.File(tmp_path / "stored.nc", "w") as file:
        file.create_dataset("x", (10,), np.float64, external=[(str(tmp_path / "secret"), 0, 80)])
    with h5py.File(tmp_path / "virtual.nc", "w") as file:
        layout = h5py.VirtualLayout((10,), np.float64)
        layout[:] = h5py.VirtualSource(str(tmp_path / "secret.nc"), "x", shape=(10,))
        file.create_virtual_dataset("x", layout)
    for name, said in (("linked.nc", "link"), ("stored.nc", "another file"), ("virtual.nc", "another file")):
        with pytest.raises(NetcdfError, match=said):
            load_netcdf(tmp_path / name)
