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
    figure must be right, `walk` within its own interval."""

    path: Path
    columns: str
    asks: str | None = None
    walk: float = N


ZOO: dict[str, Callable[[Path], Recorded]] = {}


def kind(function: Callable[[Path], Recorded]) -> Callable[[Path], Recorded]:
    ZOO[function.__name__] = function
    return function


def noise(rows: int = ROWS, hz: float = HZ, seed: int = 1, bias: float = 0.02) -> np.ndarray:
    """deg/s"""
    return bias + np.random.default_rng(seed).standard_normal(rows) * N / 60.0 * np.sqrt(hz)


def text(folder: Path, rows: list[str], header: str = "t,gx", name: str = "record.csv", **options: str) -> Path:
    path = folder / name
    path.write_text("\n".join([header, *rows]) + "\n", **({"encoding": "utf-8"} | options))
    return path


def table(folder: Path, time: np.ndarray, rate: np.ndarray, stamp: str = ".6f", value: str = ".6f") -> Path:
    return text(folder, [f"{t:{stamp}},{v:{value}}" for t, v in zip(time, rate, strict=True)])


K = np.arange(ROWS)


def stamped(name: str, time: np.ndarray, columns: str = MAP, asks: str | None = None, hz: float = HZ, **fmt: str):
    """A kind of stamps, of rows that are sound."""
    ZOO[name] = lambda folder: Recorded(table(folder, time, noise(len(time), hz), **fmt), columns, asks)


W = noise()


def valued(name: str, rate: np.ndarray, asks: str | None = None):
    """A kind of values, of stamps that are sound."""
    ZOO[name] = lambda folder: Recorded(table(folder, K[: len(rate)] / HZ, rate), MAP, asks)


def in_unit(unit: str) -> str:
    return HEAD + f'time = {{ column = "t", unit = "{unit}" }}\n' + RATE


rng = np.random.default_rng(17)
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
stamped(
    "16 bits of microseconds",
    (K * 10_000) % 2**16,
    in_unit("us"),
    asks="wrap|steps back|too coarse to distinguish",
    stamp="d",
)
stamped(
    "32 bits of microseconds",
    (2**32 - 60_000_000 + K * 10_000) % 2**32,
    in_unit("us"),
    "steps back.*wrap",
    stamp="d",
)
stamped("a restart", np.where(K < 6000, K, K - 6000) / HZ, asks="steps back")
stamped("the end of a week", (604_740.0 + K / HZ) % 604_800.0, asks="steps back")
stamped("newest first", (ROWS - K) / HZ, asks="steps back|newest first")
stamped("milliseconds as seconds", K * 10.0, asks="another unit|no gyro")
stamped("seconds as milliseconds", K / HZ, in_unit("ms"), asks="another unit|fibre-optic")
stamped("a step of the network's time", K / HZ + (K > 7000) * 1.0)
stamped("a step back of the network's time", K / HZ - (K > 7000) * 1.0, asks="steps back")


def shuffled(name: str, order: np.ndarray, asks: str | None = None, later: np.ndarray | float = 0.0):
    """Sound rows in another order, or some of them."""
    ZOO[name] = lambda folder: Recorded(table(folder, (K / HZ + later)[order], W[order]), MAP, asks)


shuffled("a twentieth lost", rng.random(ROWS) > 0.05)
shuffled("a fifth lost", rng.random(ROWS) > 0.2)
shuffled("one long gap", (K < 5000) | (K > 6000))
shuffled("every hundredth lost", K % 100 != 0, "sample_rate")


@kind
def rows_that_changed(folder: Path) -> Recorded:
    rate = np.rint(W / 0.05) * 0.05
    kept = np.diff(rate, prepend=9.0) != 0.0
    return Recorded(table(folder, K[kept] / HZ, rate[kept]), MAP, "gaps with about")


def spiked(rate: np.ndarray, rows: np.ndarray, by: float) -> np.ndarray:
    result = rate.copy()
    result[rows] += by
    return result


def replaced(rate: np.ndarray, rows: np.ndarray, by: float) -> np.ndarray:
    result = rate.copy()
    result[rows] = by
    return result


FEW = rng.choice(ROWS, 8, replace=False)
ZEROS = rng.choice(ROWS, 30, replace=False)
valued("spikes", spiked(W, FEW, 18.0))
valued("pairs of spikes", spiked(spiked(W, FEW[:4], 9.0), (FEW[:4] + 1) % ROWS, -9.0))
valued("rows of the least count", replaced(W, FEW, -1000.0))
valued("rows of zeros", replaced(W + 5.0, ZEROS, 0.0))
valued("a channel that freezes", replaced(W, np.arange(3000, 3400), W[3000]), asks="frozen")
valued("a drift of temperature", W + 5e-5 * K, "do not follow|no angle|trend")
valued("half of the resolution after an hour", np.where(K < 6000, W, np.rint(W / 0.1) * 0.1), "noise|coarse|step")
valued("bits that flip", np.where(np.isin(K, FEW), W + 2.0**6 * 0.061, W))
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
valued("steps of the noise", np.rint(W / 0.05) * 0.05, "times its noise, and increase the measured noise")
valued("steps of a fifth of the noise", np.rint(W / 0.01) * 0.01)
valued("one constant value", np.full(ROWS, 0.25), "the same value|does not change")
valued(
    "counts of 16 bits without a sign",
    np.rint(W / 0.004) % 65536,
    "are they counts",
)
valued("the mean of 8 samples", np.convolve(noise(ROWS + 7), np.ones(8) / 8, "valid"))
valued("a sample that is read twice", np.repeat(noise(ROWS // 2, 50.0), 2))
valued("a sample that is read four times", np.repeat(noise(ROWS // 4, 25.0), 4))
valued("an angle instead of a rate", np.cumsum(W) / HZ, "does not|no angle random walk|do not follow|trend")
valued("a hum of the mains", W + 0.3 * np.sin(2 * np.pi * 9.7 * K / HZ), "do not follow")
valued("a sensor that was moved", W + 30.0 * np.exp(-(((K - 6000) / 200.0) ** 2)), "do not follow|any gyro")


OFFSETS = np.array([0.0, 1.3, -0.9])
valued("two sensors in turns", W + OFFSETS[K % 2], "several sensors alternate")
valued("three sensors in turns", W + OFFSETS[K % 3], "several sensors alternate")


def lines(name: str, header: str, row: Callable[[int, float], str], more: str = "", asks: str | None = None, **options):
    """A kind of text."""
    base = options.pop("base", MAP)
    ZOO[name] = lambda folder: Recorded(
        text(folder, [row(k, v) for k, v in enumerate(W)], header, **options), base + more, asks
    )


SEMI = '[csv]\ndelimiter = ";"\ndecimal = ","\n'
COUNTS = HEAD + TIME + 'rate.x = { column = "gx", unit = "deg/s", scale = 5e-4, zero = 1000 }\n'
lines("decimal commas", "t;gx", lambda k, v: f"{k / HZ:.2f};{v:.6f}".replace(".", ","), SEMI)
lines("decimal commas, not said", "t;gx", lambda k, v: f"{k / HZ:.2f};{v:.6f}".replace(".", ","),
      '[csv]\ndelimiter = ";"\n', "decimal comma")  # fmt: skip
lines(
    "marks of thousands",
    "t;gx",
    lambda k, v: f"{k / HZ:.2f};{1000 + v / 5e-4:_.0f}".replace(".", ",").replace("_", "."),
    SEMI,
    "thousands separator",
    base=COUNTS,
)
lines("Swiss thousands", "t,gx", lambda k, v: f"{k / HZ:.2f}," + f"{1000 + v / 5e-4:,.0f}".replace(",", "'"),
      "", "notation", base=COUNTS)  # fmt: skip
lines("spaces between thousands", "t,gx", lambda k, v: f"{k / HZ:.2f}," + f"{1000 + v / 5e-4:,.0f}".replace(",", " "),
      "", "notation", base=COUNTS)  # fmt: skip
lines("a typographic minus", "t,gx", lambda k, v: f"{k / HZ:.2f},{v:.6f}".replace("-", "\u2212"))
lines("brackets for a minus", "t,gx", lambda k, v: f"{k / HZ:.2f}," + (f"({-v:.6f})" if v < 0 else f"{v:.6f}"),
      "", "notation")  # fmt: skip
lines("units in the cells", "t,gx", lambda k, v: f"{k / HZ:.2f},{v:.6f} deg/s", "", "no numbers")
lines("hexadecimal counts", "t,gx", lambda k, v: f"{k / HZ:.2f},0x{round(1000 + v / 5e-4):04X}", "", "hexadecimal",
      base=COUNTS)  # fmt: skip
lines("times of day", "t,gx", lambda k, v: f"12:{k // 6000:02d}:{k % 6000 / 100:05.2f},{v:.6f}", "", "times of day")
lines("exponents", "t,gx", lambda k, v: f"{k / HZ:.6e},{v:.6e}")
lines("tabs", "t\tgx", lambda k, v: f"{k / HZ:.2f}\t{v:.6f}", '[csv]\ndelimiter = "tab"\n')
lines("a row of units", "t,gx\ns,deg/s", lambda k, v: f"{k / HZ:.2f},{v:.6f}")
lines("a preamble", "Logger 3\nStart: 12:00, SN 5\n\nDATA_START\nt,gx", lambda k, v: f"{k / HZ:.2f},{v:.6f}")
lines("quotes", '"t","gx"', lambda k, v: f'"{k / HZ:.2f}","{v:.6f}"')
lines("16 bits a letter", "t,gx", lambda k, v: f"{k / HZ:.2f},{v:.6f}", '[csv]\nencoding = "utf-16"\n',
      encoding="utf-16")  # fmt: skip
lines("torn lines", "t,gx", lambda k, v: f"{k / HZ:.2f}" if k % 1500 == 7 else f"{k / HZ:.2f},{v:.6f}")
lines("words for missing values", "t,gx", lambda k, v: f"{k / HZ:.2f}," + ("#N/A" if k % 300 == 9 else f"{v:.6f}"))
lines("a checksum", "t,gx", lambda k, v: f"{k / HZ:.2f},{v:.6f}*{k % 256:02X}")
lines("an odd ending", "t,gx", lambda k, v: f"{k / HZ:.2f},{v:.6f}<{k % 97}>",
      "", "no numbers")  # fmt: skip
lines("other messages between", "t,gx", lambda k, v: f"{k / HZ:.2f},{v:.6f}\nINFO: {k % 97} alive", "",
      "no number but text")  # fmt: skip
lines("an id, and whose", "t,id,gx", lambda k, v: f"{k / HZ:.4f},1,{v:.6f}\n{k / HZ + 0.003:.4f},2,{7 - 2 * v:.6f}",
      'where = { column = "id", equals = 1 }\n')  # fmt: skip
lines("an id, and not whose", "t,id,gx", lambda k, v: f"{k / HZ:.4f},1,{v:.6f}\n{k / HZ + 0.003:.4f},2,{v + 0.1:.6f}",
      "", "several sensors")  # fmt: skip
lines("names of sensors, and whose", "t,sensor,gx", lambda k, v: f"{k / HZ:.4f},gyr,{v:.6f}\n{k / HZ:.4f},acc,9.8",
      'where = { column = "sensor", equals = "gyr" }\n')  # fmt: skip
lines("rows of another channel", "t,gx,ax", lambda k, v: f"{k / HZ:.4f},{v:.6f},\n{k / HZ + 0.004:.4f},,9.8", "",
      "interpolate = true")  # fmt: skip
lines("a slower channel", "t,gx,ax", lambda k, v: f"{k / HZ:.4f},{v:.6f}," + ("" if k % 4 else f"{9.8 + v:.4f}"),
      'interpolate = true\n[force]\nx = { column = "ax", unit = "m/s^2" }\n')  # fmt: skip
lines("rad/s by the header", "t,gx (rad/s)", lambda k, v: f"{k / HZ:.2f},{np.radians(v):.9f}", "", "the unit rad/s",
      base=HEAD + TIME + 'rate.x = { column = "gx (rad/s)", unit = "deg/s" }\n')  # fmt: skip
lines("mdps by the header", "t,gx [mdps]", lambda k, v: f"{k / HZ:.2f},{1000 * v:.3f}", "", "states the unit mdps",
      base=HEAD + TIME + 'rate.x = { column = "gx [mdps]", unit = "deg/s" }\n')  # fmt: skip
lines("deg/s as rad/s", "t,gx", lambda k, v: f"{k / HZ:.2f},{v:.6f}", "", "any gyro|no gyro",
      base=HEAD + TIME + 'rate.x = { column = "gx", unit = "rad/s" }\n')  # fmt: skip
lines("a header again and again", "t,gx", lambda k, v: ("t,gx\n" if k % 1000 == 500 else "") + f"{k / HZ:.2f},{v:.6f}")


# Single samples at 400 Hz, of which every 40th is written.
stamped("thinned_and_said", K / 10.0, HEAD + 'sensor_rate = "400 Hz"\n' + TIME + RATE, hz=400.0)
stamped("thinned_and_not_said", K / 10.0, asks="each row is a single sample", hz=400.0)
stamped("means_at_one_hertz", K * 1.0, hz=1.0)


@kind
def compressed_text(folder: Path) -> Recorded:
    plain = table(folder, K / HZ, W)
    return Recorded(plain.rename(folder / "record.csv.gz"), MAP, "unknown file name extension")


def parquet(name: str, unit: str, epoch: np.ndarray, kind: pyarrow.DataType):
    """A kind of stamps in Parquet."""

    def write(folder: Path) -> Recorded:
        columns = pyarrow.table({"t": pyarrow.array(epoch, type=kind), "gx": W})
        pyarrow.parquet.write_table(columns, folder / "record.parquet")
        return Recorded(folder / "record.parquet", in_unit(unit))

    ZOO[name] = write


parquet("parquet", "ns", 1_700_000_000_000_000_000 + K * 10_000_000, pyarrow.int64())
parquet("parquet_of_dates", "us", 1_700_000_000_000_000 + K * 10_000, pyarrow.timestamp("us"))


@kind
def struct_of_matlab(folder: Path) -> Recorded:
    held = {"t": K / HZ, "imu": {"wb": np.column_stack([W, noise(seed=2)]), "name": "SN-1"}}
    savemat(folder / "record.mat", held)
    rate = 'rate.x = { column = "imu.wb", index = 0, unit = "deg/s" }\n'
    return Recorded(folder / "record.mat", HEAD + TIME + rate)


def sentences(name: str, columns: str, asks: str | None = None, mixed: bool = False):
    """A receiver's text: the last field ends in a checksum."""

    def write(folder: Path) -> Recorded:
        rows = [f"$VNIMU,1,2,3,0,0,-9.8,{w:.6f},0,{-w:.6f},21.5,101.3*{k % 256:02X}" for k, w in enumerate(W)]
        if mixed:
            rows = [line for k, row in enumerate(rows) for line in (row, f"$VNYPR,{k},{k + 1},{k + 2},1,1,1,0.5,9*00")]
        return Recorded(text(folder, rows[1:], rows[0], "record.txt"), columns, asks)

    ZOO[name] = write


