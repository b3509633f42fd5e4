import dataclasses
import errno
import json
import math
import os
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from catalogue import TwoMasses

from excite.description import PlantDescription
from excite.files import (
    csv_text,
    json_ready,
    json_text,
    new_run_folder,
    require_free_run_folder,
    write_bytes,
    write_json,
)
from excite.plant import EMPS, Aero2
from excite.record import (
    Record,
    columns_in,
    is_even,
    read_record,
    require_even,
    require_record_path,
    unbroken,
    write_record,
)

AERO2, EMPS_D, TWO_MASSES = Aero2.definition, EMPS.definition, TwoMasses.definition


def drawn(d: PlantDescription, samples: int = 30, seed: int = 0) -> Record:
    """A record of numbers that fill all digits and lie within the plant's limits."""
    rng = np.random.default_rng(seed)
    low, high = np.array([[i.lower, i.upper] for i in d.inputs]).T
    scales = np.array([o.scale for o in d.outputs])
    return Record(
        time=np.arange(samples) * d.dt,
        inputs=rng.uniform(low, high, (samples, len(low))),
        outputs=scales * rng.normal(size=(samples, len(scales))),
        metadata={"starts_at_initial_state": True, "params": {"any": 1.5}},
    )


def table(d: PlantDescription = AERO2, samples: int = 30) -> dict[str, list[str]]:
    """The columns of a good CSV file as text, for tests to spoil."""
    r = drawn(d, samples)
    values = np.column_stack([r.time, r.inputs, r.outputs]).T
    return {
        n: [repr(float(v)) for v in column] for n, column in zip(d.columns, values, strict=True)
    }


def text_of(columns: dict[str, list[str]]) -> str:
    rows = zip(*columns.values(), strict=True)
    return "\n".join([",".join(columns), *(",".join(row) for row in rows)]) + "\n"


def spoiled(**cells: dict[int, str]) -> str:
    """A good CSV file with some cells replaced: voltage={3: "nan"}."""
    columns = table()
    for name, changes in cells.items():
        for row, text in changes.items():
            columns[name][row] = text
    return text_of(columns)


# What is written is read back


@pytest.mark.parametrize("ending", ["csv", "mat", "CSV"])
@pytest.mark.parametrize("d", [AERO2, EMPS_D, TWO_MASSES], ids=lambda d: d.name)
def test_a_record_is_read_back_to_the_last_digit(d, ending, tmp_path):
    written = drawn(d)
    write_record(tmp_path / f"record.{ending}", written, d)
    read = read_record(tmp_path / f"record.{ending}", d)
    np.testing.assert_array_equal(read.time, written.time)
    np.testing.assert_array_equal(read.inputs, written.inputs)
    np.testing.assert_array_equal(read.outputs, written.outputs)
    assert read.starts_at_initial_state
    assert read.source == str(tmp_path / f"record.{ending}")


def test_a_csv_file_has_the_columns_that_the_plant_names(tmp_path):
    write_record(tmp_path / "r.csv", drawn(AERO2), AERO2)
    assert (tmp_path / "r.csv").read_text().splitlines()[0] == "time,voltage,pitch"
    write_record(tmp_path / "e.csv", drawn(EMPS_D), EMPS_D)
    assert (tmp_path / "e.csv").read_text().splitlines()[0] == "time,force,position"


@pytest.mark.parametrize(
    "values", [[0.1 + 0.2, 1e-300, 5e-324, -1 / 3], [1e300, -0.0, math.pi, 1.0]]
)
def test_every_number_of_csv_text_is_read_back_exactly(values):
    lines = csv_text({"a": values, "b": np.array(values)[::-1]}).splitlines()
    read = np.array([[float(cell) for cell in line.split(",")] for line in lines[1:]])
    np.testing.assert_array_equal(read, np.column_stack([values, values[::-1]]))


