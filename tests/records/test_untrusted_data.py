"""Data that may come from anybody: sizes are checked before they are believed, links to other files are refused."""

import gzip
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from pydantic import ValidationError

from gradcal_jax.records.column_map import AngleColumn, TextTable
from gradcal_jax.records.log import LogError
from gradcal_jax.records.table_files import read_table
from gradcal_jax.tables.document import read_toml
from gradcal_jax.tables.netcdf import NetcdfError, load_netcdf
from gradcal_jax.tables.problems import SpecError


def test_a_key_of_many_parts_is_refused_at_once() -> None:
    plain, quoted, inline = ".".join("a" * 100_000), ".".join(['"a"'] * 100_000), "b." * 9999
    for text in (f"{plain} = 1", f"[{quoted}]", f"a = {{{inline}b = 1}}"):
        begun = time.process_time()
        with pytest.raises(SpecError, match="parts"):
            read_toml(text)
        assert time.process_time() - begun < 2.0


def test_declared_sizes_are_checked_before_they_are_read(tmp_path: Path) -> None:
    columns = [AngleColumn(column="x", unit="deg")]
    np.savez_compressed(tmp_path / "bomb.npz", x=np.zeros(50_000_000))
    with gzip.open(tmp_path / "bomb.csv.gz", "wb") as file:
        for _ in range(30):
            file.write(b"x" + b" " * 10_000_000)
    with h5py.File(tmp_path / "bomb.nc", "w") as file:
        file.create_dataset("x", (10**12,), np.float64, chunks=(10**6,))
    for name in ("bomb.npz", "bomb.csv.gz"):
        with pytest.raises(LogError, match=r"MB of data in a file of|the limit"):
            read_table(tmp_path / name, TextTable(), columns)
    with pytest.raises(NetcdfError, match=r"MB of data in a file of|the limit"):
        load_netcdf(tmp_path / "bomb.nc")


def test_data_of_other_files_are_refused(tmp_path: Path) -> None:
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


@pytest.mark.parametrize("pattern", ["(a+)+b", "a*a*b", r"(\w*)*$", "(a|a)*b"])
def test_a_column_map_has_no_pattern_that_takes_hours(pattern: str) -> None:
    with pytest.raises(ValidationError, match="at most one"):
        TextTable(lines=pattern)
    assert TextTable(lines=r"^\[a-z]+,", strip=r"\*[0-9A-F]{2}\s*$").lines is not None
