import csv
import dataclasses
import io
import math
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

import matplotlib.figure
import matplotlib.path
import numpy as np
import pytest
from catalogue import TwoMasses

from excite.description import HALF_95, PlantDescription
from excite.plant import EMPS, Aero2, CartPole
from excite.record import Record
from excite.record.figure import (
    PLOT_ENDINGS,
    episode_figure,
    episodes_figure,
    kept_samples,
    require_plot_path,
    save,
)
from excite.report.estimates import largest_correlation
from excite.report.figures import (
    autocorrelation_figure,
    benchmark_figure,
    correlation_figure,
    identification_figure,
    information_figure,
)
from excite.report.numbers import digits_for, number
from excite.report.rows import CountsBySeed, Difference, EstimateSummary, Row, StudyFacts
from excite.report.study_figures import agents_figure, curves_figure
from excite.report.study_table import StudyTable, footnotes
from excite.report.tables import fitting_tables, html_table, text_table

AERO2 = Aero2.definition


# Numbers


@pytest.mark.parametrize("digits", [2, 3, 5, 8])
@pytest.mark.parametrize(
    "value",
    [1.0, 9.9996, 0.012345678, 0.001, 0.00099999, 1.2e-9, 999.96, 12345.678, 1e5, 7.7e22, 1 / 3],
)
def test_a_number_is_shown_to_so_many_significant_digits(value, digits):
    for sign in (1, -1):
        assert float(number(sign * value, digits)) == pytest.approx(
            sign * value, rel=0.51 * 10.0 ** (1 - digits)
        )
    assert len(number(value, digits).partition("e")[0].replace(".", "").lstrip("0")) <= max(
        digits + 1, 5
    )