@pytest.mark.parametrize(("delimiter", "start"), [(";", ""), ("\t", ""), (",", "\ufeff")])
def test_other_delimiters_and_a_byte_order_mark_are_understood(delimiter, start, tmp_path):
    path = tmp_path / "r.csv"
    path.write_text(start + text_of(table()).replace(",", delimiter), encoding="utf-8")
    np.testing.assert_allclose(read_record(path, AERO2).outputs, drawn(AERO2).outputs, rtol=1e-12)


def test_decimal_commas_between_semicolons_are_understood(tmp_path):
    text = (tmp_path / "a.csv").write_text
    text("time;voltage;pitch\n0,0;1,5;-0,25\n0,1;2e-1;1,0\n")
    record = read_record(tmp_path / "a.csv", AERO2)
    np.testing.assert_array_equal(record.time, [0, 0.1])
    np.testing.assert_array_equal(record.inputs[:, 0], [1.5, 0.2])
    np.testing.assert_array_equal(record.outputs[:, 0], [-0.25, 1])


def test_a_column_without_a_name_has_its_number(tmp_path):
    (tmp_path / "a.csv").write_text(",voltage,pitch\n0,1,2\n0.1,1,2\n")
    record = read_record(tmp_path / "a.csv", AERO2, {"time": "column 1"}, {"pitch": 1})
    np.testing.assert_array_equal(record.time, [0, 0.1])


@pytest.mark.parametrize("quote", ["", '"'])
def test_names_may_hold_commas_between_semicolons(quote, tmp_path):
    names = [f"{quote}{name}{quote}" for name in ("Zeit, s", "Spannung, V", "Winkel, rad")]
    (tmp_path / "a.csv").write_text(f"{';'.join(names)}\n0,0;1,5;-0,25\n0,1;2;1\n")
    columns = {"time": "Zeit, s", "voltage": "Spannung, V", "pitch": "Winkel, rad"}
    record = read_record(tmp_path / "a.csv", AERO2, columns)
    np.testing.assert_array_equal(record.outputs[:, 0], [-0.25, 1])


@pytest.mark.parametrize("first", ["0.1,0.2,-3e-4", "0.1,nan,0.1", "", "\n0.1,1,2"])
def test_columns_without_names_are_numbered(first, tmp_path):
    (tmp_path / "a.csv").write_text(f"{first}\n0.2,1,2\n0.3,1,2\n")
    with pytest.raises(ValueError, match=r"no names, its columns are called 1, 2, 3 .*time=NAME"):
        read_record(tmp_path / "a.csv", AERO2)
    columns = {"time": "1", "voltage": "2", "pitch": "3"}
    record = read_record(tmp_path / "a.csv", AERO2, columns, rows="-2:")
    assert record.time.tolist() == [0.2, 0.3]


def test_one_column_is_not_taken_for_two_things(tmp_path):
    (tmp_path / "a.csv").write_text("t,u,y\n0,1,2\n0.1,1,2\n")
    with pytest.raises(ValueError, match="'time' and 'pitch' cannot be the same column"):
        read_record(tmp_path / "a.csv", AERO2, {"time": "t", "voltage": "u", "pitch": "t"})


def test_columns_may_stand_in_any_order_beside_others(tmp_path):
    columns = {"note": ["nan"] * 30, **dict(reversed(table().items()))}
    (tmp_path / "r.csv").write_text(text_of(columns))
    read = read_record(tmp_path / "r.csv", AERO2)
    np.testing.assert_array_equal(read.inputs, drawn(AERO2).inputs)


@pytest.mark.parametrize("ending", ["csv", "mat"])
def test_mapped_columns_and_scales_give_the_same_record(ending, tmp_path):
    own = drawn(AERO2)
    foreign = {
        "t_ms": 1000 * own.time, "u": own.inputs[:, 0], "deg": np.degrees(own.outputs[:, 0]),
    }  # fmt: skip
    path = tmp_path / f"r.{ending}"
    if ending == "csv":
        path.write_text(csv_text(foreign))
    else:
        scipy.io.savemat(path, foreign)
    read = read_record(
        path,
        AERO2,
        {"time": "t_ms", "voltage": "u", "pitch": "deg"},
        {"time": 1e-3, "pitch": math.pi / 180},
    )
    np.testing.assert_allclose(read.time, own.time, rtol=1e-14)
    np.testing.assert_array_equal(read.inputs, own.inputs)
    np.testing.assert_allclose(read.outputs, own.outputs, rtol=1e-14)


