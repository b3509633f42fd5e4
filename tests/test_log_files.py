"""Files of other programs: formats, time, rows, units, constant inputs, and real recordings."""

import csv
import json
import math
import os
import re
import sys
import time
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pyarrow
import pyarrow.parquet
import pytest
import scipy.io
from experiments import described as plant
from experiments import recording

from excite.record import Record, columns_in, read_record, write_record
from excite.record.units import unit_factor

TIME, U, Y = [0.0, 0.1, 0.2], [1.5, -2.0, 0.25], [-0.25, 1.0, 3.0]


def read(path: Path, text: str | bytes, **options: object) -> Record:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_record(path, plant(), **options)  # pyright: ignore[reportArgumentType]


def is_the_log(record: Record) -> bool:
    np.testing.assert_allclose(record.time, TIME, atol=1e-12)
    np.testing.assert_array_equal(record.inputs[:, 0], U)
    np.testing.assert_array_equal(record.outputs[:, 0], Y)
    return True


# DataFrames


FRAMES: dict[str, pd.DataFrame] = {
    "columns": pd.DataFrame({"time": TIME, "u": U, "y": Y}),
    "index with a name": pd.DataFrame({"u": U, "y": Y}, pd.Index(TIME, name="time")),
    "index of durations": pd.DataFrame({"u": U, "y": Y}, pd.to_timedelta(TIME, "s")),
    "index of dates": pd.DataFrame(
        {"y": Y, "u": U}, pd.Timestamp("2026-03-01", tz="Asia/Tokyo") + pd.to_timedelta(TIME, "s")
    ),
    "integers that may be missing": pd.DataFrame({"time": TIME, "u": U, "y": Y}).convert_dtypes(),
}


@pytest.mark.parametrize("kind", FRAMES)
def test_a_data_frame_is_read_as_a_file(kind: str) -> None:
    frame = FRAMES[kind]
    before = frame.copy()
    record = read_record(frame, plant())
    np.testing.assert_allclose(record.time - record.time[0], TIME, atol=1e-6)
    np.testing.assert_array_equal(record.inputs[:, 0], U)
    np.testing.assert_array_equal(record.outputs[:, 0], Y)
    pd.testing.assert_frame_equal(frame, before)


def test_durations_are_seconds_and_have_no_other_unit() -> None:
    with pytest.raises(ValueError, match="'time' holds durations, which are read as seconds"):
        read_record(FRAMES["index of durations"], plant(), units={"time": "ms"})


def test_a_value_that_is_missing_in_a_data_frame_was_not_measured() -> None:
    frame = pd.DataFrame({"time": TIME, "u": U, "y": pd.array([1, pd.NA, 3], dtype=object)})
    np.testing.assert_array_equal(read_record(frame, plant()).outputs[:, 0], [1, np.nan, 3])