@pytest.mark.parametrize("value", [None, math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_a_dash(value):
    assert number(value) == "–"


def test_numbers_look_as_people_write_them():
    assert [number(v) for v in (0.0, 1.0, 0.0123456, 25.06, 3026.4)] == [
        "0", "1.00", "0.0123", "25.1", "3026",
    ]  # fmt: skip
    assert [number(v) for v in (0.000456, 1.5e7)] == ["4.56e-04", "1.50e+07"]


@pytest.mark.parametrize("value", [0.0232, -3.275, 218.04, 95108.9, 1e-7, 5e8])
@pytest.mark.parametrize("relative", [0.3, 0.011, 1e-3, 2e-6])
def test_an_estimate_shows_two_digits_of_its_error(value, relative):
    error = relative * abs(value)
    shown = float(number(value, digits_for(value, error)))
    assert abs(shown - value) <= error / 19
    assert digits_for(value, error) <= 3 - math.log10(relative) + 1


@pytest.mark.parametrize("error", [None, math.nan, math.inf, 0.0, 2.0])
def test_an_estimate_without_a_useful_error_shows_five_digits(error):
    assert number(1.23456789, digits_for(1.23456789, error)) == "1.2346"


# Tables


def row(method: str, estimator: str, size: float, failed: int = 0) -> Row:
    numbers = {"mean": size, "sd": size / 3, "median": 0.9 * size, "rms": 1.1 * size}
    error = dict.fromkeys(numbers) if failed == 50 else numbers
    names = ("J_p", "K_pu", "D_p")
    return Row.model_validate(
        {
            "method": method,
            "estimator": estimator,
            "evaluations": 50,
            "failed": failed,
            "failures": {},
            "violations": 1,
            "violation_rate": {"estimate": 0.02, "ci95": (0.0035, 0.105)},
            "max_abs_output": {"output": "pitch", "mean": 20.1, "sd": 7.7, "unit": "deg"},
            "log_det_information": 40.0,
            "log_det_information_sd": 1.0,
            "relative_error_percent": dict.fromkeys(names, error),
            "cramer_rao_percent": {n: size / (10 + i) for i, n in enumerate(names)},
            "rms_over_cramer_rao": dict.fromkeys(names, 1.0),
            "coverage95_percent": dict.fromkeys(names, 95.0),
            "beyond_6_std_errors": 0,
        }
    )


ROWS = (
    row("random", "arx-rls", 8.125), row("random", "nls", 1 / 3),
    row("chirp", "arx-rls", 0.75, failed=2), row("chirp", "nls", 0.05, failed=50),
)  # fmt: skip
REFERENCE = {
    "relative_error_percent": {"J_p": (8.23, 6.61), "K_pu": (10.18, 5.14), "D_p": (3026.0, 2067.0)},
    "max_abs_output": (11.2, 4.6),
    "violations": "0/100",
}
BARE = {
    "name": "bare", "plant": "aero2", "episodes": 50, "num_steps": 500, "seed": 0, "spread": 0.3,
    "estimators": {"arx-rls": {"kind": "arx-rls"}, "nls": {"kind": "nls"}},
}  # fmt: skip
STUDY = {
    **BARE,
    "title": "A title",
    "reference": {"random": REFERENCE},
    "source": "Table 9 of somebody",
    "inferred": ["the first thing", "the second thing"],
}


def table_of(rows: Sequence[Row] = ROWS, **changes: Any) -> StudyTable:
    return StudyTable(rows=tuple(rows), study=StudyFacts.model_validate({**STUDY, **changes}))


def all_cells(reference: dict[str, Any]) -> list[list[str]]:
    return table_of(reference=reference).cells()[1]


def markdown_table(text: str) -> list[list[str]]:
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_every_line_of_a_markdown_table_has_the_columns_of_its_header():
    table = markdown_table(table_of().markdown())
    assert table[0] == [
        "method", "estimator", "J_p error %", "bound %", "K_pu error %", "bound %",
        "D_p error %", "bound %", "max pitch deg", "violations (95 %)", "failed",
        "log det",
    ]  # fmt: skip
    assert {len(line) for line in table} == {len(table[0])}
    assert set(table[1]) == {"---"}


def test_a_markdown_row_shows_what_its_row_says():
    table = markdown_table(table_of().markdown())
    assert table[2] == [
        "random", "arx-rls", "8.12 ± 2.71", "0.81", "8.12 ± 2.71", "0.74", "8.12 ± 2.71", "0.68",
        "20.1 ± 7.70", "1/50 (0.4–10.5 %)", "0/50", "40.00",
    ]  # fmt: skip
    assert [line[-2] for line in table[2:]] == ["0/50", "0/50", "–", "2/50", "50/50"]


def test_a_mean_over_nothing_is_a_dash():
    assert all_cells({})[3][2] == "– ± –"


def test_a_published_row_stands_below_those_of_its_method():
    cells = all_cells(STUDY["reference"])
    assert [line[:2] for line in cells] == [
        ["random", "arx-rls"], ["random", "nls"], ["random", "as published"],
        ["chirp", "arx-rls"], ["chirp", "nls"],
    ]  # fmt: skip
    assert cells[2][2:] == [
        "8.23 ± 6.61", "–", "10.2 ± 5.14", "–", "3026 ± 2067", "–", "11.2 ± 4.60", "0/100",
        "–", "–",
    ]  # fmt: skip
    assert len(all_cells({})) == len(ROWS)


def test_a_published_number_stands_in_the_column_of_its_parameter():
    """Whatever the order in the study file, and where a parameter was not published."""
    errors = REFERENCE["relative_error_percent"]
    turned = {**REFERENCE, "relative_error_percent": dict(reversed(errors.items()))}
    assert all_cells({"random": turned}) == all_cells({"random": REFERENCE})
    part = {**REFERENCE, "relative_error_percent": {"D_p": errors["D_p"]}}
    cells = all_cells({"random": part})[2]
    assert len(cells) == len(table_of().cells()[0])
    assert cells[2:7] == ["–", "–", "–", "–", "3026 ± 2067"]


def test_a_table_is_broken_between_columns_where_it_is_too_wide():
    header, cells = table_of().cells()
    assert fitting_tables(header, cells, 1000) == [(header, cells)]
    for width in (10, 60, 80, 120):
        tables = fitting_tables(header, cells, width)
        assert len(tables) > 1
        assert [name for names, _ in tables for name in names[2:]] == header[2:]
        for names, part in tables:
            assert names[:2] == header[:2]
            assert names[2] != "bound %"
            lines = zip(names, *part, strict=True)
            assert sum(2 + max(map(len, line)) for line in lines) - 2 <= max(width, 60)
        for i, row in enumerate(cells):
            assert [cell for _, part in tables for cell in part[i][2:]] == row[2:]


def test_a_table_as_text_fits_and_breaks_no_name_and_no_interval():
    text = text_table("all", *table_of().cells(), labels=2)
    assert max(map(len, text.splitlines())) <= 80
    long = "a mean of 0.0249998 ± 2.8e-7 is as good as 0.024999 to 0.025001, " * 3
    text = text_table("", ["name", "words"], [["J_p", long.strip()]], width=44)
    assert max(map(len, text.splitlines())) <= 44
    assert text.count("0.0249998 ± 2.8e-7") == 3 == text.count("0.024999 to 0.025001")
    assert " ".join(text.split("─\n")[1].split()) == "J_p " + long.strip()
    assert text_table("", ["", ""], [["a", "1"], ["bb", "22"]]) == "a    1\nbb  22"


def test_a_table_in_a_notebook_shows_signs_of_markup_as_they_are():
    assert "<td>a &lt; b</td>" in html_table("t", ["x"], [["a < b"]])
    assert html_table("t & u", ["x"], []).startswith("<table>\n<caption>t &amp; u</caption>")


def test_footnotes_tell_what_was_inferred_and_where_rows_were_published():
    table = table_of()
    notes = footnotes(table.study, table.rows)
    assert "Published rows: Table 9 of somebody." in notes
    assert notes[-1].startswith("Inferred")
    assert "the first thing; the second thing" in notes[-1]
    text = table.markdown()
    assert text.startswith("# A title\n")
    assert all(f"\n{note}\n" in text for note in notes)
    bare = StudyTable(rows=ROWS, study=StudyFacts.model_validate(BARE))
    assert len(footnotes(bare.study, bare.rows)) == 2
    assert bare.markdown().startswith("# bare\n")


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, "parameters within ± 30 %, all else as in the plant's description)"),
        ({"rig": {"filter": False}}, "all else as on its simulated rig)"),
        ({"uncertainty": {"delay_voltage": [0, 0.1], "initial_state": "2%"}},
         "± 30 %, in addition delay_voltage 0 to 0.1, initial_state ± 2 %)"),
        ({"agents": {"a": {"method": "ppo"}}, "seeds": 3}, "its 3 seeds share the 50 plants"),
        ({"agents": {"a": {"method": "ppo"}}, "seeds": 3, "safety_episodes": 2000},
         "each seed on 2,000 plants of its own"),
    ],
)  # fmt: skip
def test_a_count_of_violations_comes_with_its_conditions(settings, words):
    notes = footnotes(StudyFacts.model_validate({**STUDY, "note": "First.", **settings}), ())
    assert notes[0] == "First."
    (note,) = (note for note in notes if note.startswith("Violations"))
    assert words in note


