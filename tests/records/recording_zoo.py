"""Generated records of a gyro at rest, each of a kind that people have, with its truth: white noise of N = 0.3 deg/√h,
or the words of the question that the kind must raise. `ZOO[name](folder)` writes one and returns it."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow
import pyarrow.parquet
from scipy.io import savemat

N = 0.3  # deg/sqrt(h)
ROWS, HZ = 12_000, 100.0
HEAD = 'format = "gradcal-columns/1"\n'
TIME = 'time = { column = "t", unit = "s" }\n'
RATE = 'rate.x = { column = "gx", unit = "deg/s" }\n'
MAP = HEAD + TIME + RATE


class Recorded(NamedTuple):
    """A file with its map; `asks`: a pattern of the question, or of the note that makes the figure doubtful; None: the
    figure must be right, `N` within its own interval."""

    path: Path
    columns: str
    asks: str | None = None


ZOO: dict[str, Callable[[Path], Recorded]] = {}


def noise(rows: int = ROWS, hz: float = HZ, seed: int = 1) -> np.ndarray:
    """deg/s"""
    return 0.02 + np.random.default_rng(seed).standard_normal(rows) * N / 60.0 * np.sqrt(hz)


K = np.arange(ROWS)
W = noise()
rng = np.random.default_rng(17)


def text(folder: Path, rows: list[str], file: str = "record.csv", encoding: str = "utf-8") -> Path:
    path = folder / file
    path.write_text("\n".join(rows) + "\n", encoding=encoding)
    return path


def stamped(
    name: str,
    time: np.ndarray,
    columns: str = MAP,
    asks: str | None = None,
    hz: float = HZ,
    stamp: str = ".6f",
    rate: np.ndarray | None = None,
):
    """A kind of stamps, of rows that are sound unless they are given."""
    values = noise(len(time), hz) if rate is None else rate
    ZOO[name] = lambda folder: Recorded(
        text(folder, ["t,gx", *(f"{t:{stamp}},{v:.6f}" for t, v in zip(time, values, strict=True))]), columns, asks
    )


def valued(name: str, rate: np.ndarray, asks: str | None = None):
    """A kind of values, of stamps that are sound."""
    stamped(name, K / HZ, asks=asks, rate=rate)


def shuffled(name: str, order: np.ndarray, asks: str | None = None, later: np.ndarray | float = 0.0):
    """Sound rows in another order, or some of them."""
    stamped(name, (K / HZ + later)[order], asks=asks, rate=W[order])


def in_unit(unit: str) -> str:
    return HEAD + f'time = {{ column = "t", unit = "{unit}" }}\n' + RATE


def gyro(column: str, unit: str = "deg/s") -> str:
    return HEAD + TIME + f'rate.x = {{ column = "{column}", unit = "{unit}" }}\n'


stamped("seconds", K / HZ)
stamped("milliseconds", K * 10.0, in_unit("ms"), stamp=".0f")
stamped("microseconds", K * 1e4, in_unit("us"), stamp=".0f")
stamped("nanoseconds of an epoch", 1_700_000_000_000_000_000 + K * 10_000_000, in_unit("ns"), stamp="d")
stamped("an epoch with two decimals", 1_700_000_000.0 + K / HZ, stamp=".2f")
stamped("seconds of 32 bits", np.float32(40_000.0 + K / HZ).astype(float))
stamped(
    "seconds of 32 bits that repeat", np.float32(400_000.0 + K / HZ).astype(float), asks="too coarse to distinguish"
)
stamped("1 kHz", K / 1000.0, hz=1000.0)
stamped("8 kHz in microseconds", np.rint(K * 125.0), in_unit("us"), hz=8000.0, stamp=".0f")
stamped("bursts of twenty", (K // 20) * 0.2 + (K % 20) * 1e-4)
stamped("pairs", (K // 2) * 0.02 + (K % 2) * 2e-4)
stamped("threes", (K // 3) * 0.03 + (K % 3) * 1e-3)
stamped("bursts at unlike times", (K // 20) * 0.2 + (K % 20) * 1e-4 + 0.02 * rng.random(ROWS // 20)[K // 20])
stamped("whole milliseconds at 800 Hz", np.floor(K / 0.8) / 1000.0, hz=800.0)
stamped("whole milliseconds at 300 Hz", np.floor(K / 0.3) / 1000.0, hz=300.0)
stamped("jitter", K / HZ + 5e-4 * rng.standard_normal(ROWS))
stamped("late stamps, now and then", K / HZ + np.where(rng.random(ROWS) < 0.002, 0.004, 0.0))
stamped("a clock that wanders", np.cumsum(0.01 * (1.0 + 3e-4 * np.sin(K / 3000.0))))
stamped("whole seconds", np.floor(K / HZ), asks='too coarse to distinguish.*sample_rate = "100', stamp=".0f")
stamped("every stamp twice", (K // 2) / 50.0, asks="too coarse to distinguish")
stamped("16 bits of microseconds", (K * 10_000) % 2**16, in_unit("us"),
        "wrap|steps back|too coarse to distinguish", stamp="d")  # fmt: skip
stamped("32 bits of microseconds", (2**32 - 60_000_000 + K * 10_000) % 2**32, in_unit("us"),
        "steps back.*wrap", stamp="d")  # fmt: skip
stamped("a restart", K % 6000 / HZ, asks="steps back")
stamped("the end of a week", (604_740.0 + K / HZ) % 604_800.0, asks="steps back")
stamped("newest first", (ROWS - K) / HZ, asks="steps back|newest first")
stamped("milliseconds as seconds", K * 10.0, asks="another unit|no gyro")
stamped("seconds as milliseconds", K / HZ, in_unit("ms"), asks="another unit|fibre-optic")
stamped("a step of the network's time", K / HZ + (K > 7000))
stamped("a step back of the network's time", K / HZ - (K > 7000), asks="steps back")

shuffled("a twentieth lost", rng.random(ROWS) > 0.05)
shuffled("a fifth lost", rng.random(ROWS) > 0.2)
shuffled("one long gap", (K < 5000) | (K > 6000))
shuffled("every hundredth lost", K % 100 != 0, "sample_rate")
STEPS = np.rint(W / 0.05) * 0.05
KEPT = np.diff(STEPS, prepend=9.0) != 0.0
stamped("rows_that_changed", K[KEPT] / HZ, asks="gaps with about", rate=STEPS[KEPT])

FEW = rng.choice(ROWS, 8, replace=False)
SPIKES, ZEROS = np.isin(K, FEW), np.isin(K, rng.choice(ROWS, 30, replace=False))
valued("spikes", W + 18.0 * SPIKES)
valued("pairs of spikes", W + 9.0 * np.isin(K, FEW[:4]) - 9.0 * np.isin(K, (FEW[:4] + 1) % ROWS))
valued("rows of the least count", np.where(SPIKES, -1000.0, W))
valued("rows of zeros", np.where(ZEROS, 0.0, W + 5.0))
valued("a channel that freezes", np.where((K >= 3000) & (K < 3400), W[3000], W), "frozen")
valued("a drift of temperature", W + 5e-5 * K, "do not follow|no angle|trend")
valued("half of the resolution after an hour", np.where(K < 6000, W, np.rint(W / 0.1) * 0.1), "noise|coarse|step")
valued("bits that flip", W + 2.0**6 * 0.061 * SPIKES)
valued("a sign that is lost", np.abs(W), "sign")
valued("noise that doubles", 0.02 + (W - 0.02) * np.where(K < 6000, 1.0, 3.0), "do not follow")
valued(
    "a filtered median",
    np.median(np.stack([W[k : k + ROWS - 4] for k in range(5)]), 0)[np.minimum(K, ROWS - 5)],
    "low-pass",
)
valued("upsampled by lines", np.interp(K / 4.0, np.arange(ROWS // 4 + 1), noise(ROWS // 4 + 1, 25.0)))
valued("floats of 16 bits", np.float16(W).astype(float))
valued("a bias that is taken off each second", W - np.repeat(W.reshape(-1, 100).mean(1), 100), "do not follow")
valued("jumps of the bias", W + 0.05 * np.array([0, 1, 0, 2, 1, 3])[K * 6 // ROWS])
valued("a dead band", np.where(np.abs(W - 0.02) < 0.12, 0.0, W), "dead band")
valued("a small dead band", np.where(np.abs(W) < 0.02, 0.0, W), "a dead band")
valued("two values", np.rint((W - 0.02) / 0.5 + 0.5) * 0.5, "dead band|coarse")
valued("one value in most rows", np.rint(W / 0.5) * 0.5, "dead band|coarse")
valued("steps of the noise", STEPS, "times its noise, and increase the measured noise")
valued("steps of a fifth of the noise", np.rint(W / 0.01) * 0.01)
valued("one constant value", np.full(ROWS, 0.25), "the same value|does not change")
valued("counts of 16 bits without a sign", np.rint(W / 0.004) % 65536, "are they counts")
valued("the mean of 8 samples", np.convolve(noise(ROWS + 7), np.ones(8) / 8, "valid"))
valued("a sample that is read twice", np.repeat(noise(ROWS // 2, 50.0), 2))
valued("a sample that is read four times", np.repeat(noise(ROWS // 4, 25.0), 4))
valued("an angle instead of a rate", np.cumsum(W) / HZ, "does not|no angle random walk|do not follow|trend")
valued("a hum of the mains", W + 0.3 * np.sin(2 * np.pi * 9.7 * K / HZ), "do not follow")
valued("a sensor that was moved", W + 30.0 * np.exp(-(((K - 6000) / 200.0) ** 2)), "do not follow|any gyro")
OFFSETS = np.array([0.0, 1.3, -0.9])
valued("two sensors in turns", W + OFFSETS[K % 2], "several sensors alternate")
valued("three sensors in turns", W + OFFSETS[K % 3], "several sensors alternate")

ROW = "{t:.2f},{v:.6f}"
Row = str | Callable[[int, float], str]


def lines(
    name: str,
    row: Row = ROW,
    asks: str | None = None,
    columns: str = MAP,
    *,
    header: str = "t,gx",
    odd: tuple[int, int, Row] = (1, 1, ""),
    swap: tuple[str, str] = ("", ""),
    **options: str,
):
    """A kind of text. `row`: a function of the row's number and rate, or a format of its number k, time t, rate v and
    counts n; `odd`: of so many rows, and which one of them, is written so; `swap`: characters that stand for others."""

    def one(k: int, v: float) -> str:
        form = odd[2] if k % odd[0] == odd[1] else row
        return form(k, v) if callable(form) else form.format(k=k, t=k / HZ, v=v, n=round(1000 + v / 5e-4))

    def write(folder: Path) -> Recorded:
        rows = [one(k, v).translate(str.maketrans(*swap)) for k, v in enumerate(W)]
        return Recorded(text(folder, [header] * bool(header) + rows, **options), columns, asks)

    ZOO[name] = write


DELIMITED = MAP + '[csv]\ndelimiter = ";"\n'
DECIMAL = 'decimal = ","\n'
COUNTS = HEAD + TIME + 'rate.x = { column = "gx", unit = "deg/s", scale = 5e-4, zero = 1000 }\n'
COMMAS = (".", ",")
lines("decimal commas", "{t:.2f};{v:.6f}", None, DELIMITED + DECIMAL, header="t;gx", swap=COMMAS)
lines("decimal commas, not said", "{t:.2f};{v:.6f}", "decimal comma", DELIMITED, header="t;gx", swap=COMMAS)
lines("marks of thousands", "{t:.2f};{n:_}", "thousands separator", COUNTS + '[csv]\ndelimiter = ";"\n' + DECIMAL,
      header="t;gx", swap=("._", ",."))  # fmt: skip
lines("Swiss thousands", "{t:.2f},{n:_}", "notation", COUNTS, swap=("_", "'"))
lines("spaces between thousands", "{t:.2f},{n:_}", "notation", COUNTS, swap=("_", " "))
lines("a typographic minus", swap=("-", "\u2212"))
lines("brackets for a minus", lambda k, v: f"{k / HZ:.2f}," + (f"({-v:.6f})" if v < 0 else f"{v:.6f}"), "notation")
lines("units in the cells", ROW + " deg/s", "no numbers")
lines("hexadecimal counts", "{t:.2f},0x{n:04X}", "hexadecimal", COUNTS)
lines("times of day", lambda k, v: f"12:{k // 6000:02d}:{k % 6000 / 100:05.2f},{v:.6f}", "times of day")
lines("exponents", "{t:.6e},{v:.6e}")
lines("tabs", "{t:.2f}\t{v:.6f}", columns=MAP + '[csv]\ndelimiter = "tab"\n', header="t\tgx")
lines("a row of units", header="t,gx\ns,deg/s")
lines("a preamble", header="Logger 3\nStart: 12:00, SN 5\n\nDATA_START\nt,gx")
lines("quotes", '"{t:.2f}","{v:.6f}"', header='"t","gx"')
lines("16 bits a letter", columns=MAP + '[csv]\nencoding = "utf-16"\n', encoding="utf-16")
lines("torn lines", odd=(1500, 7, "{t:.2f}"))
lines("words for missing values", odd=(300, 9, "{t:.2f},#N/A"))
lines("a checksum", lambda k, v: f"{k / HZ:.2f},{v:.6f}*{k % 256:02X}")
lines("an odd ending", lambda k, v: f"{k / HZ:.2f},{v:.6f}<{k % 97}>", "no numbers")
lines("other messages between", lambda k, v: f"{k / HZ:.2f},{v:.6f}\nINFO: {k % 97} alive", "no number but text")
lines("an id, and whose", lambda k, v: f"{k / HZ:.4f},1,{v:.6f}\n{k / HZ + 0.003:.4f},2,{7 - 2 * v:.6f}", None,
      MAP + 'where = { column = "id", equals = 1 }\n', header="t,id,gx")  # fmt: skip
lines("an id, and not whose", lambda k, v: f"{k / HZ:.4f},1,{v:.6f}\n{k / HZ + 0.003:.4f},2,{v + 0.1:.6f}",
      "several sensors", header="t,id,gx")  # fmt: skip
lines("names of sensors, and whose", "{t:.4f},gyr,{v:.6f}\n{t:.4f},acc,9.8", None,
      MAP + 'where = { column = "sensor", equals = "gyr" }\n', header="t,sensor,gx")  # fmt: skip
lines("rows of another channel", lambda k, v: f"{k / HZ:.4f},{v:.6f},\n{k / HZ + 0.004:.4f},,9.8",
      "interpolate = true", header="t,gx,ax")  # fmt: skip
lines("a slower channel", "{t:.4f},{v:.6f},", None,
      MAP + 'interpolate = true\n[force]\nx = { column = "ax", unit = "m/s^2" }\n', header="t,gx,ax",
      odd=(4, 0, lambda k, v: f"{k / HZ:.4f},{v:.6f},{9.8 + v:.4f}"))  # fmt: skip
lines("rad/s by the header", lambda k, v: f"{k / HZ:.2f},{np.radians(v):.9f}", "the unit rad/s",
      gyro("gx (rad/s)"), header="t,gx (rad/s)")  # fmt: skip
lines("mdps by the header", lambda k, v: f"{k / HZ:.2f},{1000 * v:.3f}", "states the unit mdps",
      gyro("gx [mdps]"), header="t,gx [mdps]")  # fmt: skip
lines("deg/s as rad/s", ROW, "any gyro|no gyro", gyro("gx", "rad/s"))
lines("a header again and again", odd=(1000, 500, "t,gx\n" + ROW))

# Single samples at 400 Hz, of which every 40th is written.
stamped("thinned_and_said", K / 10.0, HEAD + 'sensor_rate = "400 Hz"\n' + TIME + RATE, hz=400.0)
stamped("thinned_and_not_said", K / 10.0, asks="each row is a single sample", hz=400.0)
stamped("means_at_one_hertz", K, hz=1.0)
lines("compressed_text", "{t:.6f},{v:.6f}", "unknown file name extension", file="record.csv.gz")


def parquet(name: str, unit: str, epoch: np.ndarray, kind: pyarrow.DataType):
    """A kind of stamps in Parquet."""

    def write(folder: Path) -> Recorded:
        columns = pyarrow.table({"t": pyarrow.array(epoch, type=kind), "gx": W})
        pyarrow.parquet.write_table(columns, folder / "record.parquet")
        return Recorded(folder / "record.parquet", in_unit(unit))

    ZOO[name] = write


parquet("parquet", "ns", 1_700_000_000_000_000_000 + K * 10_000_000, pyarrow.int64())
parquet("parquet_of_dates", "us", 1_700_000_000_000_000 + K * 10_000, pyarrow.timestamp("us"))


def struct_of_matlab(folder: Path) -> Recorded:
    held = {"t": K / HZ, "imu": {"wb": np.column_stack([W, noise(seed=2)]), "name": "SN-1"}}
    savemat(folder / "record.mat", held)
    rate = 'rate.x = { column = "imu.wb", index = 0, unit = "deg/s" }\n'
    return Recorded(folder / "record.mat", HEAD + TIME + rate)


ZOO["struct_of_matlab"] = struct_of_matlab


def sentence(k: int, v: float) -> str:
    """A receiver's text: the last field ends in a checksum."""
    return f"$VNIMU,1,2,3,0,0,-9.8,{v:.6f},0,{-v:.6f},21.5,101.3*{k % 256:02X}"


