"""The importers on real recordings: every row arrives, nothing sound is blamed."""

import os
from pathlib import Path

import numpy as np
import pytest

from gradcal_jax.records.importers import import_log, parse_column_map

FOLDER = Path(os.environ.get("GRADCAL_DATA", Path(__file__).parents[3] / "shared" / "data"))
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="the recorded data are not here: set GRADCAL_DATA")

HEAD = 'format = "gradcal-columns/1"\nsample_rate = "100 Hz"\n'


@pytest.mark.parametrize("sensor", [("bno", 2000), ("imu", 1000)])
@pytest.mark.parametrize("run", ["rate_nofilt1", "rate_filt2", "steps_yaw"])
def test_two_sensors_on_a_jig(run, sensor):
    (name, full), rows = sensor, 12_000 if run.startswith("rate") else 20_000
    text = f'{HEAD}time = {{ column = "{run}_t", unit = "s" }}\n'
    for number, axis in enumerate("xyz"):
        text += f'rate.{axis} = {{ column = "{run}_giro_{name}_raw", index = {number}, unit = "deg/s"'
        text += f", scale = {full / 32768} }}\n"
    log = import_log(FOLDER / "rimu_jig_rate_and_steps.npz", parse_column_map(text))
    assert log.findings == ()
    assert log.counts() == {"used": rows}
    with np.load(FOLDER / "rimu_jig_rate_and_steps.npz") as source:
        counts = source[f"{run}_giro_{name}_raw"].astype(float)
    np.testing.assert_allclose(log.rate_rad_per_s[0], np.radians(counts * full / 32768), rtol=1e-12)