def test_a_designed_input_needs_no_outputs(tmp_path):
    columns = table()
    del columns["pitch"]
    (tmp_path / "u.csv").write_text(text_of(columns))
    read = read_record(tmp_path / "u.csv", AERO2, inputs_only=True)
    np.testing.assert_array_equal(read.inputs, drawn(AERO2).inputs)
    assert read.outputs.shape == (30, 0)


def test_an_episode_gives_one_more_row_that_holds_its_last_input():
    inputs, outputs = np.array([[1.0], [2.0]]), np.array([[0.0], [0.1], [0.2]])
    record = Record.of_episode(np.array([0.0, 0.1, 0.2]), inputs, outputs)
    np.testing.assert_array_equal(record.inputs, [[1.0], [2.0], [2.0]])
    assert not record.starts_at_initial_state


def test_the_sampling_time_is_the_mean_step():
    time = np.array([1.0, 1.1, 1.2, 1.3])
    assert Record(time, np.zeros((4, 1)), np.zeros((4, 1))).dt == pytest.approx(0.1, rel=1e-12)


# The sidecar


def test_the_sidecar_tells_plant_params_dt_and_provenance(tmp_path):
    record = dataclasses.replace(
        drawn(TWO_MASSES), metadata={"params": {"m_1": 1.25}, "provenance": {"seed": 7}}
    )
    write_record(tmp_path / "r.csv", record, TWO_MASSES)
    sidecar = json.loads((tmp_path / "r.json").read_text())
    assert PlantDescription.from_dict(sidecar["plant"]) == TWO_MASSES
    assert sidecar["plant_hash"] == TWO_MASSES.hash
    assert sidecar["dt"] == pytest.approx(TWO_MASSES.dt, rel=1e-12)
    assert sidecar["params"] == {"m_1": 1.25}
    assert sidecar["provenance"] == {"seed": 7}
    assert read_record(tmp_path / "r.csv", TWO_MASSES).metadata == sidecar


def test_without_a_sidecar_nothing_is_known(tmp_path):
    (tmp_path / "r.csv").write_text(text_of(table()))
    read = read_record(tmp_path / "r.csv", AERO2)
    assert read.metadata == {}
    assert not read.starts_at_initial_state


@pytest.mark.parametrize(
    "content", ['{"starts_at_initial_state": true}', '{"kind": "another"}', "[1, 2]", "3"]
)
def test_a_foreign_json_file_beside_a_record_is_ignored(content, tmp_path):
    (tmp_path / "r.csv").write_text(text_of(table()))
    (tmp_path / "r.json").write_text(content)
    assert read_record(tmp_path / "r.csv", AERO2).metadata == {}


@pytest.mark.parametrize("content", [b'{"kind": "excite rec', b"\xff\xfe\x00", b""])
def test_a_malformed_sidecar_is_a_sentence(content, tmp_path):
    (tmp_path / "r.csv").write_text(text_of(table()))
    (tmp_path / "r.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"r\.json: cannot be read as JSON") as error:
        read_record(tmp_path / "r.csv", AERO2)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "entries", [{"plant": "aero2"}, {"plant": {"states": [1, 2]}}, {"plant": {"states": "rest"}}]
)
def test_a_sidecar_whose_plant_is_no_description_is_a_sentence(entries, tmp_path):
    (tmp_path / "r.csv").write_text(text_of(table()))
    sidecar = {"kind": "excite record", "starts_at_initial_state": True, **entries}
    (tmp_path / "r.json").write_text(json.dumps(sidecar))
    with pytest.raises(ValueError, match=r"r\.json"):
        read_record(tmp_path / "r.csv", AERO2)


# Bad input


def bad_mat(path: Path) -> None:
    own = drawn(AERO2, 300)
    scipy.io.savemat(
        path, {"time": own.time, "voltage": own.inputs[:, 0], "pitch": own.outputs[:, 0]}
    )
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def own_record_cut_off(path: Path) -> None:
    """What excite writes ends with a line break."""
    write_record(path, drawn(AERO2), AERO2)
    path.write_bytes(path.read_bytes()[:-5])