def test_a_data_frame_takes_the_options_of_files() -> None:
    frame = pd.DataFrame({"t": [0, 100, 200], "volts": U, "angle": Y})
    read = read_record(
        frame, plant(), {"time": "t", "u": "volts", "y": "angle"}, units={"time": "ms"}, rows="0:2"
    )
    np.testing.assert_allclose(read.time, [0, 0.1])


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (pd.DataFrame({"time": TIME, "u": U}), r"the DataFrame: no column 'y'"),
        (pd.DataFrame(np.ones((3, 2)), columns=["u", "u"]), "has the column 'u' twice"),
        (pd.DataFrame(np.ones((3, 1)), columns=[["a"], ["b"]]), "2 levels of column names"),
        (pd.DataFrame({"time": TIME, "u": U, "y": ["a", "b", "c"]}), "'y' is 'a', not a number"),
        (FRAMES["columns"].set_index(["time", "u"]), "2 levels of row names; one is allowed"),
        (FRAMES["columns"].assign(y=pd.to_timedelta(Y, "s")), "sample 1 of 'y' is .* not a number"),
    ],
)
def test_a_data_frame_that_cannot_be_used_is_one_sentence(
    frame: pd.DataFrame, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        read_record(frame, plant())


# Text


TEXTS: dict[str, str | bytes] = {
    "commas": "time,u,y\n0,1.5,-0.25\n0.1,-2,1\n0.2,0.25,3\n",
    "semicolons": "time;u;y\n0;1.5;-0.25\n0.1;-2;1\n0.2;0.25;3\n",
    "tabs": "time\tu\ty\n0\t1.5\t-0.25\n0.1\t-2\t1\n0.2\t0.25\t3\n",
    "blanks": "  time   u    y\n  0.0  1.5  -0.25\n 0.1 -2   1\n0.2\t0.25 3  \n",
    "commas and blanks": "time , u, y\n0.0 ,  1.5, -0.25\n0.1 ,-2 ,1\n 0.2, 0.25, 3\n",
    "whole numbers": "time, u, y\n0, 1.5, -0.25\n0.1, -2, 1\n0.2, 0.25, 3\n",
    "decimal commas": "time;u;y\n0,0;1,5;-0,25\n0,1;-2;1\n0,2;,25;3\n",
    "decimal commas far below": "time;u;y\n[s];[V];[m]\n0;1,5;-0,25\n0,1;-2;1\n0,2;0,25;3\n",
    "decimal commas and tabs": "time\tu\ty\n0,0\t1,5\t-0,25\n0,1\t-2\t1\n0,2\t0,25\t3\n",
    "decimal commas and blanks": "time u y\n0,0 1,5 -0,25\n0,1 -2 1\n0,2 2,5e-1 3\n",
    "decimal commas from the second row": "time;u;y\n0;1,5;-0,25\n0,1;-2;1\n0,2;0,25;3\n",
    "comments": "# a drive; 3, 4\n% 2026\ntime,u,y\n0,1.5,-0.25\n# pause\n0.1,-2,1\n0.2,0.25,3\n",
    "Excel's note": "sep=;\ntime;u;y\n0;1.5;-0.25\n0.1;-2;1\n0.2;0.25;3\n",
    "byte order mark": b"\xef\xbb\xbftime,u,y\n0,1.5,-0.25\n0.1,-2,1\n0.2,0.25,3\n",
    "mark and comment": b"\xef\xbb\xbf# log\ntime;u;y\n0;1.5;-0.25\n0.1;-2;1\n0.2;0.25;3\n",
    "quotes": '"time","u","y"\n0,1.5,-0.25\n0.1,-2,1\n0.2,0.25,3\n',
    "quotes around all": '"time";"u";"y"\n"0";"1,5";"-0,25"\n"0,1";"-2";"1"\n"0,2";"0,25";"3"\n',
    "quotes and blanks": '"time"  "u"  "y"\n0 1.5 -0.25\n0.1 -2 1\n0.2 0.25 3\n',
    "delimiter at the end": "time,u,y,\n0,1.5,-0.25,\n0.1,-2,1,\n0.2,0.25,3,\n",
    "delimiter at the end of rows": "time,u,y\n0,1.5,-0.25,\n0.1,-2,1,\n0.2,0.25,3,\n",
    "delimiter at the end of names": "time,u,y,\n0,1.5,-0.25\n0.1,-2,1\n0.2,0.25,3\n",
    "number of the row": ",time,u,y\n0,0,1.5,-0.25\n1,0.1,-2,1\n2,0.2,0.25,3\n",
    "empty lines": "\n\ntime,u,y\n\n0,1.5,-0.25\n0.1,-2,1\n\n0.2,0.25,3\n\n",
    "line ends of Windows": "time;u;y\r\n0;1.5;-0.25\r\n0.1;-2;1\r\n0.2;0.25;3\r\n",
    "no last line break": "time,u,y\n0,1.5,-0.25\n0.1,-2,1\n0.2,0.25,3",
    "twice the same": "time,u,y,u\n0,1.5,-0.25,1.5\n0.1,-2,1,-2\n0.2,0.25,3,0.25\n",
    "twice the same, with gaps": "time,a,u,y,a\n0,,1.5,-0.25,\n0.1,1,-2,1,1\n0.2,,0.25,3,\n",
    "text beside": "time;note;u;y\n0;on, 1;1.5;-0.25\n0.1;;-2;1\n0.2;off;0.25;3\n",
    "UTF-16": "time\tu\ty\r\n0\t1.5\t-0.25\r\n0.1\t-2\t1\r\n0.2\t0.25\t3\r\n".encode("utf-16"),
    "UTF-16 of another order": (
        "\ufefftime;größe;u;y\n0;;1,5;-0,25\n0,1;;-2;1\n0,2;;0,25;3\n".encode("utf-16-be")
    ),
    "old encoding": "time,u,y,größe [°]\n0,1.5,-0.25,1\n0.1,-2,1,1\n0.2,0.25,3,1\n".encode(
        "cp1252"
    ),
}  # fmt: skip


@pytest.mark.parametrize("ending", ["csv", "txt", "dat", "tsv"])
@pytest.mark.parametrize("kind", TEXTS)
def test_text_files_of_any_kind_hold_the_same_log(kind: str, ending: str, tmp_path: Path):
    rows = "1:" if "far below" in kind else None
    assert is_the_log(read(tmp_path / f"log.{ending}", TEXTS[kind], rows=rows))


@pytest.mark.parametrize(("text", "columns"), [
    ("t, n\n1, 2\n3, 4\n", {"t": [1, 3], "n": [2, 4]}),
    ("u\n1,5\n2,5\n", {"u": [1.5, 2.5]}),
    ("1,5 2,5\n3,5 4\n", {"1": [1.5, 3.5], "2": [2.5, 4]}),
    ("t;u\n0;1,000\n1;2,000\n", {"t": [0, 1], "u": [1, 2]}),
    ("Time\tSpeed of it\n0\t1\n1\t2\n", {"Time": [0, 1], "Speed of it": [1, 2]}),
    ("a,,\n0,1,2\n1,2,3\n", {"a": [0, 1], "column 2": [1, 2], "column 3": [2, 3]}),
    ("t u\n", {"t": [], "u": []}),
])  # fmt: skip
def test_the_delimiter_is_the_one_that_gives_most_numbers(text, columns, tmp_path: Path):
    (tmp_path / "log.csv").write_text(text)
    assert {n: list(v) for n, v in columns_in(tmp_path / "log.csv").items()} == columns


@pytest.mark.parametrize("text", [
    "0,1.5,-0.25\n0.1,-2,1\n0.2,0.25,3\n",
    "0;1,5;-0,25;\n0,1;-2;1;\n0,2;0,25;3;\n",
    "# no names\n  0.0e+00 1.5e0 -0.25\n 1.0e-01 -2 1\n 0.2 0.25 3\n",
])  # fmt: skip
def test_columns_without_names_are_mapped_by_their_numbers(text: str, tmp_path: Path):
    path = tmp_path / "log.txt"
    assert is_the_log(read(path, text, columns={"time": "1", "u": "2", "y": "3"}))
    with pytest.raises(ValueError, match=r"no names, .* called 1, 2, 3 \(.*--column time=NAME"):
        read(path, text)
    assert list(columns_in(path)) == ["1", "2", "3"]


@pytest.mark.parametrize("comment", [
    "# time,u,y", "#time;u;y", "% time\tu\ty", "# time u  y", "# made by x, y, z, w\n# time, u, y",
])  # fmt: skip
@pytest.mark.parametrize("rows", [
    "0,1.5,-0.25\n0.1,-2,1\n0.2,0.25,3\n", "0 1.5 -0.25\n0.1 -2 1\n0.2 0.25 3\n",
    "0;1,5;-0,25;\n0,1;-2;1;\n0,2;0,25;3;\n",
])  # fmt: skip
def test_names_may_stand_in_a_comment_above_the_numbers(comment, rows, tmp_path: Path):
    path = tmp_path / "log.txt"
    assert is_the_log(read(path, f"{comment}\n{rows}"))
    assert list(columns_in(path)) == ["time", "u", "y"]


def test_names_in_a_comment_may_hold_small_words(tmp_path: Path):
    (tmp_path / "log.csv").write_text("# time [s], rate of turn [deg/s], y\n0,1,2\n1,2,3\n")
    assert list(columns_in(tmp_path / "log.csv")) == ["time [s]", "rate of turn [deg/s]", "y"]


def test_names_that_numpy_writes_are_read(tmp_path: Path):
    values = np.column_stack([TIME, U, Y])
    for delimiter in (" ", ",", ";", "\t"):
        header = f"pendulum of 2026\n{delimiter.join(['time', 'u', 'y'])}"
        np.savetxt(tmp_path / "log.dat", values, header=header, delimiter=delimiter)
        assert is_the_log(read_record(tmp_path / "log.dat", plant()))


@pytest.mark.parametrize("comment", [
    "# time,u", "# 1,2,3", "# time,u,y\n\n", "# time,,y", "", "# pitch and time", "# made by hand",
    "# measured last week.", "# by hand, on Monday, outside",
])  # fmt: skip
def test_another_comment_is_not_the_names(comment: str, tmp_path: Path):
    (tmp_path / "log.csv").write_text(f"{comment}\n0,1,2\n1,2,3\n")
    assert list(columns_in(tmp_path / "log.csv")) == ["1", "2", "3"]


@pytest.mark.parametrize("cell", [
    "1,234.5", "1.234,5", "1,234,567", "1.234.567", "1 234,5", "1'234.5", "-12,345.0",
])  # fmt: skip
@pytest.mark.parametrize("decimal", [".", ","])
def test_thousands_separators_are_refused(cell: str, decimal: str, tmp_path: Path):
    text = f"time;u;y\n0;{cell};1.5\n0.1;999.5;1\n".replace("1.5", f"1{decimal}5")
    text = text.replace("0.1;999.5", f"0{decimal}1;999{decimal}5")
    with pytest.raises(ValueError, match=r"log\.csv: .*without thousands separators") as error:
        read(tmp_path / "log.csv", text)
    assert cell in str(error.value)


@pytest.mark.parametrize("text", [
    "time;u;y\n0.0;999;1\n0.1;1,234;1\n", "time;u;y\n0;1,5;1\n0,1;1.234;1\n",
])  # fmt: skip
def test_a_comma_that_may_separate_thousands_is_refused(text: str, tmp_path: Path):
    with pytest.raises(ValueError, match=r"has decimal commas, and '.*' with a point; save it"):
        read(tmp_path / "log.csv", text)


@pytest.mark.parametrize("note", ["1.5", "1.234;", "v 2.0"])
def test_a_column_of_notes_that_is_not_used_may_hold_anything(note: str, tmp_path: Path):
    rows = "0;1,5;-0,25;ok\n0,1;-2;1;1,5\n0,2;0,25;3;" + note
    assert is_the_log(read(tmp_path / "log.csv", f"time;u;y;note\n{rows.strip(';')}\n"))


def test_a_used_column_with_points_is_refused_beside_decimal_commas(tmp_path: Path):
    with pytest.raises(ValueError, match=r"has decimal commas, and '1\.5' with a point"):
        read(tmp_path / "log.csv", "time;u;y\n0;1,5;1.5\n0,1;2;2.5\n")


def test_numbers_of_other_programs_are_read_to_twelve_digits(tmp_path: Path):
    values = np.random.default_rng(0).normal(size=1000) * 10.0 ** np.arange(-50, 50).repeat(10)
    text = "u;y\n" + "".join(f"{float(v)!r};{float(v):.17e}\n" for v in values)
    (tmp_path / "log.csv").write_text(text)
    found = columns_in(tmp_path / "log.csv")
    np.testing.assert_allclose(found["u"], values, rtol=1e-12)
    np.testing.assert_allclose(found["y"], values, rtol=1e-12)


@pytest.mark.parametrize(("text", "fragments"), [
    ("time,u,y\n0,1.5,-0.25\n0.1,-2\n", ("line 3", "2 values", "3", "truncated?")),
    ("# c\ntime u y\n0 1.5 -0.25\n0.1 -2 1\n0.2 0.", ("line 5", "2 values", "truncated?")),
    ("time,u,y\n0,1.5,-0.25\n0.1,-2,", ("line 3", "line break", "truncated?")),
    ("time;u;y\n0;1.5;-0.25\n0.1;-2;1;7\n0.2;1;1\n", ("line 3", "4 values", "3")),
    ("time;y;u\n0;1.5;-0.25\n\n0.1;-2\n0.2;1;1\n", ("sample 2 of 'u' is missing",)),
    ("Time [s]  Input [V]\n0 1\n0.1 2\n", ("2 values", "has 4", "blanks in quotes")),
    ("time,u,y\n[s],[V],[m]\n0,1,1\n0.1,2,1\n", ("sample 1 of 'time' is '[s]'", "--rows 1:")),
    ("time,u,y\n0,1,1\n0.1,on,1\n", ("sample 2 of 'u' is 'on', not a number", "--rows START:STOP")),
    ("time,u,y\n0,1,1\n1,1,inf\n", ("sample 2 of 'y' is inf; 1 of 2 samples", "--rows START:STOP")),
    ("time,u,y\n0,1,1\n1,1,1\n2,1,-1e7\n", ("'y' reaches -1e+07", "a usual size is 1000",
        "--unit y=", "--scale y=FACTOR", "1 of 3 samples are that large, the first is 3")),
    ("time,u,y\n0,1,1\n1,1,1\n.5,1,1\n", ("'time' goes backwards: sample 2", "--rows", "--dt")),
    ("time,u,y\n0,1,1\n0.1,\"1,5\",1\n", ("sample 2 of 'u' is '1,5', not a number",)),
    ("time,u,y,u\n0,1,1,2\n0.1,1,1,3\n", ("'u' is there twice", "u (column 2) or u (column 4)")),
    ("Time,U,speed\n0,1,1\n0.1,1,1\n", ("no column 'time' (did you mean 'Time'?)", "--dt")),
    ("time,u,Y1\n0,1,1\n0.1,1,1\n", ("no column 'y'", "time, u, Y1", "--column y=NAME")),
    (b"time,u,y\n0,1,1\n0.1,\x81\x8d,1\n", ("cannot be read as CSV text", "UTF-8")),
    ("# nothing\n\n", ("is empty",)),
])  # fmt: skip
def test_a_text_file_that_cannot_be_used_is_one_sentence(text, fragments, tmp_path: Path):
    with pytest.raises(ValueError, match=r"log\.csv") as error:
        read(tmp_path / "log.csv", text)
    assert [f for f in fragments if f not in str(error.value)] == []
    assert "\n" not in str(error.value)


def test_one_of_two_columns_of_one_name_is_chosen(tmp_path: Path):
    text = "time,u,y,u\n0,9,-0.25,1.5\n0.1,9,1,-2\n0.2,9,3,0.25\n"
    assert is_the_log(read(tmp_path / "log.csv", text, columns={"u": "u (column 4)"}))


def test_a_message_names_some_of_very_many_columns(tmp_path: Path):
    names = ",".join(f"a{i}" for i in range(5000))
    with pytest.raises(ValueError, match="a29 and 4970 more") as error:
        read(tmp_path / "log.csv", f"{names}\n{names}\n")
    assert len(str(error.value)) < 600


# What is no file, or too much of one


def special(kind: str, path: Path) -> None:
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind in ("zeros", "very large"):
        with path.open("wb") as file:
            file.truncate(2**29 if kind == "zeros" else 2**31)
    elif kind == "one long line":
        path.write_bytes(b"1," * 2**20)
    else:
        path.write_bytes(b"time,u,y\n0,1,1\n" + b"1," * 2**20 + b"\n")


@pytest.mark.parametrize(("kind", "sentence"), [
    ("pipe", "is a pipe or a device; only files can be read"),
    ("device", "is a pipe or a device; only files can be read"),
    ("zeros", "line 1 is longer than 65536 characters"),
    ("one long line", "line 1 is longer than 65536 characters"),
    ("a long line below", "line 3 is longer than 65536 characters"),
    ("very large", "the file has 2048 MiB, more than 512"),
])  # fmt: skip
@pytest.mark.parametrize("ending", ["csv", "dat"])
def test_what_cannot_be_read_is_refused_at_once(kind, sentence, ending, tmp_path: Path):
    path = tmp_path / f"log.{ending}"
    special(kind, path)
    began = time.process_time()
    with pytest.raises(ValueError, match=sentence):
        read_record(path, plant())
    assert time.process_time() - began < 5


def test_a_file_of_very_many_lines_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("excite.record.text._MOST_LINES", 10**6)
    with pytest.raises(ValueError, match="more than 1 million lines; save it with fewer"):
        read(tmp_path / "log.csv", "time,u,y\n" + "#\n" * 10**6)


LONG = "7" * 5000
BAD_TEXTS: dict[str, tuple[str | bytes, dict[str, object], str]] = {
    "time backwards": ("time,u,y\n0.1,1,1\n0,1,1\n", {}, "'time' "),
    "one time twice": (
        "time,u,y\n0,1,1\n0.1,1,1\n0.1,1,1\n0.2,1,1\n",
        {},
        "sample 2 is at 0.1 s, sample 3 at 0.1 s",
    ),
    "no progress": ("time,u,y\n0,1,1\n0,1,1\n", {}, "'time' "),
    "digits in a cell": (f"time,u,y\n0,{LONG},1\n0.1,1,1\n", {}, "sample 1 of 'u' is inf"),
    "digits in a time": (f"time;u;y\n0;1;1\n{LONG};1;1\n", {}, "sample 2 of 'time' is inf"),
    "digits in a name": (f"time,{LONG},y\n0,1,1\n0.1,1,1\n", {}, "no column 'u'"),
    "text of many letters": ("time;u;y\n0;1;1\n1;" + "a" * 9000 + ";1\n", {}, "sample 2 of 'u'"),
    "digits in rows": ("time,u,y\n", {"rows": f"{LONG}:"}, "rows '77.* are not allowed"),
    "digits in a column": ("time,u,y\n0,1,1\n", {"columns": {"u": LONG}}, "no column '77"),
    "surrogate in a column": ("time,u,y\n0,1,1\n", {"columns": {"u": "\udcff"}}, "no column '"),
    "surrogate in a cell": (b"time,u,y\n0,\xed\xb3\xbf,1\n0.1,1,1\n", {}, "sample 1 of 'u' is"),
    "half of a UTF-16 pair": (
        "\ufefftime,\ud83d".encode("utf-16-le", "surrogatepass"),
        {},
        "UTF-8",
    ),
}


@pytest.mark.parametrize("kind", BAD_TEXTS)
def test_bad_text_is_one_short_sentence(kind: str, tmp_path: Path):
    text, options, sentence = BAD_TEXTS[kind]
    with pytest.raises(ValueError, match=sentence) as error:
        read(tmp_path / "log.csv", text, **options)
    told = str(error.value).replace(str(tmp_path), "")
    assert "\n" not in told
    assert len(told) < 400


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root reads all files")
@pytest.mark.parametrize("ending", ["csv", "mat", "h5", "parquet"])
def test_a_file_without_permission_is_refused(ending: str, tmp_path: Path):
    path = tmp_path / f"log.{ending}"
    path.write_text("time,u,y\n")
    path.chmod(0)
    with pytest.raises(ValueError, match="you are not allowed to read this file"):
        read_record(path, plant())


SIDECARS: dict[str, tuple[str, str]] = {
    "nested": ('{"kind":"excite record","a":' + "[" * 100_000 + "]" * 100_000 + "}", "too deeply"),
    "nested and cut off": ("[" * 100_000, "too deeply"),
    "digits": ('{"kind":"excite record","dt":' + LONG + "}", "a number is too long"),
    "digits in the plant": (
        '{"kind":"excite record","plant":{PLANT,"dt":' + "7" * 400 + "}}",
        "dt|int",
    ),
}


@pytest.mark.parametrize("kind", SIDECARS)
def test_a_bad_sidecar_is_one_short_sentence(kind: str, tmp_path: Path):
    content, sentence = SIDECARS[kind]
    own = json.dumps(plant().to_dict())[1:-1]
    (tmp_path / "log.json").write_text(content.replace("PLANT", own))
    (tmp_path / "log.csv").write_text("time,u,y\n0,1,1\n0.1,1,1\n")
    for description in (None, plant()):
        with pytest.raises(ValueError, match=rf"log\.json: .*({sentence})") as error:
            read_record(tmp_path / "log.csv", description)
        assert len(str(error.value).replace(str(tmp_path), "")) < 400


def test_a_very_large_sidecar_is_not_read(tmp_path: Path):
    (tmp_path / "log.csv").write_text("time,u,y\n0,1,1\n0.1,1,1\n")
    with (tmp_path / "log.json").open("wb") as file:
        file.truncate(2**31)
    with pytest.raises(ValueError, match=r"log\.json: has more than 16 MiB .*; rename it"):
        read_record(tmp_path / "log.csv", plant())


# Without pandas, h5py and pyarrow


def test_excites_own_csv_is_read_by_numpy_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    rng = np.random.default_rng(0)
    own = Record(0.1 * np.arange(50), rng.normal(size=(50, 1)), rng.normal(size=(50, 1)))
    write_record(tmp_path / "own.csv", own, plant())
    (tmp_path / "log.csv").write_text("time;u;y\n0;1;1\n0.1;2;2\n")
    monkeypatch.setitem(sys.modules, "pandas", None)
    np.testing.assert_array_equal(read_record(tmp_path / "own.csv", plant()).outputs, own.outputs)
    with pytest.raises(ValueError, match=r"not plain CSV .* needs pandas: pip install pandas"):
        read_record(tmp_path / "log.csv", plant())


@pytest.mark.parametrize(("name", "module", "sentence"), [
    ("log.h5", "h5py", "need h5py: pip install h5py"),
    ("log.mat", "h5py", "need h5py: pip install h5py"),
    ("log.parquet", "pyarrow.parquet", r"pip install 'excite\[logs\]'"),
])  # fmt: skip
def test_a_missing_library_is_named(name, module, sentence, tmp_path, monkeypatch):
    write_binary(tmp_path / name)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ValueError, match=sentence):
        read_record(tmp_path / name, plant())


