"""Files of many layouts become the log that their numbers say, or a sentence."""

import os
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from gradcal_jax.records.column_names import EXAMPLE, map_to_fill_in
from gradcal_jax.records.importers import import_log, parse_column_map, read_column_map
from gradcal_jax.records.log import LogError
from gradcal_jax.tables.problems import SpecError

HEAD = 'format = "gradcal-columns/1"\n'
PLAIN = HEAD + 'time = { column = "t", unit = "ms" }\nrate.x = { column = "gx", unit = "deg/s" }\n'
ID = HEAD + 'sample_rate = "100 Hz"\nrate.x = { column = "gx", unit = "deg/s" }\n'
RATES = np.random.default_rng(0).standard_normal((50, 3))


ROWS = [f"{10 * i},{i % 3},{20 + i / 8}" for i in range(40)]
WARM = 'temperature = { column = "temp", unit = "degC" }\n'
NUMBERED = 'time = { column = 0, unit = "ms" }\nrate.x = { column = 1, unit = "deg/s" }\n'
NUMBERED += 'temperature = { column = 2, unit = "degC" }\n[csv]\ndelimiter = "whitespace"\nheader = false\n'
COMMAS = HEAD + 'time = { column = "Zeit", unit = "ms" }\nrate.x = { column = "w °/s", unit = "deg/s" }\n'
COMMAS += 'temperature = { column = "T", unit = "degC" }\n[csv]\ndelimiter = ";"\nencoding = "latin-1"\ndecimal = ","\n'
SKIPPED = "some words\r\n# a remark\r\n# t; gx; temp\r\n" + "\r\n".join(ROWS).replace(",", ";")


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("t,gx,temp\n" + "\n".join(ROWS) + "\n", PLAIN + WARM),
        ("\ufeff" + SKIPPED, PLAIN + WARM + '[csv]\ndelimiter = ";"\nskip = 1\n'),
        ("\n\n".join(ROWS).replace(",", "   "), HEAD + NUMBERED),
        ("Zeit;w °/s;T\n" + "\n".join(row.replace(",", ";").replace(".", ",") for row in ROWS), COMMAS),
    ],
)
def test_text_tables_in_their_many_layouts(tmp_path, content, text):
    path = tmp_path / "run.csv"
    path.write_text(content, encoding="latin-1" if "latin-1" in text else "utf-8")
    log = import_log(path, text)
    np.testing.assert_allclose(log.time_s, np.arange(40) * 0.01)
    np.testing.assert_allclose(log.rate_rad_per_s[0, :, 0], np.radians(np.arange(40) % 3))
    assert log.temperature_c[0, -1] == 20 + 39 / 8
    assert log.counts() == {"used": 40}
    assert log.provenance == {"source": "run.csv"}
    if "latin-1" in text:
        with pytest.raises(LogError, match='encoding = "latin-1" or "utf-16"'):
            import_log(path, text.replace("latin-1", "utf-8"))


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("a.csv", b"t,gx,gx\n0,1,2\n10,3,4\n", "several columns are named 'gx': give the number .* 1 or 2"),
        ("a.csv", b"t;gx\n0;1\n10;3\n", 'or is delimiter = ";" missing'),
        ("a.csv", b"", "is empty"),
        ("a.csv", b"t,gx\n", "no rows below the header"),
        ("a.csv", b"1,2\n3,4\n", "no line of column names"),
        ("a.csv", b"t,gX\n1,2\n3,4\n", "no column 'gx'; nearest: 'gX'"),
        ("a.csv", b"t,gx\n1,2\n", "at least two"),
        ("a.csv", b"\xff\xfe\x00t", "not text in UTF-8"),
        ("a.npz", b"PK nonsense", "cannot be read as NumPy's .npz"),
        ("a.npy", b"\x93NUMPY nonsense", "cannot be read as NumPy's .npy"),
        ("a.mat", b"MATLAB 7.3 MAT-file", "-v7"),
        ("a.mat", b"nonsense" * 40, "cannot be read as MATLAB"),
    ],
)
def test_a_faulty_file_gets_a_sentence(tmp_path, name, content, sentence):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(LogError, match=sentence):
        import_log(path, PLAIN)