def two_sentences(k: int, v: float) -> str:
    return f"{sentence(k, v)}\n$VNYPR,{k},{k + 1},{k + 2},1,1,1,0.5,9*00"


VN = HEAD + 'sample_rate = "100 Hz"\nrate.x = { column = 7, unit = "deg/s" }\n[csv]\nheader = false\n'
RECEIVER = {"header": "", "file": "record.txt"}
lines("sentences of a receiver", sentence, None, VN, **RECEIVER)
lines("two kinds of sentences, and which", two_sentences, None, VN + "lines = '$VNIMU'\n", **RECEIVER)
lines("two kinds of sentences", two_sentences, "several kinds", VN, **RECEIVER)

# --- neighbours: what else stands in tables, in stamps, in values ----------------------------------------------------

for named, column, asks in (
    ("as a quaternion", "qx", "states a quaternion"),
    ("as an angle", "roll", "states an angle"),
    ("as a specific force", "acc_x", "states a specific force"),
    ("as a magnetic field", "mag_x", "states a magnetic field"),
    ("as counts", "gx (LSB)", "states counts"),
    ("in turns a minute", "gx [rpm]", "states the unit rpm"),
):
    lines(f"a column named {named}", ROW, asks, gyro(column), header=f"t,{column}")
lines("stamps named as ticks", lambda k, v: f"{k * 328},{v:.6f}", "states counts",
      HEAD + 'time = { column = "t [ticks]", unit = "us" }\n' + RATE, header="t [ticks],gx")  # fmt: skip