@pytest.mark.parametrize(
    ("counts", "cell"),
    [
        ((0, 0, 0), "0/2000 in 3 of 3 seeds"),
        ((7, 0, 2), "0–2–7 of 2000 (3 seeds)"),
        ((1, 0, 2, 4), "0–1.5–4 of 2000 (4 seeds)"),
    ],
)
def test_violations_of_several_seeds_are_shown_by_seed(counts, cell):
    by_seed = CountsBySeed(evaluations=2000, violations=counts, own_plants=True)
    header, (cells, *_) = table_of([ROWS[0].model_copy(update={"by_seed": by_seed})]).cells()
    assert cells[header.index("violations (95 %)")] == cell


def test_csv_reads_back_to_the_numbers_of_the_rows():
    read = list(csv.DictReader(io.StringIO(table_of().csv())))
    assert len(read) == len(ROWS)
    for line, r in zip(read, ROWS, strict=True):
        assert (line["method"], line["estimator"]) == (r.method, r.estimator)
        for key in ("evaluations", "failed", "violations"):
            assert float(line[key]) == getattr(r, key)
        assert float(line["max_abs_pitch_deg_mean"]) == r.max_abs_output.mean
        assert float(line["max_abs_pitch_deg_sd"]) == r.max_abs_output.sd
        for name, error in r.relative_error_percent.items():
            for part in ("mean", "sd", "median", "rms"):
                value = float(line[f"{name}_error_percent_{part}"])
                np.testing.assert_equal(value, getattr(error, part))
            assert float(line[f"{name}_cramer_rao_percent"]) == r.cramer_rao_percent[name]