@pytest.mark.parametrize("stamp", ["2024-05-01T12:00:0{}.5Z", "12:00:0{}.5", "json"])
def test_the_conversion_that_a_message_states_gives_the_record(tmp_path, monkeypatch, stamp):
    monkeypatch.chdir(tmp_path)
    path, lines = Path("a.csv"), [f"{stamp.format(s)},{s % 3}\n" for s in range(9)]
    if stamp == "json":
        path, lines = Path("a.jsonl"), [f'{{"t": {s}, "gx": {s % 3}}}\n' for s in range(9)]
    path.write_text("t,gx\n" * (stamp != "json") + "".join(lines), encoding="utf-8")
    with pytest.raises(LogError) as caught:
        import_log(path, PLAIN)
    program = str(caught.value).partition("pandas: ")[2].partition(". Or")[0]
    with warnings.catch_warnings(action="ignore"):  # pandas guesses the format
        exec(program, {"pd": pd, "file": path, "column": "t"})
    log = import_log(path.with_suffix(".csv"), PLAIN.replace('"ms"', '"s"'))
    assert log.time_s.tolist() == list(range(9))


@pytest.mark.parametrize("begin", ["", "t,gx\n" + "0,1\n" * 600])
def test_zeros_of_a_disk_are_not_read_into_memory(tmp_path, begin):
    """4 GB of zero bytes, as a loss of power leaves them."""
    path = tmp_path / "a.csv"
    path.write_text(begin, encoding="utf-8")
    os.truncate(path, 4 << 30)
    with pytest.raises(LogError, match="a line is longer than 1000000 characters"):
        import_log(path, PLAIN)
    assert bool(map_to_fill_in(path)) == bool(begin)


def test_rows_are_chosen_before_anything_is_judged(tmp_path):
    """The part before a restart is read where the whole cannot be."""
    path = tmp_path / "a.csv"
    stamps = [*range(0, 600, 10), *range(0, 400, 10)]
    path.write_text("t,gx\n" + "".join(f"{t},{i % 3}\n" for i, t in enumerate(stamps)), encoding="utf-8")
    with pytest.raises(LogError, match=r'--rows "0\.\.60" and --rows "60\.\."'):
        import_log(path, PLAIN)
    assert import_log(path, PLAIN, rows=(60, None)).counts() == {"used": 40, "left out": 60}
    assert import_log(path, PLAIN, rows=(70, 90)).counts() == {"used": 20, "left out": 80}
    with pytest.raises(LogError, match="fewer than two rows"):
        import_log(path, PLAIN, rows=(99, 120))


def test_torn_rows_are_counted_and_the_others_kept(tmp_path):
    path = tmp_path / "torn.csv"
    path.write_text('t,gx\n0,1\n10\n20,abc\n,5\n30,"2"\n# remark\n\n40,1_0\n50,3 # said later\nnan,1\n60,4,7,8\n')
    log = import_log(path, PLAIN)
    # 9 rows: two without time; of the others three without rate.
    assert log.rows_read == 9
    assert log.counts() == {"used": 4, "unreadable row": 2, "missing rate": 3}
    np.testing.assert_allclose(np.degrees(log.rate_rad_per_s[0, log.usable(), 0]), [1, 2, 3, 4])


def test_scale_zero_and_units_of_counts(tmp_path):
    path = tmp_path / "counts.npz"
    counts = np.array([[100, 0], [-32768, 1], [32767, 1], [0, 0]], np.int16)
    stamps = 1_700_000_000_000_000_000 + np.array([0, 1, 2, 3]) * 10_000_000
    np.savez(path, gyro=counts, t=stamps, flags=np.array([0, 0, 4, 0], np.uint8), f=[32.0, 50.0, 68.0, 212.0])
    text = HEAD + 'time = { column = "t", unit = "ns" }\nstatus = { column = "flags" }\n'
    text += 'temperature = { column = "f", unit = "degF" }\n'
    text += 'rate.x = { column = "gyro", index = 0, unit = "mdps", scale = 8.75, zero = 100 }\n'
    log = import_log(path, text)
    expected = (np.array([100.0, -32768.0, np.nan, 0.0]) - 100.0) * 8.75e-3  # the third row is masked
    np.testing.assert_allclose(np.degrees(log.rate_rad_per_s[0, :, 0]), expected, atol=1e-12)
    np.testing.assert_allclose(log.time_s, [0, 0.01, 0.02, 0.03], rtol=1e-12)  # in spite of 1.7e18
    np.testing.assert_allclose(log.temperature_c[0], [0, 10, np.nan, 100], atol=1e-12)
    assert log.counts() == {"used": 3, "marked": 1}