lines("unnamed ticks beside a stated rate", lambda k, v: f"{k * 12800},{v:.6f}", "clock ticks",
      HEAD + 'sample_rate = "100 Hz"\ntime = { column = "t", unit = "us" }\n' + RATE)  # fmt: skip
lines("a row of other units", lambda k, v: f"{k / HZ:.2f},{np.radians(v):.8f}", "the unit rad/s",
      header="t,gx\ns,rad/s")  # fmt: skip
lines("a row of units in brackets", lambda k, v: f"{k / HZ:.2f},{1e3 * v:.3f}", "states the unit mdps",
      header="t,gx\n[s],[mdps]")  # fmt: skip
lines("whole numbers", lambda k, v: f"{k / HZ:.2f},{v / 0.2:.0f}", "are they counts")
lines("row numbers without a name", lambda k, v: f"{k + 1},{k / HZ:.2f},{v:.6f}", "more fields than")
lines("unquoted thousands", "{t:.2f},{n:,}", "more fields than", COUNTS)
lines("thousands in quotes", '{t:.2f},"{n:,}"', "thousands separator", COUNTS)
lines("a remark with fewer names", ROW + ",7", header="# t,gx")
lines("decimal commas between commas", ROW, "more fields than", swap=COMMAS)
lines("a comma at the end", ROW + ",", header="t,gx,")
lines("words of a C library", odd=(90, 7, "{t:.2f},-nan(ind)"))
lines("lines of both systems", odd=(2, 1, ROW + "\r"))
lines("a mark of the byte order amid", odd=(ROWS, 6000, "\ufeff" + ROW))
lines("remarks amid", odd=(3000, 5, "% resync\n# again\n" + ROW))
lines("zero bytes at the end", odd=(ROWS, ROWS - 1, ROW + "\0" * 500))
lines("a comma too many, now and then", odd=(700, 3, ROW + ","))
lines("half of the rows empty", ROW + "\n,")
lines("a tenth without a stamp", ROW, "unreadable row", odd=(9, 3, ",{v:.6f}"))
lines("a number for a missing value", ROW, "mark missing readings", odd=(20, 7, "{t:.2f},-999"))
lines("a small number for a missing one", ROW, "mark missing readings", odd=(20, 7, "{t:.2f},-1"))
lines("rare numbers for missing values", odd=(999, 7, "{t:.2f},-9999"))