# MAT 7.3, HDF5, Parquet


def write_binary(path: Path, columns: dict[str, object] | None = None) -> None:
    """Columns as MATLAB writes them with -v7.3, as HDF5 or as Parquet."""
    columns = {"time": TIME, "u": U, "y": Y} if columns is None else columns
    if path.suffix == ".parquet":
        pd.DataFrame(columns).set_index("time").to_parquet(path)
        return
    with h5py.File(path, "w", userblock_size=512 if path.suffix == ".mat" else 0) as file:
        for name, values in columns.items():
            row = np.asarray(values)[None] if path.suffix == ".mat" else np.asarray(values)
            file.create_dataset(name, data=row)
        file["#refs#/a"] = np.arange(5)
    if path.suffix == ".mat":
        head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + bytes(8) + b"\x00\x02IM"
        with path.open("r+b") as file:
            file.write(head)


@pytest.mark.parametrize("name", ["log.mat", "log.h5", "log.hdf5", "log.parquet"])
def test_binary_formats_hold_the_same_log(name: str, tmp_path: Path):
    write_binary(tmp_path / name)
    assert is_the_log(read_record(tmp_path / name, plant()))


@pytest.mark.parametrize("name", ["log.mat", "log.h5"])
def test_datasets_in_groups_are_named_by_their_paths(name: str, tmp_path: Path):
    write_binary(tmp_path / name, {"drive/time": TIME, "drive/u": U, "drive/y": Y, "none": []})
    columns = {name: f"drive/{name}" for name in ("time", "u", "y")}
    assert is_the_log(read_record(tmp_path / name, plant(), columns))
    assert list(columns_in(tmp_path / name)) == ["drive/time", "drive/u", "drive/y"]