VN = HEAD + 'sample_rate = "100 Hz"\nrate.x = { column = 7, unit = "deg/s" }\n[csv]\nheader = false\n'
sentences("sentences of a receiver", VN)
sentences("two kinds of sentences, and which", VN + "lines = '$VNIMU'\n", mixed=True)
sentences("two kinds of sentences", VN, "several kinds", mixed=True)


# --- neighbours: what else stands in tables, in stamps, in values ----------------------------------------------------


def named(name: str, column: str, asks: str, unit: str = "deg/s", size: float = 1.0):
    """A kind of name, of values that could be a gyro's."""
    lines(f"a column named {name}", f"t,{column}", lambda k, v: f"{k / HZ:.2f},{size * v:.6f}", "", asks,
          base=HEAD + TIME + f'rate.x = {{ column = "{column}", unit = "{unit}" }}\n')  # fmt: skip


named("as a quaternion", "qx", "states a quaternion")
named("as an angle", "roll", "states an angle")
named("as a specific force", "acc_x", "states a specific force")
named("as a magnetic field", "mag_x", "states a magnetic field")
named("as counts", "gx (LSB)", "states counts")
named("in turns a minute", "gx [rpm]", "states the unit rpm")
lines("stamps named as ticks", "t [ticks],gx", lambda k, v: f"{k * 328},{v:.6f}", "", "states counts",
      base=HEAD + 'time = { column = "t [ticks]", unit = "us" }\n' + RATE)  # fmt: skip