def test_csv_keeps_names_that_hold_a_comma_together():
    comma = [ROWS[0].model_copy(update={"method": "slow, then fast"})]
    (line,) = csv.DictReader(io.StringIO(table_of(comma).csv()))
    assert line["method"] == "slow, then fast"
    assert float(line["evaluations"]) == 50


def test_differences_of_the_first_estimator_stand_with_their_intervals():
    def gap(mean: float | None, low: float | None, high: float | None) -> dict[str, Any]:
        return {"J_p": {"mean": mean, "ci95": (low, high), "seeds": 2}}

    pairs = [
        ("RL(all)", "chirp", "paper's", gap(-0.5, -0.75, -0.25)),
        ("RL(K_pu)", "chirp", "paper's", gap(None, None, None)),
        ("RL(all)", "chirp", "another", gap(9.0, 8.0, 10.0)),
    ]
    keys = ("method", "minus", "estimator", "relative_error_percent")
    differences = [Difference.model_validate(dict(zip(keys, p, strict=True))) for p in pairs]
    section = table_of().model_copy(update={"differences": tuple(differences)}).markdown()
    assert "| RL(all) | chirp | -0.500 (-0.750 to -0.250) |" in section
    assert "| RL(K_pu) | chirp | – (– to –) |" in section
    assert "paper's" in section
    assert "9.00" not in section
    assert "Differences" not in table_of().markdown()


# Figures


def record_of(d: PlantDescription, samples: int = 60) -> Record:
    time = d.dt * np.arange(samples)
    wave = np.sin(0.3 * np.arange(samples))[:, None]
    return Record(
        time,
        wave * [i.amplitude for i in d.inputs],
        wave * [0.9 * (o.critical_level or o.scale) for o in d.outputs],
    )


def summary(
    params: dict[str, tuple[float, float, str]],
    fit: dict[str, float] | None = None,
    correlation: Sequence[Sequence[float]] = (),
) -> EstimateSummary:
    """A result with these estimates, standard errors and units."""
    data = {
        name: {
            "estimate": value, "std_error": error, "unit": unit, "held": math.isnan(error),
            "ci95": (value - HALF_95 * error, value + HALF_95 * error),
            "relative_to_nominal": None,
        }
        for name, (value, error, unit) in params.items()
    }  # fmt: skip
    none = {"plant_hash": "", "initial_state": "known", "validation": [], "files": [],
            "whiteness_p_value": {}, "structure_p_value": {}, "verdict": []}  # fmt: skip
    about = {"plant": "aero2", "estimator": "nls", "status": "successful", "params": data}
    return EstimateSummary.of(
        {**none, **about, "fit_percent": fit or {}, "correlation": correlation}
    )