@pytest.mark.parametrize(("name", "content", "sentence"), [
    ("log.h5", b"", "not a readable HDF5 file"),
    ("log.hdf5", b"time,u,y\n0,1,1\n", "not a readable HDF5 file"),
    ("log.parquet", b"PAR1, but not more", "not a readable Parquet file"),
    ("log.parquet", b"", "not a readable Parquet file"),
])  # fmt: skip
def test_a_damaged_binary_file_is_one_sentence(name, content, sentence, tmp_path: Path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=sentence) as error:
        read_record(tmp_path / name, plant())
    assert "\n" not in str(error.value)


def test_a_file_of_hdf5_without_columns_says_what_it_holds(tmp_path: Path):
    write_binary(tmp_path / "log.h5", {"a/matrix": np.eye(3), "note": np.bytes_("text")})
    with pytest.raises(ValueError, match=r"each column must be a dataset .* a/matrix \(float64\)"):
        read_record(tmp_path / "log.h5", plant())


@pytest.mark.parametrize("name", ["log.mat", "log.h5", "log.parquet"])
def test_a_binary_file_that_unpacks_to_very_much_is_not_loaded(name: str, tmp_path: Path):
    path = tmp_path / name
    if name == "log.parquet":
        columns = {f"c{i}": pyarrow.array(np.zeros(350_000, np.int8)) for i in range(100)}
        pyarrow.parquet.write_table(pyarrow.table(columns), path)
    else:
        write_binary(path, {})
        with h5py.File(path, "r+") as file:
            file.create_dataset("time", (1, 2**40), float, chunks=(1, 2**16), compression="gzip")
    with pytest.raises(ValueError, match="MiB unpacked, more than 256"):
        columns_in(path)