lines("unnamed ticks beside a stated rate", "t,gx", lambda k, v: f"{k * 12800},{v:.6f}", "", "clock ticks",
      base=HEAD + 'sample_rate = "100 Hz"\ntime = { column = "t", unit = "us" }\n' + RATE)  # fmt: skip
lines(
    "a row of other units",
    "t,gx\ns,rad/s",
    lambda k, v: f"{k / HZ:.2f},{np.radians(v):.8f}",
    "",
    "the unit rad/s",
)
lines(
    "a row of units in brackets",
    "t,gx\n[s],[mdps]",
    lambda k, v: f"{k / HZ:.2f},{1e3 * v:.3f}",
    "",
    "states the unit mdps",
)
lines("whole numbers", "t,gx", lambda k, v: f"{k / HZ:.2f},{v / 0.2:.0f}", "", "are they counts")
lines("row numbers without a name", "t,gx", lambda k, v: f"{k + 1},{k / HZ:.2f},{v:.6f}", "", "more fields than")
lines("unquoted thousands", "t,gx", lambda k, v: f"{k / HZ:.2f},{1000 + v / 5e-4:,.0f}", "", "more fields than",
      base=COUNTS)  # fmt: skip
lines("thousands in quotes", "t,gx", lambda k, v: f'{k / HZ:.2f},"{1000 + v / 5e-4:,.0f}"', "", "thousands separator",
      base=COUNTS)  # fmt: skip