def hdf5_mat(path: Path) -> None:
    """The beginning of a MAT file of version 7.3."""
    text = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116)
    path.write_bytes(
        text + bytes(8) + b"\x00\x02IM" + bytes(384) + b"\x89HDF\r\n\x1a\n" + bytes(64)
    )


def gap(rows: slice) -> str:
    columns = table()
    for values in columns.values():
        del values[rows]
    return text_of(columns)


def mat_of(**variables: object) -> Callable[[Path], None]:
    own = drawn(AERO2)
    good = {"time": own.time, "voltage": own.inputs[:, 0], "pitch": own.outputs[:, 0]}
    return lambda path: scipy.io.savemat(path, {**good, **variables})


def truncated_line() -> str:
    return text_of(table()).rstrip("\n").rpartition(",")[0] + "\n"


def renamed(old: str, new: str) -> str:
    return text_of({new if n == old else n: values for n, values in table().items()})


BAD_FILES: dict[str, tuple[str, str | bytes | Callable[[Path], None], tuple[str, ...]]] = {
    "unknown column": (
        "r.csv", renamed("pitch", "theta"),
        ("no column 'pitch'", "time, voltage, theta", "--column pitch=NAME"),
    ),
    "column named twice": (
        "r.csv", text_of(table()).replace("pitch", "voltage"),
        ("twice", "voltage (column 2) or voltage (column 3)", "--column voltage=NAME"),
    ),
    "missing input": ("r.csv", spoiled(voltage={4: ""}), ("sample 5", "'voltage'", "is missing")),
    "blank input": ("r.csv", spoiled(voltage={4: "  "}), ("sample 5", "'voltage'", "is missing")),
    "NaN": (
        "r.csv", spoiled(voltage={2: "nan", 9: "NaN"}),
        ("sample 3", "'voltage'", "2 of 30", "finite"),
    ),
    "nothing measured": (
        "r.csv", spoiled(pitch=dict.fromkeys(range(30), "")),
        ("'pitch' has no measurement in 30 samples",),
    ),
    "infinity": ("r.csv", spoiled(voltage={0: "-inf"}), ("sample 1", "'voltage'", "finite")),
    "NaN in time": ("r.csv", spoiled(time={7: "nan"}), ("sample 8", "'time'", "finite")),
    "text": ("r.csv", spoiled(voltage={6: "on"}), ("sample 7", "'voltage'", "'on'", "a number")),
    "repeated time": (
        "r.csv", spoiled(time={5: "0.4"}),
        ("'time' is there twice", "sample 5 is at 0.4 s, sample 6 at 0.4 s"),
    ),
    "time in reverse": (
        "r.csv",
        text_of({n: list(reversed(v)) for n, v in table().items()}),
        ("'time' goes backwards", "29 of 29 steps"),
    ),
    "input in millivolts": (
        "r.csv", spoiled(voltage={3: "7200.0"}),
        ("'voltage'", "7200 V", "-24 to 24 V", "a scale, --scale voltage=FACTOR"),
    ),
    "output in degrees": (
        "r.csv", spoiled(pitch={3: "-25.0"}),
        ("'pitch'", "-25 rad", "0.785", "a scale, --scale pitch=FACTOR"),
    ),
    "truncated line": ("r.csv", truncated_line(), ("line 31", "2 values", "3", "truncated")),
    "empty file": ("r.csv", "", ("empty",)),
    "header only": ("r.csv", "time,voltage,pitch\n", ("0 samples", "at least two")),
    "one sample": ("r.csv", "time,voltage,pitch\n0,0,0\n", ("1 samples", "at least two")),
    "binary": ("r.csv", bytes(range(256)) * 40, ("cannot be read as CSV",)),
    "binary that is text": ("r.csv", b"\x00\x01\x02\n\x03\n", ("cannot be read as CSV",)),
    "number cut in half": ("r.csv", own_record_cut_off, ("line 31", "line break", "truncated")),
    "cell cut off": ("r.csv", text_of(table()).rpartition(",")[0] + ",", ("line 31", "truncated")),
    "one endless field": ("r.csv", b"a" * 200_000, ("cannot be read as CSV",)),
    "UTF-16 without its mark": (
        "r.csv", text_of(table()).encode("utf-16-le"), ("cannot be read as CSV", "zero bytes"),
    ),
    "truncated MAT": ("r.mat", bad_mat, ("not a readable MAT file",)),
    "empty MAT": ("r.mat", b"", ("not a readable MAT file",)),
    "text as MAT": ("r.mat", text_of(table()), ("not a readable MAT file",)),
    "HDF5 MAT": ("r.mat", hdf5_mat, ("7.3", "-v7", "CSV")),
    "MAT without column": (
        "r.mat", mat_of(pitch="text"), ("no column 'pitch'", "time, voltage", "--column"),
    ),
    "MAT of unequal columns": (
        "r.mat", mat_of(pitch=np.zeros(7)), ("'pitch' has 7 samples", "'time' 30"),
    ),
    "MAT with NaN": ("r.mat", mat_of(pitch=np.full(30, np.nan)), ("no measurement",)),
    "wrong ending": ("r.toml", text_of(table()), (".csv, .txt", "or .db3")),
    "no ending": ("record", text_of(table()), (".csv, .txt", "or .db3")),
}  # fmt: skip