def test_a_dataset_in_another_file_is_not_read(tmp_path: Path):
    (tmp_path / "secret").write_bytes(np.arange(9.0).tobytes())
    write_binary(tmp_path / "log.h5")
    with h5py.File(tmp_path / "log.h5", "r+") as file:
        file.create_dataset("x", (9,), float, external=[(str(tmp_path / "secret"), 0, 72)])
    assert list(columns_in(tmp_path / "log.h5")) == ["time", "u", "y"]


# Time


DATES = {
    "ISO": ["2026-01-31 23:59:59.9", "2026-02-01 00:00:00", "2026-02-01 00:00:00.1"],
    "ISO with T and Z": ["2026-01-31T23:59:59.900Z", "2026-02-01T00:00:00Z",
                         "2026-02-01T00:00:00.1Z"],
    "time zones": ["2026-03-29T01:59:59.9+01:00", "2026-03-29T03:00:00+02:00",
                   "2026-03-29T03:00:00.1+02:00"],
    "day first": ["31.01.2026 23:59:59.9", "01.02.2026 00:00:00.0", "01.02.2026 00:00:00.1"],
    "day first, ambiguous": ["05.01.2026 23:59:59.9", "06.01.2026 00:00:00.0",
                             "06.01.2026 00:00:00.1"],
    "month first, ambiguous": ["01/05/2026 23:59:59.9", "01/06/2026 00:00:00.0",
                               "01/06/2026 00:00:00.1"],
    "decimal commas": ["31.01.2026 23:59:59,9", "01.02.2026 00:00:00,0", "01.02.2026 00:00:00,1"],
    "names of months": ["Jan 31 2026 23:59:59.9", "Feb 01 2026 00:00:00.0",
                        "Feb 01 2026 00:00:00.1"],
    "time of day": ["09:59:59.9", "10:00:00", "10:00:00.1"],
    "days": ["0 days 23:59:59.9", "1 days 00:00:00", "1 days 00:00:00.1"],
}  # fmt: skip