KIND = 'rate.x = { column = "v", unit = "deg/s", where = { column = "id", equals = "gyr" } }\n'
KIND += 'force.x = { column = "v", unit = "m/s^2", where = { column = "id", equals = "acc" } }\n'
KIND += 'temperature = { column = "v", unit = "degC", where = { column = "id", equals = "tmp" } }\n'
TOGETHER = HEAD + "interpolate = true\n" + TIME


def two_kinds(k: int, v: float) -> str:
    return f"{k / HZ:.4f},gyr,{v:.6f}\n{k / HZ + 0.004:.4f},acc,{9.8 + v:.5f}"


lines("three kinds of rows in one column", two_kinds, None, TOGETHER + KIND, header="t,id,v",
      odd=(50, 0, lambda k, v: f"{k / HZ + 0.002:.4f},tmp,{22 + k / ROWS:.3f}\n{two_kinds(k, v)}"))  # fmt: skip
AXES = "".join(
    f'rate.{a} = {{ column = "v", unit = "deg/s", where = {{ column = "axis", equals = "{a}" }} }}\n' for a in "xy"
)
for named, asks, columns in (
    ("an axis a row", "all rates", TOGETHER + AXES),
    ("an axis a row, and not which", "several sensors", gyro("v")),
):
    lines(named, lambda k, v: f"{k / HZ:.2f},x,{v:.6f}\n{k / HZ:.2f},y,{1 - v:.6f}", asks, columns, header="t,axis,v")

