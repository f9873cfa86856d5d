"""Faults put into the program by hand, over all rooms: each must be caught by the tests named beside it.

    python experiments/evidence/mutations.py            # all; writes mutations.md
    python experiments/evidence/mutations.py journal    # those whose file has this word in its name; writes nothing

Each fault is one changed line in a copy of the package. Its tests run in the copy, without those marked `long`; a fault
is caught if a test fails. The text that is replaced must stand exactly once in its file: when a room is rewritten, its
faults are written anew.
"""

import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
REPORT = Path(__file__).with_suffix(".md")
_CAUGHT = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)


@dataclass(frozen=True)
class Fault:
    """In `file` of the package, `old` becomes `new`; `tests` are those that must notice."""

    what: str
    file: str
    old: str
    new: str
    tests: str


FAULTS = (
    Fault(
        "a negative power of a unit is positive",
        "units/__init__.py",
        'str.maketrans("⁻¹²³", "-123")',
        'str.maketrans("⁻¹²³", "+123")',
        "tests/test_units.py",
    ),
    Fault(
        "the derivative of a triangular factor counts its diagonal twice",
        "linalg.py",
        "upper = jnp.triu(inner, 1) + 0.5 * jnp.diag(jnp.diagonal(inner))",
        "upper = jnp.triu(inner, 1) + jnp.diag(jnp.diagonal(inner))",
        "tests/test_linalg.py",
    ),
    Fault(
        "an unobservable combination has a finite deviation",
        "information/posterior.py",
        "values = np.where(part > 1e-7, np.inf, values)",
        "values = np.where(part > 1e-7, values, values)",
        "tests/imu/test_known_answers.py",
    ),
    Fault(
        "the noise of a reading counts its standing offset once too often",
        "information/whitening.py",
        "within[:, k, k] = (h @ own)[:, 0, 0] + variance[:, k]",
        "within[:, k, k] = 2.0 * (h @ own)[:, 0, 0] + variance[:, k]",
        "tests/imu/test_imu_roads.py tests/information/test_least_squares.py",
    ),
    Fault(
        "dT/dt of a lagging sensor has the wrong sign of its lag",
        "motion/trajectory.py",
        "return slope - self.lag_rate * self.excess[pieces][:, None] * xp.exp(-self.lag_rate * since)",
        "return slope + self.lag_rate * self.excess[pieces][:, None] * xp.exp(-self.lag_rate * since)",
        "tests/motion/test_schedules.py",
    ),
    Fault(
        "a turn's duration is rounded down, beyond the axis's acceleration",
        "recipe/rounding.py",
        'lasts = self.to("time", size / peak + max(ramp, least), ROUND_CEILING)',
        'lasts = self.to("time", size / peak + max(ramp, least), ROUND_FLOOR)',
        "tests/recipe",
    ),
    Fault(
        "a record of the journal that a crash cut off is read",
        "hardware/journal.py",
        'if length > _LONGEST or zlib.crc32(data[head:end]).to_bytes(4, "little") != data[end : end + 4]:',
        "if length > _LONGEST:",
        "tests/hardware/test_journal_and_safety.py",
    ),
    Fault(
        "events of the journal are not forced to the disk",
        "hardware/journal.py",
        "os.fsync(self._file)",
        "self._file",
        "tests/hardware/test_mishaps.py::test_a_disk_that_hangs_is_noticed_without_a_further_event",
    ),
    Fault(
        "the chamber's course is not watched",
        "hardware/chamber_control.py",
        "if abs(away) <= limits.temperature_band_k:",
        "if True:",
        "tests/hardware/test_mishaps.py",
    ),
    Fault(
        "a rule that is violated for long does not trip",
        "hardware/runner.py",
        "elif now - self._violated_since_s.setdefault(rule, now) >= PATIENCE_S.get(rule, 0.0):",
        "elif now - self._violated_since_s.setdefault(rule, now) >= max(PATIENCE_S.get(rule, 0.0), 1e9):",
        "tests/hardware/test_mishaps.py",
    ),
    Fault(
        "an absolute signal keeps its sign in a correction",
        "calibration/equation.py",
        "error = error * (np.abs(signal) if number < 0 else signal)",
        "error = error * signal",
        "tests/calibration/test_correction.py",
    ),
    Fault(
        "a map is extrapolated beyond the rates of its data",
        "calibration/equation.py",
        "error = value(clipped(along[of], channel.valid_rate))",
        "error = value(along[of])",
        "tests/calibration/test_correction.py",
    ),
    Fault(
        "ArduPilot's cubic is exported without its factor of a million",
        "calibration/flight_controllers.py",
        '{kind}{k}_{letter}": 1e6 * b[k]',
        '{kind}{k}_{letter}": b[k]',
        "tests/calibration/test_exports.py",
    ),
    Fault(
        "the Direct Bound divides by the margin, not by its square",
        "identify/direct_bound.py",
        "np.max(((drift**2 - granted) / margin**2)[:, None] / shape, axis=0)",
        "np.max(((drift**2 - granted) / margin)[:, None] / shape, axis=0)",
        "tests/identify/test_direct_bound.py",
    ),
    Fault(
        "the work of a killed worker is left out of a sweep",
        "sweeps/sweep.py",
        "waiting.appendleft(key)",
        "pass",
        "tests/sweeps/test_sweep.py",
    ),
    Fault(
        "a file is written without being forced to the disk before it takes the place of another",
        "tables/writing.py",
        "os.fsync(written.fileno())",
        "written.fileno()",
        "tests/tables/test_writing.py",
    ),
    Fault(
        "the checksum of Modbus begins with zero",
        "hardware/checksums.py",
        "_MODBUS = CrcOfRows(16, 0x8005, 0xFFFF, reflect=True)",
        "_MODBUS = CrcOfRows(16, 0x8005, 0x0000, reflect=True)",
        "tests/hardware/test_registers.py tests/hardware/test_line_protocols.py",
    ),
    Fault(
        "a negative number of 24 bits is read as a positive one",
        "hardware/frames.py",
        'return wide.view(f"{end}{kind}4")[..., 0] >> 8',
        'return wide.view(f"{end}u4")[..., 0] >> 8',
        "tests/hardware/test_frames.py",
    ),
    Fault(
        "a run that an error of a device ended is a success",
        "hardware/runner.py",
        'status, reason = "aborted", sentence_of(problem)',
        'status, reason = "success", sentence_of(problem)',
        "tests/hardware/test_runner.py",
    ),
    Fault(
        "limits of heating and of cooling are exchanged",
        "spec/checks.py",
        "(chamber.max_heating if after > before else chamber.max_cooling)",
        "(chamber.max_heating if after < before else chamber.max_cooling)",
        "tests/spec",
    ),
    Fault(
        "angles of a track are twice what the rates give",
        "records/alignment.py",
        "angles = integrate.cumulative_trapezoid(rates, time_s, axis=0, initial=0.0)",
        "angles = 2.0 * integrate.cumulative_trapezoid(rates, time_s, axis=0, initial=0.0)",
        "tests/records/test_alignment.py",
    ),
    Fault(
        "the Earth's rate points down in the north",
        "motion/table_motion.py",
        "EARTH_RATE * xp.stack([xp.zeros(()), xp.cos(self.latitude), xp.sin(self.latitude)])",
        "EARTH_RATE * xp.stack([xp.zeros(()), xp.cos(self.latitude), -xp.sin(self.latitude)])",
        "tests/imu/test_imu_roads.py",
    ),
    Fault(
        "drift and the angle that it adds are twice as correlated",
        "information/noise_steps.py",
        "q_cross = diffusion * drive * d**2 * 0.5 * g1**2",
        "q_cross = diffusion * drive * d**2 * g1**2",
        "tests/imu/test_imu_roads.py",
    ),
    Fault(
        "a wave of the angle has its cosine twice",
        "model/terms.py",
        "xp.stack([xp.cos(phase), xp.sin(phase)], axis=-1)",
        "xp.stack([xp.cos(phase), xp.cos(phase)], axis=-1)",
        "tests/imu/test_imu_roads.py",
    ),
    Fault(
        "the floor of a limit leaves out how long a reading lasts",
        "design/noise_floor.py",
        "window = 1.0 / spacing + epsilon / 2.0 + square / (2.0 * epsilon)",
        "window = 1.0 / spacing",
        "tests/design/test_limit.py",
    ),
    Fault(
        "the temperature of a lagging sensor runs away from that of the chamber",
        "formulas.py",
        "return start + slope * t + excess * xp.exp(-lag_rate * t)",
        "return start + slope * t + excess * xp.exp(lag_rate * t)",
        "tests/imu/test_channel_terms.py tests/imu/test_path_terms.py tests/motion tests/information",
    ),
    Fault(
        "priors are no data in the degrees of freedom of a fit",
        "estimation/imu_solve.py",
        "degrees = len(design) - len(of.singular)",
        "degrees = len(jacobian) - len(of.singular)",
        "tests/imu/test_imu_estimate.py",
    ),
    Fault(
        "a key that nobody knows is ignored",
        "tables/section.py",
        'extra="forbid"',
        'extra="ignore"',
        "tests/spec/test_broken_specs.py",
    ),
    Fault(
        "Ctrl-C is a success",
        "cli/app.py",
        'complain("interrupted")\n        return INTERRUPTED',
        'complain("interrupted")\n        return DONE',
        "tests/cli",
    ),
    Fault(
        "a certificate's uncertainties are not expanded",
        "pages/tables.py",
        "k = row.coverage or COVERAGE",
        "k = 1.0",
        "tests/pages/test_page.py",
    ),
    Fault(
        "the Allan variance is not halved",
        "identify/allan.py",
        "np.sqrt(total / (2 * count)) / steps",
        "np.sqrt(total / count) / steps",
        "tests/identify/test_allan.py",
    ),
)