def dated(cells: list[str], delimiter: str = ";") -> str:
    rows = zip(cells, U, Y, strict=True)
    lines = ["time;u;y", *(f"{t};{u};{y}" for t, u, y in rows)]
    return "\n".join(lines).replace(";", delimiter) + "\n"


@pytest.mark.parametrize("delimiter", [";", "\t", ","])
@pytest.mark.parametrize("kind", DATES)
def test_dates_are_seconds_since_the_first_row(kind: str, delimiter: str, tmp_path: Path):
    text = dated(DATES[kind], delimiter)
    if kind == "decimal commas":
        if delimiter == ",":
            return
        text = re.sub(r";(-?\d+)\.(\d+)", r";\1,\2", text)
    assert is_the_log(read(tmp_path / "log.csv", text))


def test_dates_of_parquet_have_time_zones(tmp_path: Path):
    stamps = pd.to_datetime(DATES["time zones"], utc=True, format="ISO8601").tz_convert(
        "Europe/Berlin"
    )
    for index in (stamps, stamps.tz_localize(None) + pd.to_timedelta([0, -1, -1], "h")):
        write_binary(tmp_path / "log.parquet", {"time": index, "u": U, "y": Y})
        assert is_the_log(read_record(tmp_path / "log.parquet", plant()))


def test_a_cell_that_is_no_date_is_named(tmp_path: Path):
    cells = [*DATES["ISO"][:2], "soon"]
    with pytest.raises(ValueError, match="sample 3 of 'time' is 'soon', neither a number nor a"):
        read(tmp_path / "log.csv", dated(cells))
    with pytest.raises(ValueError, match="sample 2 of 'time' is missing"):
        read(tmp_path / "log.csv", dated([cells[0], "", cells[1]]))
    with pytest.raises(ValueError, match=r"'time' holds dates, .* leave its unit and scale out"):
        read(tmp_path / "log.csv", dated(DATES["ISO"]), units={"time": "ms"})


@pytest.mark.parametrize(("unit", "factor"), [
    ("us", 1e-6), ("µs", 1e-6), ("ms", 1e-3), ("s", 1.0), ("min", 60.0), ("h", 3600.0),
])  # fmt: skip
def test_time_may_have_another_unit(unit: str, factor: float, tmp_path: Path):
    cells = [repr(t / factor) for t in TIME]
    assert is_the_log(read(tmp_path / "log.csv", dated(cells), units={"time": unit}))


@pytest.mark.parametrize("name", ["Ts", "dt", "step"])
def test_a_sampling_time_in_the_first_row_is_enough(name: str, tmp_path: Path):
    text = f'"{name}","u","y",\n0.1,1.5,-0.25,\n,-2,1,\n,0.25,3,\n'
    columns = {"time": name}
    assert is_the_log(read(tmp_path / "log.csv", text, columns=columns))
    ms = text.replace("\n0.1,", "\n100,")
    assert is_the_log(read(tmp_path / "log.csv", ms, columns=columns, units={"time": "ms"}))
    rows = read(tmp_path / "log.csv", text, columns=columns, rows="1:")
    np.testing.assert_allclose(rows.time, [0.1, 0.2])
    if name != "step":
        assert is_the_log(read(tmp_path / "log.csv", text))


@pytest.mark.parametrize("shape", [(), (1,), (1, 1)])
@pytest.mark.parametrize("ending", ["h5", "mat"])
def test_a_single_number_is_the_sampling_time(shape: tuple, ending: str, tmp_path: Path):
    path = tmp_path / f"log.{ending}"
    for name, columns, units in (("Ts", None, None), ("step", {"time": "step"}, {"time": "ms"})):
        number = np.full(shape, 0.1 if units is None else 100.0)
        write_binary(path, {"u": U, "y": Y, "gain": 3.0})
        with h5py.File(path, "r+") as file:
            file[name] = number
        assert is_the_log(read_record(path, plant(), columns, units=units))
    with pytest.raises(ValueError, match="'y' has 1 samples, 'u' 3"):
        read_record(path, plant(), {"y": "gain"}, dt=0.1)
    scipy.io.savemat(tmp_path / "old.mat", {"dt": 0.1, "u": U, "y": Y})
    assert is_the_log(read_record(tmp_path / "old.mat", plant()))


def test_texts_and_empty_arrays_of_matlab_are_no_columns(tmp_path: Path):
    write_binary(tmp_path / "log.mat", {"u": U, "name": np.array([[97], [98]], np.uint16)})
    with h5py.File(tmp_path / "log.mat", "r+") as file:
        file["name"].attrs["MATLAB_class"] = np.bytes_("char")
        file["none"] = np.zeros(2, np.uint64)
        file["none"].attrs["MATLAB_empty"] = 1
    assert list(columns_in(tmp_path / "log.mat")) == ["u"]


def test_a_file_without_time_needs_its_sampling_time(tmp_path: Path):
    text = "u,y\n1.5,-0.25\n-2,1\n0.25,3\n"
    assert is_the_log(read(tmp_path / "log.csv", text, dt=0.1))
    assert is_the_log(read(tmp_path / "log.csv", "time," + text.replace("\n", "\n7,")[:-2], dt=0.1))
    every_second = read(tmp_path / "log.csv", text, dt=0.1, rows=slice(None, None, 2))
    np.testing.assert_allclose(every_second.time, [0, 0.2])
    with pytest.raises(ValueError, match=r"no column 'time'; .* --dt"):
        read(tmp_path / "log.csv", text)
    with pytest.raises(ValueError, match=r"--dt is the sampling time in seconds of a file without"):
        read(tmp_path / "log.csv", text, dt=0.1, units={"time": "ms"})
    for dt in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match=r"sampling time .* is not allowed: finite and pos"):
            read(tmp_path / "log.csv", text, dt=dt)