lines("a remark with fewer names", "# t,gx", lambda k, v: f"{k / HZ:.2f},{v:.6f},7")
lines("decimal commas between commas", "t,gx", lambda k, v: f"{k / HZ:.2f},{v:.6f}".replace(".", ","), "",
      "more fields than")  # fmt: skip
lines("a comma at the end", "t,gx,", lambda k, v: f"{k / HZ:.2f},{v:.6f},")
lines("words of a C library", "t,gx", lambda k, v: f"{k / HZ:.2f}," + ("-nan(ind)" if k % 90 == 7 else f"{v:.6f}"))
lines("lines of both systems", "t,gx", lambda k, v: f"{k / HZ:.2f},{v:.6f}" + "\r" * (k % 2))
lines("a mark of the byte order amid", "t,gx", lambda k, v: "\ufeff" * (k == 6000) + f"{k / HZ:.2f},{v:.6f}")
lines("remarks amid", "t,gx", lambda k, v: ("% resync\n# again\n" if k % 3000 == 5 else "") + f"{k / HZ:.2f},{v:.6f}")
lines("zero bytes at the end", "t,gx", lambda k, v: f"{k / HZ:.2f},{v:.6f}" + "\0" * 500 * (k == ROWS - 1))
lines("a comma too many, now and then", "t,gx", lambda k, v: f"{k / HZ:.2f},{v:.6f}" + "," * (k % 700 == 3))
lines("half of the rows empty", "t,gx", lambda k, v: f"{k / HZ:.2f},{v:.6f}\n,")
lines("a tenth without a stamp", "t,gx", lambda k, v: ("" if k % 9 == 3 else f"{k / HZ:.2f}") + f",{v:.6f}", "",
      "unreadable row")  # fmt: skip