def result_of(
    d: PlantDescription, fit: float = 97.1234, **changed: tuple[float, float]
) -> EstimateSummary:
    """As `identify` says it, the last parameter held."""
    params = {p.name: (p.nominal, 0.01 * abs(p.nominal)) for p in d.parameters}
    params[d.parameters[-1].name] = (d.parameters[-1].nominal, math.nan)
    params |= changed
    named = {p.name: (*params[p.name], p.unit) for p in d.parameters}
    return summary(named, {o.name: fit for o in d.outputs})


def figures_of(d: PlantDescription) -> dict[str, matplotlib.figure.Figure]:
    record = record_of(d)
    percent = {p.name: 10.0**i for i, p in enumerate(d.parameters)}
    return {
        "identification": identification_figure(
            d, result_of(d), record, record.outputs + 0.01 * np.ones_like(record.outputs)
        ),
        "episode": episode_figure(d, record),
        "episodes": episodes_figure(d, {"prbs": record, "chirp": record}),
        "information": information_figure(d, record, {**percent, d.parameters[0].name: None}),
    }


@pytest.fixture(scope="module")
def figures() -> dict[str, matplotlib.figure.Figure]:
    benchmark = benchmark_figure(ROWS, "A title")
    return {**figures_of(AERO2), "benchmark": benchmark}


NAMES = ("identification", "episode", "episodes", "information", "benchmark")