shuffled("pairs of rows swapped", K.reshape(-1, 2)[:, ::-1].ravel(), "Sort the rows")
shuffled("tens of rows from the last", K.reshape(-1, 10)[:, ::-1].ravel(), "Sort the rows")
shuffled("packets out of order", np.argsort(K + 3.0 * rng.random(ROWS)), "Sort the rows")
shuffled("two clocks in turns", K, "two alternating clocks", 1000.0 * (K % 2))
shuffled("from the start's clock to that of the day", K, "another clock", 1.7e9 * (K > 3000))
shuffled("daylight saving ends", K, "steps back", -3600.0 * (K > 7000))
shuffled("daylight saving begins", K, None, 3600.0 * (K > 7000))
stamped("two logs on end", K % 6000 / HZ, asks="steps back")
stamped("intervals for stamps", 0.01 + 1e-5 * rng.standard_normal(ROWS), asks="do not increase", stamp=".7f")
stamped("one interval for all stamps", np.full(ROWS, 0.01), asks="do not increase")
stamped("six digits of an epoch", 1.7e9 + K / HZ, asks="do not increase", stamp=".5E")
stamped("32 bits with a sign", (2**31 - 60_000_000 + K * 10_000 + 2**31) % 2**32 - 2**31, in_unit("us"),
        "steps back.*wrap", stamp="d")  # fmt: skip