def test_matlab_and_npy_give_what_text_gives(tmp_path):
    time = np.arange(50) * 10.0
    others = {"text": "words", "pair": 1j * np.ones(3), "s": {"a": 1.0}}
    savemat(tmp_path / "run.mat", {"t": time, "gyro": RATES, "gx": RATES[:, :1], **others}, do_compression=True)
    np.save(tmp_path / "run.npy", np.column_stack([time, RATES]))
    numbered = HEAD + 'time = { column = 0, unit = "ms" }\nrate.x = { column = 1, unit = "deg/s" }\n'
    indexed = PLAIN.replace('"gx"', '"gyro", index = 0')
    for name, text in (("run.mat", PLAIN), ("run.mat", indexed), ("run.npy", numbered)):
        log = import_log(tmp_path / name, text)
        np.testing.assert_allclose(log.rate_rad_per_s[0, :, 0], np.radians(RATES[:, 0]), rtol=1e-14)
        np.testing.assert_allclose(log.time_s, time / 1000)


FORCES = "".join(f'force.{a} = {{ column = "acc", index = {k}, unit = "mg" }}\n' for k, a in enumerate("xyz"))


def test_specific_forces_are_read_masked_and_judged(tmp_path):
    path, n = tmp_path / "imu.npz", 400
    rng = np.random.default_rng(5)
    acc = 1000.0 * np.array([0.6, 0.0, 0.8]) + 5.0 * rng.standard_normal((n, 3))
    acc[7, 1] = np.nan
    np.savez(path, t=np.arange(n) * 10.0, gx=0.1 * rng.standard_normal(n), acc=acc, counts=np.full((n, 3), 33000))
    log = import_log(path, PLAIN + FORCES)
    acc[7] = np.nan  # masked
    np.testing.assert_allclose(log.specific_force_m_per_s2[0], 9.80665e-3 * acc, rtol=1e-12)
    assert log.counts() == {"used": n - 1, "missing force": 1}
    assert import_log(path, PLAIN + FORCES, rows=(0, 9)).specific_force_m_per_s2.shape == (1, 9, 3)
    counts = FORCES.replace('"acc"', '"counts"').replace('"mg"', '"m/s^2"')
    for wrong in (FORCES.replace('"mg"', '"m/s^2", scale = 1e-3'), counts):
        with pytest.raises(LogError, match="is its unit g, or counts"):
            import_log(path, PLAIN + wrong)
    kept = import_log(path, PLAIN + counts + "[policy]\nvalues = 'keep'\n")
    assert [finding.kind for finding in kept.findings] == ["question"]
    assert kept.specific_force_m_per_s2[0, 0, 2] == 33000.0


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "format: this key is missing"),
        (PLAIN + "[policy]\nvalues = 'split'", 'policy.values = "split": expected "refuse" or "keep"'),
        (PLAIN.replace("deg/s", "deg"), "rate.x.unit"),
        (PLAIN.replace('"ms"', '"m"'), "time.unit"),
        (PLAIN + 'tempreature = { column = "a", unit = "degC" }', 'nearest: "temperature"'),
        (PLAIN + 'temperature = { column = "T", unit = "K" }', "zero = 273.15"),
        (HEAD + 'rate.x = { column = "gx", unit = "deg/s" }', "sample_rate"),
        (HEAD + 'time = { column = "t", unit = "ms" }', "name at least one axis"),
        (PLAIN + "[csv]\ndelimiter = 'abc'", "csv.delimiter"),
        (PLAIN + '[csv]\ndecimal = ","\n', "another delimiter"),
        (PLAIN.replace('unit = "deg/s"', 'unit = "deg/s", scale = 0.0'), "must not be zero"),
    ],
)
def test_a_faulty_column_map_is_told_by_key(text, sentence):
    assert list(parse_column_map(EXAMPLE).rate) == ["x", "y", "z"]
    with pytest.raises(SpecError) as caught:
        parse_column_map(text)
    assert sentence in str(caught.value)