def labels_of(figure: matplotlib.figure.Figure) -> list[str]:
    return [label for a in figure.axes for label in (a.get_xlabel(), a.get_ylabel())]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("ending", "start"), [(".png", b"\x89PNG"), (".svg", b"<?xml"), (".PDF", b"%PDF")]
)
def test_every_figure_is_written(name, ending, start, figures, tmp_path):
    path = tmp_path / f"figure{ending}"
    save(figures[name], path)
    content = path.read_bytes()
    assert content.startswith(start)
    assert len(content) > 5000
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["identification", "episode", "episodes"])
def test_angles_are_drawn_in_degrees(name, figures):
    labels = labels_of(figures[name])
    assert any("pitch [deg]" in label for label in labels)
    assert not any("[rad" in label for label in labels)
    axis = next(a for a in figures[name].axes if a.get_ylabel() == "pitch [deg]")
    drawn = np.asarray(axis.get_lines()[0].get_ydata(), float)
    np.testing.assert_allclose(drawn, np.degrees(record_of(AERO2).outputs[:, 0]), rtol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_every_axis_that_shows_a_quantity_names_its_unit(name, figures):
    labels = [label for label in labels_of(figures[name]) if label]
    assert labels
    assert all(label.endswith("]") for label in labels)


def test_safety_levels_are_drawn_where_they_are(figures):
    axis = next(a for a in figures["episode"].axes if a.get_ylabel() == "pitch [deg]")
    flat = sorted(
        float(np.asarray(line.get_ydata())[0])
        for line in axis.get_lines()
        if len(set(np.asarray(line.get_ydata()).tolist())) == 1
    )
    np.testing.assert_allclose(flat, [-40, -30, 30, 40])


def test_the_residual_is_measured_minus_simulated(figures):
    axis = next(a for a in figures["identification"].axes if a.get_ylabel() == "residual [deg]")
    drawn = np.asarray(axis.get_lines()[0].get_ydata(), float)
    np.testing.assert_allclose(drawn, np.degrees(-0.01), rtol=1e-9)


def texts_of(figure: matplotlib.figure.Figure) -> str:
    figure.canvas.draw()
    artists = figure.findobj(lambda a: hasattr(a, "get_text"))
    return "\n".join(a.get_text() for a in artists)  # pyright: ignore[reportAttributeAccessIssue]


def test_the_identification_figure_says_fit_intervals_and_what_was_held(figures):
    text = texts_of(figures["identification"])
    for words in ("pitch: fit 97.12 %", "aero2: nls, successful", "D_p held", "0.0232", "kg m²"):
        assert words in text


@pytest.mark.parametrize("d", [EMPS.definition, TwoMasses.definition], ids=lambda d: d.name)
def test_any_plant_can_be_drawn(d, tmp_path):
    figures = figures_of(d)
    for name, figure in figures.items():
        save(figure, tmp_path / f"{name}.svg")
    labels = labels_of(figures["episode"])
    for part in (*d.inputs, *d.outputs):
        assert f"{part.name} [{part.unit}]" in labels


def test_figures_bear_what_has_no_number(tmp_path):
    """All estimates failed, nothing is seen, no interval, an output that is not finite."""
    failed = [row("chirp", "nls", 0.05, failed=50)]
    save(benchmark_figure(failed, "failed"), tmp_path / "a.svg")
    nothing: dict[str, float | None] = {"J_p": None, "K_pu": None, "D_p": None}
    save(information_figure(AERO2, record_of(AERO2), nothing), tmp_path / "b.svg")
    record, none = record_of(AERO2), (math.nan, math.nan)
    result = result_of(AERO2, math.nan, J_p=none, K_pu=none, D_p=none)
    simulated = np.full_like(record.outputs, np.nan)
    save(identification_figure(AERO2, result, record, simulated), tmp_path / "c.svg")
    assert len(list(tmp_path.iterdir())) == 3


def test_a_method_without_an_error_says_why():
    none = {"viable_seeds": 0}
    collapsed = [row("RL(all)", e, 1.0, failed=50).model_copy(update=none) for e in ("a", "nls")]
    rows = [row("chirp", "a", 1.0), row("chirp", "nls", 1.0, failed=50), *collapsed]
    for axis in benchmark_figure(rows, "A title").axes:
        names = [label.get_text() for label in axis.get_xticklabels()]
        assert names == ["chirp (nls failed)", "RL(all) (collapsed)"]


def curve_of(d: PlantDescription, size: float = 1.0) -> dict[str, np.ndarray]:
    falls = size * np.geomspace(1.0, 0.01, 5)
    errors = {f"relative_error_{p.name}": falls for p in d.parameters}
    return {"steps": 1e5 * np.arange(5.0), "violation_rate": np.zeros(5), **errors}


def agents_of(d: PlantDescription, size: float = 1.0) -> matplotlib.figure.Figure:
    """One agent moves the plant, another a tenth as far."""
    record = dataclasses.replace(record_of(d), metadata={"seed": 3, "estimator": "arx-rls"})
    small = dataclasses.replace(record, outputs=record.outputs / 10)
    estimates = np.full((len(record.time), len(d.parameters)), size)
    return agents_figure(d, {"big": (record, estimates), "small": (small, estimates)}, "A title")


def pairs(figure: matplotlib.figure.Figure) -> np.ndarray:
    return np.array(figure.axes, object).reshape(-1, 2)


def test_learning_curves_say_seeds_and_bounds_and_share_their_scales():
    d = TwoMasses.definition
    curves = {"PPO": [curve_of(d)] * 2, "gradient_D": [curve_of(d, 1e-3)]}
    axes = pairs(curves_figure(d, curves, "A", bounds=["gradient_D"]))
    assert [axis.get_title() for axis in axes[0]] == ["PPO, 2 seeds", "gradient_D, 1 seed"]
    for p, (error, bound) in zip(d.parameters, axes, strict=False):
        assert error.get_ylabel() == f"{p.name} error [%]"
        assert bound.get_ylabel() == f"{p.name} bound [%]"
    assert all(left.get_ylim() == right.get_ylim() for left, right in axes)


def test_an_agents_episode_says_seed_and_estimator_and_names_every_parameter():
    d = CartPole.definition
    figure = agents_of(d)
    axes = pairs(figure)
    assert [axis.get_title() for axis in axes[0]] == ["big, seed 3", "small, seed 3"]
    assert axes[-1, 0].get_ylabel() == "arx-rls / true"
    assert all(left.get_ylim() == right.get_ylim() for left, right in axes)
    shown = [text.get_text() for text in figure.legends[0].get_texts()]
    assert [p.name for p in d.parameters] == [name for name in shown if "level" not in name]
    colours = {line.get_color() for line in axes[-1, 0].get_lines()}
    assert len(colours) == len(d.parameters) + 1


def test_where_there_are_no_running_estimates_there_is_no_axis_for_them():
    d = CartPole.definition
    assert len(agents_of(d, math.nan).axes) == len(agents_of(d).axes) - 2
    assert "true" not in "".join(labels_of(agents_of(d, math.nan)))


@pytest.mark.parametrize("d", [AERO2, CartPole.definition], ids=lambda d: d.name)
def test_nothing_of_a_figure_with_one_agent_lies_beyond_its_edge(d):
    title = "A title that says everything there is to be said about what is seen below it"
    alone = {"an agent with a long name": [curve_of(d)]}
    one = {"an agent with a long name": (record_of(d), np.ones((60, len(d.parameters))))}
    rows = [row("chirp", name, 1.0) for name in ("arx-rls", "arx-rls-wide", "nls")]
    first = {"relative_error_percent": {"J_p": rows[0].relative_error_percent["J_p"]}}
    errors = [r.model_copy(update=first) for r in rows]
    for figure in (
        curves_figure(d, alone, title),
        agents_figure(d, one, title),
        benchmark_figure(errors, title),
    ):  # fmt: skip
        figure.canvas.draw()
        for part in (*figure.legends, *figure.texts):
            box = part.get_window_extent()
            assert box.x0 >= 0
            assert box.x1 <= figure.bbox.x1


def test_an_estimate_of_zero_can_be_drawn(tmp_path):
    result, record = result_of(AERO2, K_pu=(0.0, 1.0)), record_of(AERO2)
    save(identification_figure(AERO2, result, record, record.outputs), tmp_path / "a.svg")
    assert (tmp_path / "a.svg").is_file()


def test_an_ellipse_holds_95_percent_of_a_normal_distribution():
    sd, correlation = np.array([0.02, 0.5]), np.array([[1.0, -0.8], [-0.8, 1.0]])
    params = {"a": (2.0, 0.02, ""), "b": (1.0, math.nan, ""), "c": (-5.0, 0.5, "")}
    table = [[1.0, 0.0, -0.8], [0.0, 1.0, 0.0], [-0.8, 0.0, 1.0]]
    figure = correlation_figure(summary(params, correlation=table))
    assert figure is not None
    (axis,) = figure.axes
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("a [%]", "c [%]")
    assert axis.get_title() == "correlation -0.800"
    ellipse = axis.get_lines()[0].get_xydata()
    drawn = np.random.default_rng(0).multivariate_normal(
        np.zeros(2), correlation * np.outer(sd, sd), 20_000
    )
    inside = matplotlib.path.Path(ellipse).contains_points(100 * drawn / np.array([2.0, 5.0]))
    assert inside.mean() == pytest.approx(0.95, abs=0.005)


def test_without_a_pair_there_is_no_ellipse():
    assert correlation_figure(summary({"a": (2.0, 0.02, "")}, correlation=[[1.0]])) is None


@pytest.mark.parametrize(
    ("correlation", "words"),
    [
        (np.eye(2), "+0.000 between k and m"),
        (np.array([[1, -0.5], [-0.5, 1]]), "-0.500 between k and m"),
        (np.array([[1, 0.1, np.nan], [0.1, 1, 0.3], [np.nan, 0.3, 1]]), "+0.300 between m and d"),
    ],
)
def test_the_largest_correlation_is_one_of_two_parameters(correlation, words):
    names = dict.fromkeys("kmd"[: len(correlation)])
    result = EstimateSummary.model_construct(params=names, correlation=correlation)
    assert largest_correlation(result) == words


def test_the_autocorrelation_of_white_noise_lies_between_the_dashed_lines():
    rng = np.random.default_rng(0)
    white = [rng.normal(size=(2000, 1)) for _ in range(2)]
    walk = [np.cumsum(w, axis=0) for w in white]
    for residuals, least, most in ((white, 0.9, 1.0), (walk, 0.0, 0.0)):
        (axis,) = autocorrelation_figure(AERO2, residuals).axes
        lines: Any = axis.collections[0]
        bars = np.array([bar[1, 1] for bar in lines.get_segments()])
        level = max(np.asarray(line.get_ydata(), float)[0] for line in axis.get_lines())
        assert len(bars) == 25
        assert level == pytest.approx(HALF_95 / math.sqrt(4000))
        assert least <= np.mean(np.abs(bars) < level) <= most
    one = walk[0][:, 0] - walk[0].mean()
    (axis,) = autocorrelation_figure(AERO2, walk[:1]).axes
    first: Any = axis.collections[0]
    assert first.get_segments()[0][1, 1] == pytest.approx(one[1:] @ one[:-1] / (one @ one))


@pytest.mark.parametrize("length", [3, 100, 101, 4001, 7999, 100_000])
def test_of_a_long_record_every_peak_is_kept_and_no_more_points_than_allowed(length):
    rng = np.random.default_rng(length)
    first, second = rng.normal(size=(2, length))
    at = rng.choice(length, min(12, length), replace=False)
    first[at] = np.where(np.arange(len(at)) % 2, 50.0, -50.0)
    second[: length // 2] = np.nan
    kept = kept_samples([first, second], 100)
    assert len(kept) <= max(100, 3)
    assert np.all(np.diff(kept) > 0)
    assert kept[0] == 0
    assert kept[-1] == length - 1
    assert len(kept) == length or len(kept) > 25
    assert {first[kept].min(), first[kept].max()} == {first.min(), first.max()}
    assert np.nanmax(second[kept]) == np.nanmax(second)
    assert np.nanmin(second[kept]) == np.nanmin(second)


def test_a_single_sample_beyond_a_critical_level_is_drawn():
    d, record = AERO2, record_of(AERO2, 9999)
    outputs = np.zeros_like(record.outputs)
    outputs[5001] = 2.0  # far beyond it, and no multiple of any step
    record = dataclasses.replace(record, outputs=outputs)
    for figure in (
        episode_figure(d, record),
        identification_figure(d, result_of(d), record, np.zeros_like(outputs)),
    ):
        lines = [line for axes in figure.axes[:2] for line in axes.get_lines()]
        drawn = [np.asarray(line.get_ydata(), float) for line in lines]
        highest = [values.max() for values in drawn if len(values) > 2]  # a level has two ends
        assert max(highest) == pytest.approx(np.degrees(2.0))


def test_a_figure_that_cannot_be_written_leaves_nothing(figures, tmp_path):
    with pytest.raises(ValueError, match="does not exist"):
        save(figures["episode"], tmp_path / "nowhere" / "a.png")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["a.jpg", "a", "a.csv", "png"])
def test_another_ending_is_refused_with_those_that_are_allowed(name, tmp_path):
    with pytest.raises(ValueError, match="figures end in") as error:
        require_plot_path(tmp_path / name)
    assert all(ending in str(error.value) for ending in PLOT_ENDINGS)


def test_a_figure_for_no_folder_is_refused_beforehand(tmp_path):
    with pytest.raises(ValueError, match="does not exist"):
        require_plot_path(tmp_path / "nowhere" / "a.png")
    require_plot_path(tmp_path / "a.PNG")


def test_report_needs_no_jax():
    program = "import excite.report.html, sys; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


def test_the_figure_of_a_long_record_stays_small(tmp_path):
    long = record_of(AERO2, 100_000)
    save(episode_figure(AERO2, long), tmp_path / "long.svg")
    assert (tmp_path / "long.svg").stat().st_size < 1_000_000