stamped("days of a spreadsheet", 45_000.0 + K / HZ / 86_400.0, in_unit("d"), stamp=".9f")
for hz in (200.0, 50.0):
    time = np.concatenate([K[:6000] / HZ, 60.0 + K[:6000] / hz])
    both = np.concatenate([noise(6000), noise(6000, hz)])
    stamped(f"a rate that changes to {hz:g} Hz", time, asks="rows come at 100 Hz", rate=both)

valued("noise cut off at a limit", np.clip(W, -0.05, 0.09), "cuts off the noise")
valued("noise cut off on one side", np.maximum(W, -0.03), "cuts off the noise")
QUIET = np.convolve(np.abs(W - 0.02), np.ones(25) / 25, "same") < 0.038
valued("zeros while it seems at rest", np.where(QUIET, 0.0, W), "a dead band")

WARM = 22.0 + 3.0 * K / ROWS


def warmed(name: str, shown: np.ndarray, asks: str | None = None):
    """A kind of thermometer."""
    lines(f"a thermometer {name}", lambda k, v: f"{k / HZ:.2f},{v:.6f},{shown[k]:.3f}", asks,
          MAP + 'temperature = { column = "temp", unit = "degC" }\n', header="t,gx,temp")  # fmt: skip


warmed("at 0", 0.0 * WARM, "never changes")
warmed("at 85", np.full(ROWS, 85.0), "never changes")
warmed("that begins at 85", np.where(K < 100, 85.0, WARM), "a temperature that jumps")
warmed("that restarts", np.where(K % 700 < 20, 85.0, WARM), "a temperature that jumps")
warmed("with a loose wire", np.where(K % 1000 == 7, 0.0, WARM), "a temperature that jumps")
warmed("in tenths", 10.0 * WARM, "counts")
warmed("that stops", np.minimum(WARM, WARM[5000]), "constant temperature")