# Rows


ROWS = "time,u,y\n" + "".join(f"{0.1 * k!r},{k},{-k}\n" for k in range(20))


@pytest.mark.parametrize("rows", [
    ":", "3:", ":7", "2:11", "2:11:3", "::4", "-5:", ":-5", " 1 : 9 ", slice(4, 12, 2),
])  # fmt: skip
def test_rows_are_those_of_a_slice(rows: str | slice, tmp_path: Path):
    record = read(tmp_path / "log.csv", ROWS, rows=rows)
    parts = (
        [int(p) if p.strip() else None for p in rows.split(":")] if isinstance(rows, str) else []
    )
    chosen = slice(*parts) if isinstance(rows, str) else rows
    np.testing.assert_array_equal(record.inputs[:, 0], np.arange(20)[chosen])
    np.testing.assert_allclose(record.time, 0.1 * np.arange(20)[chosen])


@pytest.mark.parametrize("rows", ["5", "", "a:b", "1:2:3:4", "::-1", "::0", slice(9, 0, -1)])
def test_rows_that_are_no_slice_are_refused(rows: object, tmp_path: Path):
    with pytest.raises(ValueError, match=r"rows .* are not allowed: START:STOP .* 100:1000:5"):
        read(tmp_path / "log.csv", ROWS, rows=rows)


def test_rows_outside_are_not_looked_at_and_a_message_counts_within_them(tmp_path: Path):
    text = ROWS.replace("time,u,y\n", "time,u,y\n[s],[V],[m]\n").replace("0.0,0,0", "0.0,,")
    assert len(read(tmp_path / "log.csv", text, rows="2:").time) == 19
    with pytest.raises(ValueError, match=r"log\.csv \(rows 1: of 21\): sample 1 of 'u' is missing"):
        read(tmp_path / "log.csv", text, rows="1:")
    with pytest.raises(ValueError, match=r"\(rows 50:60 of 21\): 0 samples; at least two"):
        read(tmp_path / "log.csv", text, rows="50:60")


def test_a_record_of_later_rows_does_not_start_at_the_initial_state(tmp_path: Path):
    own = Record(0.1 * np.arange(9), np.ones((9, 1)), np.ones((9, 1)),
                 {"starts_at_initial_state": True})  # fmt: skip
    write_record(tmp_path / "own.csv", own, plant())
    for rows, is_start in ((None, True), (":5", True), ("0:8:2", True), ("1:", False)):
        record = read_record(tmp_path / "own.csv", plant(), rows=rows)
        assert record.starts_at_initial_state is is_start


# Constant inputs


def test_a_constant_input_need_not_be_in_the_file(tmp_path: Path):
    path, two = tmp_path / "log.csv", plant("u load")
    path.write_text(dated([repr(t) for t in TIME]))
    record = read_record(path, two, set_inputs={"load": 2.5})
    np.testing.assert_array_equal(record.inputs, np.column_stack([U, [2.5] * 3]))
    for set_inputs, sentence in (
        ({"lod": 1.0}, r"no input 'lod' \(did you mean 'load'\?\); it has u, load"),
        ({"y": 1.0}, "no input 'y'"),
        ({"load": math.nan}, "value nan of input 'load' is not allowed"),
        ({"load": 1.0, "u": 2.0}, "the file has a column 'u'; --set-input is for inputs that it"),
    ):
        with pytest.raises(ValueError, match=sentence):
            read_record(path, two, set_inputs=set_inputs)
    with pytest.raises(ValueError, match="input 'load' is a column or a set value"):
        read_record(path, two, {"load": "y"}, set_inputs={"load": 1.0})
    with pytest.raises(ValueError, match="nothing is left to read"):
        read_record(path, plant("load"), set_inputs={"load": 1.0}, dt=0.1, inputs_only=True)
    with pytest.raises(ValueError, match=r"no column 'load'.*--set-input load=VALUE"):
        read_record(path, two)


# Units


@pytest.mark.parametrize(("word", "unit", "factor"), [
    ("deg", "rad", math.pi / 180), ("rpm", "rad/s", 2 * math.pi / 60),
    ("deg/s", "rad/s", math.pi / 180), ("km/h", "m/s", 1 / 3.6), ("mm", "m", 1e-3),
    ("cm", "m", 1e-2), ("mV", "V", 1e-3), ("kV", "V", 1e3), ("mA", "A", 1e-3), ("kN", "N", 1e3),
    ("kPa", "Pa", 1e3),
    ("bar", "Pa", 1e5), ("%", "", 0.01), ("degC", "degC", 1.0), ("Pa", "bar", 1e-5),
    ("furlong", "furlong", 1.0),
])  # fmt: skip
def test_words_for_units_have_their_factor(word: str, unit: str, factor: float, tmp_path: Path):
    assert unit_factor("y", word, unit) == pytest.approx(factor, rel=1e-14)
    path = tmp_path / "log.csv"
    path.write_text("time,u,y\n0,1,2\n0.1,3,4\n")
    record = read_record(path, plant(unit=unit, size=1e9), units={"y": word})
    np.testing.assert_allclose(record.outputs[:, 0], np.multiply(factor, [2, 4]))
    both = read_record(path, plant(unit=unit, size=1e9), None, {"y": 3.0}, units={"y": word})
    np.testing.assert_allclose(both.outputs, 3 * record.outputs)


@pytest.mark.parametrize(("word", "unit", "allowed"), [
    ("mm", "rad", "'rad', and known are rad, mrad, deg"), ("Deg", "rad", "'Deg' of 'y'"),
    ("", "m", "known are m, um"), ("deg", "furlong", "known are furlong"), ("degF", "degC", "°C"),
])  # fmt: skip
def test_a_unit_of_another_quantity_is_refused(word, unit, allowed, tmp_path: Path):
    (tmp_path / "log.csv").write_text("time,u,y\n0,1,2\n0.1,3,4\n")
    with pytest.raises(ValueError, match=rf"unit .*{allowed}.*--scale y=FACTOR"):
        read_record(tmp_path / "log.csv", plant(unit=unit), units={"y": word})