def without_place() -> list[str]:
    """The faults whose text does not stand exactly once in its file."""
    files = {fault.file: (ROOT / "gradcal_jax" / fault.file).read_text(encoding="utf-8") for fault in FAULTS}
    return [fault.what for fault in FAULTS if files[fault.file].count(fault.old) != 1]


def caught(fault: Fault, copy: Path) -> tuple[str, float]:
    """The first test that fails with the fault in place, or an empty text; and the seconds it took."""
    path = copy / "gradcal_jax" / fault.file
    sound = path.read_text(encoding="utf-8")
    path.write_text(sound.replace(fault.old, fault.new), encoding="utf-8")
    words = [sys.executable, "-m", "pytest", "-x", "-q", "--tb=no", "-p", "no:cacheprovider", *fault.tests.split()]
    began = time.monotonic()
    try:
        done = subprocess.run(words, cwd=copy, capture_output=True, text=True, check=False)
    finally:
        path.write_text(sound, encoding="utf-8")
    if done.returncode not in (0, 1):
        raise SystemExit(f"{fault.tests}: {done.stdout[-2000:]}")
    named = _CAUGHT.search(done.stdout)
    return (named.group(1) if named and done.returncode else ""), time.monotonic() - began


def main() -> int:
    words = sys.argv[1:]
    if gone := without_place():
        raise SystemExit(f"to be written anew: {'; '.join(gone)}")
    chosen = [fault for fault in FAULTS if not words or any(word in fault.file for word in words)]
    rows: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "checkout"
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", ".venv*", ".pytest_cache", "__pycache__"))
        for number, fault in enumerate(chosen, 1):
            test, seconds = caught(fault, copy)
            print(f"{number} of {len(chosen)}, {seconds:.0f} s: {fault.what}: {test or 'NOT CAUGHT'}", flush=True)
            rows.append(f"| {fault.what} | `{fault.file}` | {f'`{test}`' if test else '**not caught**'} |")
    missed = sum("**not caught**" in row for row in rows)
    if not words:
        head = "# Faults put in by hand\n\nMade by `experiments/evidence/mutations.py`; each is one changed line.\n\n"
        table = "| fault | file | first test that fails |\n|---|---|---|\n" + "\n".join(rows) + "\n"
        foot = f"\n{len(rows) - missed} of {len(rows)} caught; {time.strftime('%Y-%m-%d')}.\n"
        REPORT.write_text(head + table + foot, encoding="utf-8")
    return 1 if missed else 0


if __name__ == "__main__":
    raise SystemExit(main())