@pytest.mark.parametrize(("name", "content", "fragments"), BAD_FILES.values(), ids=list(BAD_FILES))
def test_a_file_that_cannot_be_used_is_one_sentence(name, content, fragments, tmp_path):
    path = tmp_path / name
    if callable(content):
        content(path)
    else:
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(ValueError, match=r".") as error:
        read_record(path, AERO2)
    sentence = str(error.value)
    assert str(path) in sentence
    assert "\n" not in sentence
    assert [f for f in fragments if f not in sentence] == []


def test_a_mat_file_that_unpacks_to_very_much_is_not_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    path = tmp_path / "r.mat"
    columns = {"time": np.zeros(34_000_000, np.uint8)}
    scipy.io.savemat(path, columns, do_compression=True)
    assert path.stat().st_size < 50_000
    monkeypatch.delattr(scipy.io, "loadmat")
    with pytest.raises(ValueError, match="259 MiB unpacked, more than 256"):
        columns_in(path)


def test_of_a_mat_file_vectors_of_numbers_are_columns_and_nothing_else(tmp_path: Path):
    vectors = {
        "time": np.arange(3.0),
        "is_on": np.array([True, False, True]),
        "q": np.array([1, 2], np.int16),
        "one": 1.0,
    }
    others = {"log": {"x": np.arange(9)}, "note": "text", "none": [], "matrix": np.eye(3)}
    scipy.io.savemat(tmp_path / "r.mat", {**vectors, **others})
    found = columns_in(tmp_path / "r.mat")
    assert found.keys() == vectors.keys()
    for name, values in vectors.items():
        np.testing.assert_array_equal(np.asarray(found[name], float), np.ravel(values))


@pytest.mark.parametrize(("name", "sentence"), [
    ("nowhere.csv", "no such file"), ("nowhere.mat", "no such file"),
    ("folder.csv", "is a folder; only files can be read"),
])  # fmt: skip
def test_no_such_file_is_said(name, sentence, tmp_path):
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(ValueError, match=sentence):
        read_record(tmp_path / name, AERO2)