def test_a_unit_given_as_that_of_the_plant_confirms_it(tmp_path: Path):
    path, small = tmp_path / "log.csv", plant(unit="m", size=0.01)
    path.write_text("time,u,y\n0,0,1\n0.1,0,2\n")
    with pytest.raises(ValueError, match=r"'y' reaches 2 m.*or the unit, --unit y=UNIT"):
        read_record(path, small)
    assert read_record(path, small, units={"y": "m"}).outputs.max() == 2
    assert read_record(path, small, units={"y": "mm"}).outputs.max() == 0.002
    with pytest.raises(ValueError, match="'y' reaches 20 m"):
        read_record(path, small, None, {"y": 10.0}, units={"y": "m"})
    with pytest.raises(ValueError, match=r"no column 'z'; it has time, u, y"):
        read_record(path, small, units={"z": "mm"})


# Real recordings


def real(name: str) -> Path:
    path = recording(name)
    if path is None:
        pytest.skip(f"{name} is not here; EXCITE_DATA names the folder that has it")
    return path


def cells_of(path: Path, delimiter: str = ",") -> tuple[list[str], list[list[str]]]:
    """Names and rows, read independently."""
    with path.open(newline="") as file:
        header, *rows = [[c.strip() for c in row] for row in csv.reader(file, delimiter=delimiter)]
    return header, [row for row in rows if row]


Columns = Sequence[np.ndarray]


def compare(
    record: Record, time: Sequence[float] | np.ndarray, inputs: Columns, outputs: Columns
) -> None:
    np.testing.assert_allclose(record.time, time, rtol=1e-12)
    np.testing.assert_allclose(record.inputs, np.column_stack(inputs), rtol=1e-12)
    np.testing.assert_allclose(record.outputs, np.column_stack(outputs), rtol=1e-12)


def test_the_tanks_have_their_sampling_time_in_the_first_row():
    path = real("dataBenchmark.csv")
    _, rows = cells_of(path)
    numbers = np.array([[float(cell) for cell in row[:4]] for row in rows])
    for columns in ({"u": "uEst", "y": "yEst"}, {"time": "Ts", "u": "uEst", "y": "yEst"}):
        record = read_record(path, plant(dt=4.0), columns)
        assert len(record.time) == 1024
        compare(record, 4.0 * np.arange(1024), [numbers[:, 0]], [numbers[:, 2]])
    assert list(columns_in(path)) == ["uEst", "uVal", "yEst", "yVal", "Ts"]


def test_the_vehicle_is_read_in_part():
    path = real("data_2d_vehicle.dat")
    header, rows = cells_of(path)
    used = np.array(rows[100:1000:5], float)
    named = {name: used[:, i] for i, name in enumerate(header)}
    d = plant("delta D", "x y psi v", dt=0.1)
    record = read_record(path, d, dt=0.02, rows="100:1000:5")
    assert (len(rows), len(record.time)) == (1757, 180)
    parts = [[named[n] for n in names.split()] for names in ("delta D", "x y psi v")]
    compare(record, 2.0 + 0.1 * np.arange(180), *parts)
    np.testing.assert_array_equal(np.asarray(columns_in(path)["t"])[100:1000:5], named["t"])
    assert list(columns_in(path)) == header


def test_the_pendulum_has_no_names_and_a_constant_input():
    path = real("data_pendulum.txt")
    numbers = np.genfromtxt(path)
    columns = {"time": "1", "phi": "2", "rate": "3"}
    d, psi = plant("psi", "phi rate", dt=0.01), math.pi / 2
    record = read_record(path, d, columns, set_inputs={"psi": psi}, rows=slice(500))
    assert len(record.time) == 500
    used = numbers[:500]
    compare(record, used[:, 0], [np.full(500, psi)], [used[:, 1], used[:, 2]])
    with pytest.raises(ValueError, match=r"no names, its columns are called 1, 2, 3 "):
        read_record(path, d)


def test_the_circuit_has_a_column_twice():
    path = real("RLC_data_id.csv")
    numbers = np.genfromtxt(path, delimiter=",", skip_header=1)
    record = read_record(path, plant("V_IN", "V_C I_L", dt=5e-7))
    assert len(record.time) == 10_000
    compare(record, numbers[:, 0], [numbers[:, 3]], [numbers[:, 1], numbers[:, 2]])
    assert list(columns_in(path)) == ["time", "V_C", "I_L", "V_IN"]


def test_the_silverbox_has_no_time():
    path = real("SNLS80mV_first.csv")
    numbers = np.genfromtxt(path, delimiter=",", skip_header=1, usecols=(0, 1))
    dt = 1 / 610.35
    record = read_record(path, plant("V1", "V2", dt=dt), dt=dt)
    assert len(record.time) == 65_000
    compare(record, dt * np.arange(65_000), [numbers[:, 0]], [numbers[:, 1]])


def test_the_exchanger_counts_seconds():
    path = real("exchanger.csv")
    numbers = np.genfromtxt(path, delimiter=",", skip_header=1)
    record = read_record(path, plant("q", "th", dt=1.0), {"time": "ts"})
    assert len(record.time) == 4000
    compare(record, numbers[:, 0], [numbers[:, 1]], [numbers[:, 2]])


def test_the_building_has_dates():
    path = real("blg_1.csv")
    _, rows = cells_of(path, ";")
    stamps = [datetime.fromisoformat(row[1]) for row in rows]
    seconds = [(stamp - stamps[0]).total_seconds() for stamp in stamps]
    columns = [np.array([float(row[i]) for row in rows]) for i in (2, 3, 5, 4)]
    record = read_record(path, plant("Ps Ta Thm", "yTi", dt=900.0), {"time": "t"})
    assert len(record.time) == 4181
    compare(record, seconds, columns[:3], columns[3:])
    assert list(columns_in(path)) == ["column 1", "t", "Ps", "Ta", "yTi", "Thm"]


def test_the_signalling_proteins_are_measured_at_sixteen_times():
    path = real("measurementData_Boehm_JProteomeRes2014.tsv")
    header, rows = cells_of(path, "\t")
    table, at = columns_in(path), header.index
    observables = sorted({row[at("observableId")] for row in rows})
    assert sorted(table) == sorted(["time", *observables])
    assert len(table["time"]) == 16
    for row in rows:
        k = np.flatnonzero(table["time"] == float(row[at("time")]))[0]
        assert table[row[at("observableId")]][k] == float(row[at("measurement")])