lines("a number for a missing value", "t,gx", lambda k, v: f"{k / HZ:.2f}," + ("-999" if k % 20 == 7 else f"{v:.6f}"),
      "", "mark missing readings")  # fmt: skip
lines("a small number for a missing one", "t,gx", lambda k, v: f"{k / HZ:.2f}," + ("-1" if k % 20 == 7 else f"{v:.6f}"),
      "", "mark missing readings")  # fmt: skip
lines(
    "rare numbers for missing values", "t,gx", lambda k, v: f"{k / HZ:.2f}," + ("-9999" if k % 999 == 7 else f"{v:.6f}")
)

KIND = 'rate.x = { column = "v", unit = "deg/s", where = { column = "id", equals = "gyr" } }\n'
KIND += 'force.x = { column = "v", unit = "m/s^2", where = { column = "id", equals = "acc" } }\n'
KIND += 'temperature = { column = "v", unit = "degC", where = { column = "id", equals = "tmp" } }\n'
lines("three kinds of rows in one column", "t,id,v", lambda k, v: (f"{k / HZ + 0.002:.4f},tmp,{22 + k / ROWS:.3f}\n"
      if k % 50 == 0 else "") + f"{k / HZ:.4f},gyr,{v:.6f}\n{k / HZ + 0.004:.4f},acc,{9.8 + v:.5f}",
      base=HEAD + "interpolate = true\n" + TIME + KIND)  # fmt: skip
