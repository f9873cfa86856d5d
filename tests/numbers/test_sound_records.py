"""Records without a fault give the figures that they gave before faults of recordings were looked for.

Rates and Allan deviations are as they were, to 1e-12. Those are 3e-16 apart, since squares are summed in other pieces;
the fit takes differences of nearly equal terms of them, and its coefficients move by up to 6e-8, which is less than a
millionth of their standard errors. The program that recorded them differs from itself by more, up to 3e-7, where its
sums run on one thread in place of two. The Direct Bound follows the fit's random walk.
"""

import json

import numpy as np
import pytest
import sound_records

KEPT = json.loads((sound_records.HERE / "sound_records.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize(("name", "warm"), sound_records.cases())
def test_figures_of_sound_records_are_as_before(tmp_path, name, warm):
    kept = KEPT[f"{name}, warmed" if warm else name]
    now = sound_records.figures(*sound_records.write(name, tmp_path, warm=warm))
    assert now["rows"] == kept["rows"]
    for key in ("interval", "rms", "deviation"):
        np.testing.assert_allclose(now[key], kept[key], rtol=1e-12)
    off = np.abs(np.subtract(now["coefficients"], kept["coefficients"]))
    assert np.all(off <= 1e-6 * np.array(kept["errors"]))
    np.testing.assert_allclose(now["errors"], kept["errors"], rtol=1e-6)
    np.testing.assert_allclose(now["bound"], kept["bound"], rtol=1e-6)