def test_pickles_directories_and_missing_files_are_refused(tmp_path):
    (tmp_path / "d.csv").mkdir()
    for name, values, sentence in (
        ("p.npz", np.array([None, 1, 2], object), "without pickles"),
        ("w.npz", ["a", "b", "c"], "has no numbers"),
        ("l.npz", [1.0, 2.0], "different numbers of rows"),
        ("d.csv", None, "is a directory"),
        ("none.csv", None, "does not exist"),
    ):
        if values is not None:
            np.savez(tmp_path / name, t=np.arange(3.0), gx=values)
        with pytest.raises(LogError, match=sentence):
            import_log(tmp_path / name, PLAIN)
    with pytest.raises(SpecError, match="does not exist"):
        read_column_map(tmp_path / "none.toml")


def test_a_table_and_what_is_known_of_the_record(tmp_path):
    angle, rest = np.linspace(0, 720, 50), np.arange(50) < 9
    np.savez(tmp_path / "a.npz", a=RATES, angle=angle, rest=rest)
    text = HEAD + 'sample_rate = "200 Hz"\nstandstill = { column = "rest" }\nsimulated = true\npolicy.values = "keep"\n'
    text += 'name = "SN-a"\ntable_angle.inner = { column = "angle", unit = "deg" }\n'
    text += 'rate.z = { column = "a", index = 2, unit = "rad/s" }\n'
    log = import_log(tmp_path / "a.npz", text)
    assert (log.units, log.axes, log.simulated) == (("SN-a",), ("z",), True)
    np.testing.assert_array_equal(log.rate_rad_per_s[0, :, 0], RATES[:, 2])
    np.testing.assert_allclose(log.table_angle_rad[:, 0], np.radians(angle))
    assert log.standstill.tolist() == np.where(rest, 0, -1).tolist()
    assert log.time_s[1] == 0.005


def test_of_sensors_that_are_not_there_the_values_are_shown(tmp_path):
    (tmp_path / "a.csv").write_text("id,gx\n" + "1,0.1\n2,0.2\n" * 300, encoding="utf-8")
    np.savez(tmp_path / "a.npz", id=np.tile([1, 2], 300), gx=np.tile([0.1, 0.2], 300))
    where = 'where = {{ column = "id", equals = {} }}\n'
    for name in ("a.csv", "a.npz"):
        with pytest.raises(LogError, match=r"where: no row has 3 .*include 1, 2"):
            import_log(tmp_path / name, ID + where.format(3))
        log = import_log(tmp_path / name, ID + where.format(2))
        assert np.degrees(log.rate_rad_per_s).ravel() == pytest.approx(np.full(300, 0.2))


ENDINGS = st.sampled_from([".csv", ".npz", ".npy", ".mat", ".txt"])
STARTS = st.sampled_from(
    [b"", b"t,gx\n", b"PK\x03\x04", b"\x93NUMPY\x01\x00", b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\x01IM"]
)


@given(ending=ENDINGS, start=STARTS, content=st.binary(max_size=400))
@settings(max_examples=200, deadline=None)
def test_arbitrary_bytes_give_a_log_or_a_sentence(tmp_path_factory, ending, start, content):
    path = tmp_path_factory.mktemp("bytes") / f"a{ending}"
    path.write_bytes(start + content)
    try:
        log = import_log(path, PLAIN)
    except LogError as error:
        if not str(error):
            raise
        return
    assert sum(log.counts().values()) == log.rows_read


FIELDS = st.one_of(
    st.floats().map(repr), st.sampled_from(["", "x", '"', "1e999", "1_0", " 5 ", "#", "0x1"]), st.integers().map(str)
)


@given(rows=st.lists(st.lists(FIELDS, max_size=4), max_size=30))
@settings(max_examples=150, deadline=None)
def test_every_row_of_any_text_table_is_accounted_for(tmp_path_factory, rows):
    lines = [",".join(row) for row in rows]
    path = tmp_path_factory.mktemp("rows") / "a.csv"
    path.write_text("t,gx\n" + "\n".join(lines) + "\n", encoding="utf-8")
    try:
        log = import_log(path, PLAIN + "[policy]\nvalues = 'keep'\n")
    except LogError:
        return
    expected = sum(1 for line in lines if line.split("#")[0].strip())
    assert log.rows_read == expected == sum(log.counts().values())


@given(text=st.text(max_size=200), tail=st.booleans())
@settings(max_examples=100, deadline=None)
def test_arbitrary_maps_give_a_sentence(text, tail):
    try:
        parse_column_map(PLAIN + text if tail else text)
    except SpecError:
        return
    assert tail
