"""A real unit held and turned by hand: the Xsens MTi that Tedaldi, Pretto and Menegatti recorded for imu_tk.

`PRINTED` is what imu_tk's own example program prints for this recording (9.81744 m/s², 50 s of first rest), as its
users show it in public notes; the authors' repository and README print no result. Its model: corrected = T K (raw −
bias), T of the accelerometers upper triangular, no sensitivity of the gyros to acceleration, no covariance.
"""

import os
from pathlib import Path

import numpy as np
import pytest

from gradcal_jax.calibration.equation import linear_part
from gradcal_jax.cli import main
from gradcal_jax.estimation.hand_estimate import HandReport, estimate_by_hand
from gradcal_jax.records.importers import import_log, parse_column_map
from gradcal_jax.records.log_file import read_log

FOLDER = Path(os.environ.get("GRADCAL_DATA", Path(__file__).parents[3] / "shared" / "data"))
XSENS = FOLDER / "imu_tk_xsens_mti_multiposition.npz"
pytestmark = pytest.mark.skipif(not XSENS.is_file(), reason="the recorded data are not here: set GRADCAL_DATA")

G = 9.81744
# Of the data sheet: counts per rad/s and m/s², about the middle of 16 bits.
GYRO, FORCE, ZERO = 5000.0, 400.0, 32768
COLUMN = '{name}.{a} = {{ column = "{of}_counts", index = {k}, unit = "{unit}", scale = {scale!r}, zero = {zero} }}\n'
TRIADS = (("rate", "gyro", "rad/s", 1.0 / GYRO), ("force", "acc", "m/s^2", 1.0 / FORCE))
MAP = (
    'format = "gradcal-columns/1"\nname = "Xsens MTi"\ntime = { column = "t_s", unit = "s" }\n'
    + "".join(
        COLUMN.format(name=name, of=of, unit=unit, scale=scale, zero=ZERO, a=a, k=k)
        for name, of, unit, scale in TRIADS
        for k, a in enumerate("xyz")
    )
    + '[policy]\nvalues = "keep"\n'
)
PRINTED = {
    "accelerometer": {
        "misalignment": [[1.0, -0.0033593, -0.00890639], [0.0, 1.0, -0.0213341], [0.0, 0.0, 1.0]],
        "counts": [414.459, 412.01, 414.649],
        "bias": [33124.2, 33275.2, 32364.4],
    },
    "gyro": {
        "misalignment": [[1.0, 0.00593634, 0.00111101], [0.00808812, 1.0, -0.0535569], [0.0253067, -0.0025513, 1.0]],
        "counts": [4777.96, 4764.21, 4773.66],
        "bias": [32777.1, 32459.8, 32511.8],
    },
}


@pytest.fixture(scope="module")
def report() -> HandReport:
    log = import_log(XSENS, parse_column_map(MAP))
    (found,) = estimate_by_hand(log, G, temperature_c=23.0)
    return found


def in_their_form(report: HandReport) -> dict[str, dict[str, np.ndarray]]:
    """T, counts and bias of both triads in the frame in which the accelerometers' T K is upper triangular."""
    matrix, bias = linear_part(report.calibration.channel, 23.0)
    counts = np.repeat([GYRO, FORCE], 3)
    matrix, bias = counts[:, None] * matrix, counts * bias + ZERO
    turn, upper = np.linalg.qr(np.linalg.inv(matrix[3:, 3:]))
    sign = np.sign(np.diag(upper))
    both = {"accelerometer": sign[:, None] * upper, "gyro": sign[:, None] * (turn.T @ np.linalg.inv(matrix[:3, :3]))}
    # A gyro's bias is what it says unaccelerated; theirs is what the first rest said.
    first = report.solution.positions
    rest = {"accelerometer": bias[3:], "gyro": GYRO * first.rates[int(np.argmax(first.duration))] + ZERO}
    return {
        kind: {"misalignment": m / np.diag(m), "counts": 1.0 / np.diag(m), "bias": rest[kind]}
        for kind, m in both.items()
    }


def test_it_says_what_the_authors_program_prints(report):
    """Accelerometers to a count and 7e-4; gyros as far as their sensitivity to acceleration, which it lacks, moves."""
    found = in_their_form(report)
    assert len(report.solution.positions.duration) == 38  # as many as theirs
    for kind, counts, angle, scale in (("accelerometer", 1.0, 7e-4, 1e-3), ("gyro", 1.0, 3e-3, 2e-3)):
        own, theirs = found[kind], {key: np.array(value) for key, value in PRINTED[kind].items()}
        assert np.max(np.abs(own["bias"] - theirs["bias"])) < counts, kind
        assert np.max(np.abs(own["counts"] / theirs["counts"] - 1.0)) < scale, kind
        assert np.max(np.abs(own["misalignment"] - theirs["misalignment"])) < angle, kind


def test_gravity_and_its_turns_are_explained_better_than_by_theirs(report):
    """imu_tk's turns leave ½Σ|r|² = 0.00150696 of 37 turns; the last second of the record, at the ADC's limit, is no
    part of either.
    """
    theirs = np.sqrt(2.0 * 0.00150696 / (2 * 37))
    assert report.solution.turns == 37
    assert report.turns_left < 0.35 * theirs
    assert report.gravity_left < 150e-6 * G
    assert report.solution.positions.rows[-1, 1] < 51_000
    assert float(report.calibration.valid_rate[1]) < np.radians(300.0)
    # The model is not all: the norm says so, and the covariance counts it.
    assert not report.as_wished
    assert any("|f| - g differs" in message for message in report.messages)


def test_the_command_writes_what_apply_and_export_take(tmp_path, capsys):
    columns, out, true = tmp_path / "columns.toml", tmp_path / "unit.toml", tmp_path / "true.nc"
    columns.write_text(MAP, encoding="utf-8")
    options = ["--columns", str(columns)]
    asked = ["--gravity", "9.81744 m/s^2", "--temperature", "23 degC"]
    asked += ["-o", str(out)]
    assert main(["estimate", str(XSENS), *options, *asked]) == 1
    said = capsys.readouterr().out
    assert "38 positions, 37 turns" in said
    # Of the last seconds, in which the ADC is at its limit, the turns are no part of the calibration.
    assert main(["apply", str(out), str(XSENS), *options, "-o", str(true)]) == 1
    assert "258 rates are outside the range of the calibration" in capsys.readouterr().out
    log = read_log(true)
    still = log.specific_force_m_per_s2[0, 100:5000].mean(axis=0)
    assert abs(np.linalg.norm(still) / G - 1.0) < 3e-4
    assert np.max(np.abs(log.rate_rad_per_s[0, 100:5000].mean(axis=0))) < 1e-3
    assert main(["export", str(out), "--format", "matrices", "--temperature", "23 degC"]) == 0
    capsys.readouterr()
    assert main(["export", str(out), "--format", "c-header", "-o", str(tmp_path / "unit.h")]) == 0