AXES = "".join(
    f'rate.{a} = {{ column = "v", unit = "deg/s", where = {{ column = "axis", equals = "{a}" }} }}\n' for a in "xy"
)
lines("an axis a row", "t,axis,v", lambda k, v: f"{k / HZ:.2f},x,{v:.6f}\n{k / HZ:.2f},y,{1 - v:.6f}", "", "all rates",
      base=HEAD + "interpolate = true\n" + TIME + AXES)  # fmt: skip
lines("an axis a row, and not which", "t,axis,v", lambda k, v: f"{k / HZ:.2f},x,{v:.6f}\n{k / HZ:.2f},y,{1 - v:.6f}",
      "", "several sensors", base=HEAD + TIME + 'rate.x = { column = "v", unit = "deg/s" }\n')  # fmt: skip

shuffled("pairs of rows swapped", K.reshape(-1, 2)[:, ::-1].ravel(), "Sort the rows")
shuffled("tens of rows from the last", K.reshape(-1, 10)[:, ::-1].ravel(), "Sort the rows")
shuffled("packets out of order", np.argsort(K + 3.0 * rng.random(ROWS)), "Sort the rows")
shuffled("two clocks in turns", K, "two alternating clocks", 1000.0 * (K % 2))
shuffled("from the start's clock to that of the day", K, "another clock", 1.7e9 * (K > 3000))
shuffled("daylight saving ends", K, "steps back", -3600.0 * (K > 7000))
shuffled("daylight saving begins", K, None, 3600.0 * (K > 7000))
stamped("two logs on end", np.concatenate([K[:6000], K[:6000]]) / HZ, asks="steps back")
stamped("intervals for stamps", 0.01 + 1e-5 * rng.standard_normal(ROWS), asks="do not increase", stamp=".7f")
stamped("one interval for all stamps", np.full(ROWS, 0.01), asks="do not increase")
stamped("six digits of an epoch", 1.7e9 + K / HZ, asks="do not increase", stamp=".5E")
stamped("32 bits with a sign", (2**31 - 60_000_000 + K * 10_000 + 2**31) % 2**32 - 2**31, in_unit("us"),
        "steps back.*wrap", stamp="d")  # fmt: skip
stamped("days of a spreadsheet", 45_000.0 + K / HZ / 86_400.0, in_unit("d"), stamp=".9f")


def changed_to(hz: float):
    def write(folder: Path) -> Recorded:
        time = np.concatenate([K[:6000] / HZ, 60.0 + K[:6000] / hz])
        return Recorded(table(folder, time, np.concatenate([noise(6000), noise(6000, hz)])), MAP, "rows come at 100 Hz")

    ZOO[f"a rate that changes to {hz:g} Hz"] = write


changed_to(200.0)
changed_to(50.0)
valued("noise cut off at a limit", np.clip(W, -0.05, 0.09), "cuts off the noise")
valued("noise cut off on one side", np.maximum(W, -0.03), "cuts off the noise")
QUIET = np.convolve(np.abs(W - 0.02), np.ones(25) / 25, "same") < 0.038
valued("zeros while it seems at rest", np.where(QUIET, 0.0, W), "a dead band")

WARM = 22.0 + 3.0 * K / ROWS


def warmed(name: str, shown: np.ndarray, asks: str | None = None):
    """A kind of thermometer."""
    ZOO[f"a thermometer {name}"] = lambda folder: Recorded(
        text(folder, [f"{k / HZ:.2f},{v:.6f},{c:.3f}" for k, v, c in zip(K, W, shown, strict=True)], "t,gx,temp"),
        MAP + 'temperature = { column = "temp", unit = "degC" }\n',
        asks,
    )


warmed("at 0", 0.0 * WARM, "never changes")
warmed("at 85", 0.0 * WARM + 85.0, "never changes")
warmed("that begins at 85", np.where(K < 100, 85.0, WARM), "a temperature that jumps")
warmed("that restarts", np.where(K % 700 < 20, 85.0, WARM), "a temperature that jumps")
warmed("with a loose wire", np.where(K % 1000 == 7, 0.0, WARM), "a temperature that jumps")
warmed("in tenths", 10.0 * WARM, "counts")
warmed("that stops", np.where(K > 5000, WARM[5000], WARM), "constant temperature")