class _Payload:
    """Unpickling this would leave a file behind."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple:
        return Path.touch, (self.trace,)


def test_a_pickle_renamed_to_mat_is_refused_and_not_run(tmp_path):
    path, trace = tmp_path / "r.mat", tmp_path / "trace"
    path.write_bytes(pickle.dumps(_Payload(trace)))
    with pytest.raises(ValueError, match=r"r\.mat: not a readable MAT file"):
        read_record(path, AERO2)
    assert not trace.exists()
    pickle.loads(path.read_bytes())  # it would have been noticed
    assert trace.exists()


@pytest.mark.parametrize("mapping", [({"theta": "pitch"}, {}), ({}, {"theta": 2.0})])
def test_a_mapping_of_a_column_that_the_plant_has_not_is_refused(mapping, tmp_path):
    (tmp_path / "r.csv").write_text(text_of(table()))
    with pytest.raises(ValueError, match=r"'aero2' has no column 'theta'; it has time, voltage"):
        read_record(tmp_path / "r.csv", AERO2, *mapping)


def test_a_scale_of_one_says_that_the_unit_is_right(tmp_path):
    path = tmp_path / "r.csv"
    path.write_text(spoiled(voltage={3: "72.0"}))
    with pytest.raises(ValueError, match="1 confirms that the unit is right"):
        read_record(path, AERO2)
    assert read_record(path, AERO2, scales={"voltage": 1.0}).inputs.max() == 72


@pytest.mark.parametrize("offset", [0.0, 3600.0, -5.0])
def test_time_may_begin_anywhere(offset, tmp_path):
    columns = table()
    columns["time"] = [repr(offset + 0.1 * k) for k in range(30)]
    (tmp_path / "r.csv").write_text(text_of(columns))
    assert read_record(tmp_path / "r.csv", AERO2).dt == pytest.approx(0.1, rel=1e-9)


@pytest.mark.parametrize(("jitter", "even"), [(0.004, True), (0.006, False)])
def test_sampling_is_even_within_five_percent(jitter, even, tmp_path):
    (tmp_path / "r.csv").write_text(spoiled(time={14: repr(1.4 + jitter)}))
    record = read_record(tmp_path / "r.csv", AERO2)
    assert is_even(record.time) == even
    assert unbroken(record.time) == [slice(0, 30)]
    if not even:
        with pytest.raises(ValueError, match=r"r\.csv is sampled unevenly or has gaps in time"):
            require_even(record, "this needs")


def test_a_missing_sample_of_an_even_record_is_a_gap_and_a_slow_sensor_has_none(tmp_path):
    (tmp_path / "r.csv").write_text(gap(slice(10, 12)))
    record = read_record(tmp_path / "r.csv", AERO2)
    assert unbroken(record.time) == [slice(0, 10), slice(10, 28)]
    waits = np.array([0.0, 2.5, 5, 10, 15, 20, 30, 40, 50, 60, 80, 100, 120, 160, 200, 240])
    assert unbroken(waits) == [slice(0, 16)]
    assert unbroken(np.concatenate([waits, waits + 1000.0])) == [slice(0, 16), slice(16, 32)]


@pytest.mark.parametrize("missing", ["", "  ", "nan"])
def test_an_output_that_was_not_measured_is_nan(missing, tmp_path):
    (tmp_path / "r.csv").write_text(spoiled(pitch={4: missing, 9: missing}))
    outputs = read_record(tmp_path / "r.csv", AERO2).outputs
    assert np.flatnonzero(np.isnan(outputs)).tolist() == [4, 9]


# Writing is atomic


def refuse(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def interrupt(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def test_a_failing_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "f.json"
    write_json(path, {"old": 1})
    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(ValueError, match=r"f\.json: cannot be written \(No space"):
        write_json(path, {"new": 2})
    assert json.loads(path.read_text()) == {"old": 1}
    assert os.listdir(tmp_path) == ["f.json"]


def test_an_interrupted_write_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_bytes(tmp_path / "f", b"content")
    assert os.listdir(tmp_path) == []


def test_a_value_that_is_no_json_leaves_the_old_file(tmp_path):
    write_json(tmp_path / "f.json", {"old": 1})
    with pytest.raises(TypeError):
        write_json(tmp_path / "f.json", {"new": object()})
    assert json.loads((tmp_path / "f.json").read_text()) == {"old": 1}
    assert os.listdir(tmp_path) == ["f.json"]


@pytest.mark.parametrize("name", ["r.txt", "r", "nowhere/r.csv"])
def test_a_record_that_cannot_be_written_leaves_nothing(name, tmp_path):
    with pytest.raises(ValueError, match=name):
        write_record(tmp_path / name, drawn(AERO2), AERO2)
    assert os.listdir(tmp_path) == []


def test_a_record_that_fails_half_way_leaves_no_sidecar_alone(tmp_path):
    (tmp_path / "r.csv").mkdir()  # nothing can be renamed to it
    with pytest.raises(ValueError, match=r"r\.csv"):
        write_record(tmp_path / "r.csv", drawn(AERO2), AERO2)
    assert os.listdir(tmp_path) == ["r.csv"]


def test_a_record_replaces_another_only_when_told_to(tmp_path):
    path = tmp_path / "r.csv"
    require_record_path(path, overwrite=False)
    write_record(path, drawn(AERO2), AERO2)
    with pytest.raises(ValueError, match=r"r\.csv exists; .* --overwrite"):
        require_record_path(path, overwrite=False)
    require_record_path(path, overwrite=True)


def test_a_record_written_again_keeps_what_its_sidecar_said(tmp_path):
    made_with = {**AERO2.to_dict(), "name": "another"}
    metadata = {"plant": made_with, "plant_hash": "0" * 64, "provenance": {"seed": 7}}
    record = dataclasses.replace(drawn(AERO2), metadata=metadata)
    write_record(tmp_path / "a.csv", record, AERO2)
    write_record(tmp_path / "b.csv", read_record(tmp_path / "a.csv", AERO2), AERO2)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    assert json.loads((tmp_path / "b.json").read_text())["plant"]["name"] == "another"


def test_a_record_does_not_replace_a_foreign_json_file(tmp_path):
    (tmp_path / "r.json").write_text('{"mine": 1}')
    with pytest.raises(ValueError, match=r"r\.json"):
        write_record(tmp_path / "r.csv", drawn(AERO2), AERO2)
    assert json.loads((tmp_path / "r.json").read_text()) == {"mine": 1}


def test_written_files_are_readable_by_others(tmp_path):
    write_record(tmp_path / "r.csv", drawn(AERO2), AERO2)
    assert {oct(f.stat().st_mode & 0o777) for f in tmp_path.iterdir()} == {"0o644"}


# Run folders


def test_a_run_folder_appears_only_when_it_is_complete(tmp_path):
    path = tmp_path / "runs" / "first"
    with new_run_folder(path) as folder:
        (folder / "a").write_text("1")
        assert not path.exists()
    assert [f.name for f in path.iterdir()] == ["a"]
    assert os.listdir(path.parent) == ["first"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_run_that_fails_leaves_nothing(error, tmp_path):

    def fill() -> None:
        with new_run_folder(tmp_path / "run") as folder:
            (folder / "a").write_text("1")
            raise error

    with pytest.raises(error):
        fill()
    assert os.listdir(tmp_path) == []


def finished_run(path: Path) -> None:
    with new_run_folder(path) as folder:
        write_json(folder / "run.json", {"kind": "test"})


def test_a_run_is_replaced_only_when_told_to(tmp_path):
    path = tmp_path / "run"
    finished_run(path)
    with pytest.raises(ValueError, match="--overwrite"), new_run_folder(path):
        pass
    assert os.listdir(path) == ["run.json"]
    with new_run_folder(path, overwrite=True) as folder:
        (folder / "b").write_text("2")
    assert os.listdir(path) == ["b"]
    assert os.listdir(tmp_path) == ["run"]


def test_a_run_is_never_replaced_by_one_of_another_kind(tmp_path):
    path = tmp_path / "run"
    with new_run_folder(path) as folder:
        write_json(folder / "run.json", {"kind": "excite campaign"})
    told = r"holds another kind of run \(campaign\); choose another name"
    with pytest.raises(ValueError, match=told):
        require_free_run_folder(path, True, "excite study")
    with pytest.raises(ValueError, match=told), new_run_folder(path, True, "excite study"):
        pass
    require_free_run_folder(path, True, "excite campaign")


def test_files_of_others_in_a_run_folder_that_is_replaced_are_kept(tmp_path):
    path = tmp_path / "run"
    finished_run(path)
    own = r"record(_\d+)?\.(csv|json)|run\.json"
    for name in ("record_2.csv", "record.json", "notes.txt", "records.csv", "run.sh"):
        (path / name).write_text("old")
    (path / "record").mkdir()
    (path / "record" / "mine.csv").write_text("old")
    (tmp_path / "link").symlink_to(path)
    with new_run_folder(tmp_path / "link", True, own=own) as folder:
        (folder / "record.json").write_text("new")
    assert {p.name: p.read_text() for p in path.rglob("*") if p.is_file()} == {
        "record.json": "new", "notes.txt": "old", "records.csv": "old", "run.sh": "old",
        "mine.csv": "old",
    }  # fmt: skip
    assert {p.name for p in tmp_path.iterdir()} == {"run", "link"}


def test_where_a_run_cannot_be_replaced_nothing_is_lost(tmp_path, monkeypatch):
    path = tmp_path / "run"
    finished_run(path)
    (path / "notes.txt").write_text("old")
    rename = Path.rename

    def fails(self: Path, target: Path) -> Path:
        if target == path and self.parent == tmp_path:
            raise OSError(13, "Permission denied")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fails)
    refused = pytest.raises(ValueError, match=r"cannot be replaced \(Permission denied\)$")
    with refused, new_run_folder(path, True, own="run.json") as folder:
        (folder / "run.json").write_text("{}")
    assert {p.name for p in path.iterdir()} == {"run.json", "notes.txt"}


def test_a_run_that_fails_leaves_the_one_that_it_was_to_replace(tmp_path):
    finished_run(tmp_path / "run")
    with pytest.raises(RuntimeError), new_run_folder(tmp_path / "run", overwrite=True):
        raise RuntimeError
    assert os.listdir(tmp_path) == ["run"]
    assert os.listdir(tmp_path / "run") == ["run.json"]


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("kind", ["folder", "file"])
def test_what_is_no_run_folder_is_never_replaced(kind, overwrite, tmp_path):
    path = tmp_path / "mine"
    if kind == "folder":
        path.mkdir()
        (path / "thesis.tex").write_text("years of work")
    else:
        path.write_text("years of work")
    with pytest.raises(ValueError, match="is no run folder; choose another name"):
        require_free_run_folder(path, overwrite)
    with pytest.raises(ValueError, match="is no run folder"), new_run_folder(path, overwrite):
        pass
    kept = path / "thesis.tex" if kind == "folder" else path
    assert kept.read_text() == "years of work"


def test_an_empty_folder_may_become_a_run(tmp_path):
    (tmp_path / "run").mkdir()
    finished_run(tmp_path / "run")
    assert os.listdir(tmp_path / "run") == ["run.json"]


def test_a_run_folder_below_a_file_is_refused_before_anything_is_computed(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="file"):
        require_free_run_folder(tmp_path / "file" / "run", overwrite=False)


# JSON


def test_json_has_no_number_that_is_not_finite():
    value = {"a": np.array([1.0, np.nan]), 2: (math.inf, np.float64(0.5)), "c": [np.int64(3), None]}
    assert json_ready(value) == {"a": [1.0, None], "2": [None, 0.5], "c": [3, None]}
    assert json.loads(json_text(value)) == json_ready(value)


def test_time_in_another_unit_is_refused_unless_said_to_be_right(tmp_path):
    path = tmp_path / "r.csv"
    path.write_text(text_of(table()))
    with pytest.raises(ValueError, match="Give a scale, --scale time=FACTOR"):
        read_record(path, AERO2, scales={"time": 1000.0})
    slow = dataclasses.replace(AERO2, dt=1e-3, band=(1.0, 100.0))
    assert read_record(path, slow, scales={"time": 1.0}).dt == pytest.approx(0.1)


def test_a_factor_of_zero_is_refused(tmp_path):
    path = tmp_path / "r.csv"
    path.write_text(text_of(table()))
    with pytest.raises(ValueError, match="scale 0 of 'pitch' is not allowed"):
        read_record(path, AERO2, scales={"pitch": 0.0})
