"""`excite report`: one page that needs nothing else, with the numbers of the command line."""

import csv
import html
import json
import math
import re
import shutil
import subprocess
import sys
from collections import Counter
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from excite.cli import main
from excite.policy import read_policy
from excite.report import html as html_report
from excite.report.answer import answered, best_columns, told_of_campaign
from excite.report.estimates import parameter_cells, residual_cells, residual_in_words
from excite.report.frontier import frontier
from excite.report.html import report_html
from excite.report.key_figures import of_study
from excite.report.numbers import number
from excite.report.rows import EstimateSummary, Row, StudyFacts
from excite.report.study_table import StudyTable, difference_cells, footnotes
from excite.report.svg import inline_svg
from excite.study.table import finished_table

RESULTS = Path(__file__).parent.parent / "results"
LIMIT = 3_000_000
VOID = {"meta", "img", "br", "link", "input", "hr"}
STUDY = """
name = "two"
plant = "aero2"
episodes = 8
num_steps = 120
[methods.random]
excitation = "random"
[methods.chirp]
excitation = "chirp"
[estimators.arx-rls]
kind = "arx-rls"
[estimators.wide]
kind = "arx-rls-wide"
"""
BOTH = "identify chirp.csv prbs.csv --validate prbs.csv --plant aero2 --estimator arx-rls"
SCRIPT = "<script>alert(1)</script>"
MATHS = r"$\frac{$"


class Page(HTMLParser):
    """What a browser would make of a page; AssertionError where tags are not balanced."""

    def __init__(self, text: str):
        super().__init__(convert_charrefs=True)
        self.tags, self.ids, self.uses = Counter(), Counter(), set()
        self.loads, self.tables, self.words, self.styles = [], [], [], []
        self._open = []
        self.text = text
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        self.tags[tag] += 1
        if tag not in VOID:
            self._open.append(tag)
        self.take(tag, dict(attrs))

    def handle_startendtag(self, tag, attrs):
        self.tags[tag] += 1
        self.take(tag, dict(attrs))

    def take(self, tag, attrs):
        assert not [name for name in attrs if name.startswith("on")]
        if "id" in attrs:
            self.ids[attrs["id"]] += 1
        for name in ("src", "href", "xlink:href", "data", "action", "srcset"):
            target = attrs.get(name, "")
            if target.startswith("#"):
                self.uses.add(target[1:])
            elif target:
                self.loads.append(target)
        self.uses |= set(re.findall(r"url\(#([^)]*)\)", " ".join(map(str, attrs.values()))))
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        inside = self._open[-1] if self._open else ""
        (self.styles if inside == "style" else self.words).append(data)
        if inside in ("td", "th"):
            self.tables[-1][-1][-1] += data

    def table_with(self, *titles: str) -> list[list[str]]:
        """Rows of the one table that begins with these column titles, the titles first."""
        (found,) = [t for t in self.tables if t[0][: len(titles)] == list(titles)]
        return found

    def section(self, title: str) -> str:
        """The source from a heading to the next one."""
        return self.text.split(f">{title}</h3>")[1].split("<h3>")[0]


@pytest.fixture(autouse=True)
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are most of the work, and most tests read the words."""
    monkeypatch.setattr(html_report, "inline_svg", lambda *_: "<svg></svg>")


@pytest.fixture
def drawn(undrawn: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(html_report, "inline_svg", inline_svg)


@cache
def page_of(*runs: Path, drawn: bool = False) -> Page:
    with pytest.MonkeyPatch.context() as patch:
        if drawn:
            patch.setattr(html_report, "inline_svg", inline_svg)
        return Page(report_html(runs))


def excite(*words: object) -> int:
    """The command line, as a program would call it; its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["excite", *map(str, words)])
        with pytest.raises(SystemExit) as ending:
            main()
    return int(ending.value.code or 0)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with records and runs of every kind; no test writes to it."""
    return with_runs(tmp_path_factory.mktemp("made"), STUDY, BOTH)


def with_runs(folder: Path, study: str, both: str) -> Path:
    """The folder with records, identifications, a study and a run on the simulated rig.

    Args:
        study: its file.
        both: the command that identifies both records.
    """
    (folder / "two.toml").write_text(study)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for line in (
            "simulate aero2 --excitation chirp --steps 200 --out chirp.csv",
            "simulate aero2 --excitation prbs --steps 200 --noise pitch=0.002 --out prbs.csv",
            "identify chirp.csv --plant aero2 --out one",
            f"{both} --out both",
            "study run two.toml --out bench",
            "run --rig simulated --fast --steps 100 --input chirp.csv --out rig.csv",
        ):
            assert excite(*line.split()) == 0
    return folder


@pytest.fixture
def here(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder: a copy of those."""
    folder = tmp_path / "here"
    shutil.copytree(made, folder)
    monkeypatch.chdir(folder)
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in folder.rglob("*") if f.is_file()}


def read(path: Path) -> dict:
    return json.loads(path.read_text())


def estimate(folder: Path) -> EstimateSummary:
    return EstimateSummary.read(folder / "estimate.json")


# Every page


def assert_is_self_contained(page: Page) -> None:
    assert len(page.text.encode()) < LIMIT
    assert {t for t in page.loads if not t.startswith("data:image/png;base64,")} == set()
    assert not {"script", "link", "iframe", "object", "embed", "base", "form"} & set(page.tags)
    assert not re.search(r"@import|url\((?!#)", page.text)
    assert [name for name, count in page.ids.items() if count > 1] == []
    assert page.uses <= set(page.ids)
    assert page.text.startswith("<!DOCTYPE html>\n<html lang=")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["table1", "nls"])  # the others: tests/results
def test_a_study_makes_one_small_page_with_the_table_of_the_command_line(name, capsys):
    assert_is_the_page_of_a_study(name, capsys)


def assert_is_the_page_of_a_study(name: str, capsys) -> None:
    page = page_of(RESULTS / name, drawn=True)
    assert_is_self_contained(page)
    assert_has_the_table_of_the_command_line(page, RESULTS / name, capsys)
    assert page.tags["svg"] >= 1
    is_old = not (RESULTS / name / "episodes.json").is_file()
    assert page.tags["img"] == (is_old and (RESULTS / name / "episodes.png").is_file())


@pytest.mark.parametrize("name", ["one", "both", "bench", "rig.csv", "chirp.csv"])
def test_an_experiment_makes_one_small_page_that_needs_nothing_else(name, made):
    page = page_of(made / name, drawn=True)
    assert_is_self_contained(page)
    assert page.tags["svg"] >= 1
    assert page.tags["img"] == 0
    assert str(made.parent) not in page.text  # where it lies is nobody's business


def row(method: str, estimator: str, log_det: float, bound: float, violations: int = 0) -> Row:
    """A row of a study of one parameter, with errors a tenth above the bound, or far above."""
    rms = bound * (1.1 if estimator == "nls" else 50.0)
    error = {"mean": 0.8 * rms, "sd": rms, "median": rms, "rms": rms}
    return Row.model_validate({
        "method": method, "estimator": estimator, "evaluations": 100, "failed": 0, "failures": {},
        "violations": violations, "log_det_information": log_det, "log_det_information_sd": 1.0,
        "violation_rate": {"estimate": violations / 100, "ci95": [0.0, 0.037]},
        "max_abs_output": {"mean": 1.0, "sd": 1.0, "output": "y", "unit": "m"},
        "relative_error_percent": {"k": error}, "cramer_rao_percent": {"k": bound},
        "rms_over_cramer_rao": {"k": 1.1}, "coverage95_percent": {"k": 95.0},
        "beyond_6_std_errors": 0,
    })  # fmt: skip


ROWS = [
    row("chirp", "arx", 50.0, 0.4), row("chirp", "nls", 50.0, 0.4),
    row("loud", "nls", 60.0, 0.05, violations=3), row("learned", "nls", 55.0, 0.1),
    row("clairvoyant", "nls", 70.0, 0.02),
]  # fmt: skip
FACTS = StudyFacts(
    name="s", plant="p", episodes=100, num_steps=10, seed=0, spread=0.3,
    methods={"chirp": {}, "loud": {}}, estimators={"arx": {}, "nls": {}},
)  # fmt: skip


def test_a_study_is_answered_by_the_most_informative_excitation_without_a_violation():
    found = answered(ROWS, FACTS, {"learned": "largest output found: 0.97; found, not proved"})
    assert found.best is not None
    assert (found.best.method, found.best.estimator) == ("learned", "nls")
    first, second, third = found.sentences
    assert "Of 2 excitations that reached no critical level" in first
    assert "learned tells most about the plant: log det 55.0" in first
    assert "4 times smaller than those of chirp" in first  # 0.4 over 0.1
    assert second.startswith("It reached a critical level in 0 of 100 experiments (sampled; 95 %")
    assert third == "Search for violations: largest output found: 0.97; found, not proved."
    for claims in ({"learned": "no certificate: no search for violations"}, {}):
        told = answered(ROWS, FACTS, claims).sentences[2]
        assert told == "It was not searched for violations (excite falsify)."
    assert [cells[0] for cells in found.table()[1]] == ["learned", "chirp", "loud"]
    none = answered([ROWS[2]], FACTS, {})
    assert none.best is None
    assert none.sentences == (
        "No excitation was without a violation: loud had the fewest, 3 of 100.",
    )


def with_gain(row: Row, nats: float) -> Row:
    bound = {"mean": nats, "std_error": 0.05}
    gain = {"lower": bound, "upper": bound, "plants": 9, "samples": 9, "from_prior": True}
    return Row.model_validate({**row.data(), "expected_gain": gain})


def test_a_study_with_expected_gains_is_answered_in_nats():
    """Also where the order by log det is another one: a row without a gain comes last."""
    chirp, loud, learned = (with_gain(ROWS[i], nats) for i, nats in ((1, 9.0), (2, 12.0), (3, 7.5)))
    found = answered([chirp, loud, learned, ROWS[4]], FACTS, {})
    assert [row.method for row in found.rows] == ["chirp", "learned", "loud"]
    told = found.sentences[0]
    assert "chirp tells most about the plant: an expected information gain of 9.00 ± 0.05" in told
    assert "log det" not in told
    other = answered([chirp, with_gain(ROWS[3], 10.5)], FACTS, {})
    assert "10.50 ± 0.05 nats, 1.5 nats more than chirp." in other.sentences[0]
    assert frontier([chirp, loud, learned]) == ["chirp", "loud"]
    table = StudyTable(rows=(chirp, learned), study=FACTS)
    assert of_study(table) == "chirp: 9.00 ± 0.05 nats, violations 0/100 (0.0–3.7 %)"


def test_two_bounds_are_explained_where_a_cell_has_two():
    alone = with_gain(ROWS[1], 9.0)
    wide = alone.data()
    wide["expected_gain"]["upper"] = {"mean": 9.2, "std_error": 0.05}
    told = "Two figures are a lower and an upper bound."
    assert told not in " ".join(footnotes(FACTS, [alone]))
    assert told in " ".join(footnotes(FACTS, [alone, Row.model_validate(wide)]))


def test_a_campaign_is_answered_by_its_targets_and_its_nearness():
    known = {
        "J_p": {"estimate": 0.02, "ci95_half": 0.0004},
        "D_p": {"estimate": 1.0, "ci95_half": None},
    }
    told = {
        "rounds": [{"nearness": 0.5}, {"nearness": 0.72}, {"nearness": None}], "num_samples": 90,
        "reason": "every target is reached", "interrupted": "", "estimate": known,
        "targets": {"J_p": "2 %", "D_p": "1 %", "K_pu": "1 %"},
    }  # fmt: skip
    assert told_of_campaign(told) == (
        "After 90 samples in 3 rounds, every target is reached: J_p = 0.02000 ± 2.0 % (asked: "
        "2 %), D_p = 1.00, its interval open (asked: 1 %) and K_pu not known (asked: 1 %), with "
        "95 % intervals.",
        "The measured outputs reached no critical level: the nearest came to 72 % of it.",
    )
    early = {**told, "rounds": [{"nearness": 1.1}], "reason": "", "estimate": {}, "targets": {}}
    assert told_of_campaign(early) == (
        "After 90 samples in 1 round, not ended.",
        "Round 1 reached its critical level: the nearest came to 110 % of it.",
    )
    assert "Nothing was measured" in told_of_campaign({**early, "rounds": []})[1]


def test_an_answer_keeps_its_sense_at_the_edges():
    unknown = row("drifting", "nls", math.nan, math.nan)
    assert [r.method for r in answered([unknown, *ROWS], FACTS, {}).rows][-2:] == [
        "drifting", "loud",
    ]  # fmt: skip
    alone = answered([unknown, row("chirp", "nls", math.nan, math.nan)], FACTS, {})
    assert "standard errors" not in alone.sentences[0]
    equal = answered([row("learned", "nls", 55.0, 0.4), ROWS[1]], FACTS, {})
    assert "that it allows are about those of chirp" in equal.sentences[0]
    large = answered([row("learned", "nls", 55.0, 0.003), ROWS[1]], FACTS, {})
    assert "133 times smaller than those of chirp" in large.sentences[0]
    failing = [r.model_copy(update={"failed": 95}) for r in ROWS if r.estimator == "nls"]
    assert answered([*failing, ROWS[0]], FACTS, {}).rows[0].estimator == "arx"
    reference = answered([ROWS[4]], FACTS, {})
    assert (reference.best, reference.sentences) == (None, ())


def test_the_best_of_a_column_is_safe_and_knows_nothing():
    """Neither loud, clairvoyant, nor one that often fails; equal ones are both the best."""
    failing = row("failing", "nls", 80.0, 0.01).model_copy(update={"failed": 6})
    unknown = row("drifting", "nls", math.nan, math.nan)
    own = [r for r in ROWS if r.estimator == "nls"]
    table = StudyTable(rows=(unknown, failing, *own), study=FACTS)
    header = table.cells()[0]
    every = {header.index("k error %"), header.index("bound %"), header.index("log det")}
    best = best_columns(table)
    assert best == {r.method: every if r.method == "learned" else set() for r in table.rows}
    twin = row("twin", "nls", 40.0, 0.1)
    best = best_columns(StudyTable(rows=(*own, twin), study=FACTS))
    assert best["twin"] == every - {header.index("log det")}
    assert best["learned"] == every
    assert not any(best_columns(StudyTable(rows=(ROWS[2],), study=FACTS)).values())


def test_the_frontier_is_what_no_other_method_beats():
    drawn = np.random.default_rng(0).integers(0, 12, (40, 2))
    rows = [row(f"m{i}", "nls", float(a), 0.1, violations=int(b)) for i, (a, b) in enumerate(drawn)]
    reference, unknown = row("clairvoyant", "nls", 99.0, 0.1), row("none", "nls", math.nan, 0.1)
    best = frontier([*rows, reference, unknown])
    assert 1 < len(best) < len(rows)
    for own in rows:
        beaten = any(
            (r.log_det_information, -r.violations) > (own.log_det_information, -own.violations)
            and r.violations <= own.violations
            for r in rows
        )
        assert (own.method in best) is not beaten
    assert frontier([reference]) == []


@pytest.mark.parametrize("name", ["frontier", "table1"])
def test_a_page_of_a_study_begins_with_the_answer(name):
    body = report_html([RESULTS / name]).partition("<main>")[2]
    assert body.index('class="answer"') < body.index("<svg") < body.index("<table>")
    assert body.index("<table>") < body.index("<h3>All results</h3>")


def test_what_a_search_found_for_an_agent_is_on_its_page():
    policy = read_policy(RESULTS / "robust/seeds/gradient_D/0/policy.safetensors")
    assert f"gradient D, seed 0: {policy.claim}" in page_of(RESULTS / "robust", drawn=True).words


def test_the_page_is_light_dark_and_printable(made):
    style = "".join(page_of(made / "one").styles)
    assert "prefers-color-scheme: dark" in style
    assert "@media print" in style
    names = set(re.findall(r"(--\w+):", style))
    text = page_of(made / "one", drawn=True).text
    assert set(re.findall(r"var\((--\w+)\)", text)) <= names | {"--width"}
    light, dark = (set(re.findall(r"(--\w+):", rules)) for rules in style.split("@media")[:2])
    assert light == dark


def test_figures_take_their_colours_from_the_page(made):
    for drawn in re.findall("<svg.*?</svg>", page_of(made / "both", drawn=True).text, re.S):
        # Only the grid's grey is the same by day and by night.
        assert set(re.findall("#[0-9a-f]{6}", drawn)) <= {"#b0b0b0"}
        assert "font-family" not in drawn


def test_a_figure_keeps_its_words_as_text():
    page = page_of(RESULTS / "table1", drawn=True)
    assert "mean relative error [%]" in page.words
    assert "mathdefault" not in page.text
    assert {"0.001", "0.01", "0.1", "10"} <= set(page.words)


def test_the_same_runs_make_the_same_page(made, drawn):
    assert report_html([made / "one"]) == page_of(made / "one", drawn=True).text


def test_no_jax_is_needed(made):
    program = (
        "import sys; from pathlib import Path; from excite.report.html import report_html\n"
        "report_html([Path(p) for p in sys.argv[1:]])\n"
        "sys.exit('jax' in sys.modules or 'equinox' in sys.modules)"
    )
    words = [sys.executable, "-c", program, made / "one", made / "bench", made / "rig.csv"]
    assert subprocess.run(words, check=False).returncode == 0


# The numbers are those of the command line


def assert_has_the_table_of_the_command_line(page: Page, folder: Path, capsys) -> None:
    assert excite("study", "table", folder) == 0
    shown = " ".join(capsys.readouterr().out.split())
    table = finished_table(folder)
    assert page.table_with("method", "estimator") == [table.cells()[0], *table.cells()[1]]
    for row in table.cells()[1]:
        assert all(cell in shown for cell in row)
    for note in footnotes(table.study, table.rows):
        assert note in page.words
        assert note in shown
    assert page.text.count('class="published"') + page.text.count('class="first published"') == len(
        table.study.reference
    )


def test_differences_are_those_of_the_table():
    folder = RESULTS / "table1"
    header, cells = difference_cells(finished_table(folder).differences)
    assert page_of(folder).table_with("method", "minus") == [header, *cells]


def test_a_p_value_too_small_for_the_computer_is_not_zero(made):
    result = estimate(made / "one")
    (output,) = result.whiteness_p_value
    p = {"whiteness_p_value": {output: 0.0}, "structure_p_value": {output: 1e-20}}
    tiny = result.model_copy(update=p)
    assert residual_cells(tiny, output) == ["no", "< 1e-300", "yes", "1.00e-20"]
    shown = "not white (p < 1e-300), follows the input (p = 1.00e-20)"
    assert residual_in_words(tiny, output).endswith(shown)


@pytest.mark.parametrize("name", ["one", "both"])
def test_parameters_are_those_of_the_command_line(name, made, capsys, monkeypatch):
    monkeypatch.chdir(made)
    words = BOTH if name == "both" else "identify chirp.csv --plant aero2"
    assert excite(*words.split()) == 0
    shown = capsys.readouterr().out
    result, page = estimate(made / name), page_of(made / name)
    _, *cells = page.table_with("symbol", "unit", "estimate")
    assert cells == [parameter_cells(n, p) for n, p in result.params.items()]
    for row in cells:
        assert re.search(r"\s+".join(map(re.escape, row[:-1])), shown)
    for sentence in result.verdict:
        assert sentence in page.words
    (output, fit, size, *tests), *held_out = page.table_with("output", "fit")[1:]
    assert f"{output}: fit {fit}, {residual_in_words(result, output)}\n" in shown
    assert tests == residual_cells(result, output)
    assert f"residual {size} RMS, " in shown
    assert len(held_out) == len(result.validation)
    correlation = re.search("largest correlation: (.*)", shown)
    assert correlation
    assert f"Largest correlation: {correlation[1]}." in "".join(page.words)


@pytest.mark.parametrize(
    ("white", "structure", "cells", "words"),
    [
        (0.03, 0.04, ["yes", "0.0300", "no", "0.0400"],
         "residual 1.50 deg RMS, white (p = 0.0300), does not follow the input (p = 0.0400)"),
        (1e-9, 0.009, ["no", "1.00e-09", "yes", "0.00900"],
         "residual 1.50 deg RMS, not white (p = 1.00e-09), follows the input (p = 0.00900)"),
        (None, math.nan, ["–", "–", "–", "–"],
         "residual 1.50 deg RMS, too small or too short to be tested"),
    ],
)  # fmt: skip
def test_a_residual_is_judged_at_one_percent_everywhere(white, structure, cells, words, here):
    path = here / "one" / "estimate.json"
    tests = {"whiteness_p_value": {"pitch": white}, "structure_p_value": {"pitch": structure}}
    size = {"pitch": {"rms": math.radians(1.5), "sum_of_squares": 1.0, "unit": "rad"}}
    path.write_text(json.dumps({**read(path), **tests, "residual": size}))
    page = Page(report_html([here / "one"]))
    header, row = page.table_with("output", "fit")
    assert header[3:] == ["white", "p", "follows the input", "p"]
    assert row[2:] == ["1.50 deg", *cells]
    assert residual_in_words(estimate(here / "one"), "pitch") == words


def test_a_simulated_plants_own_parameters_stand_beside_the_estimates(made):
    result = read(made / "one" / "estimate.json")["params"]
    _, *rows = page_of(made / "one").table_with("symbol", "unit", "true")
    for (name, _, true, error, inside), p in zip(rows, result.values(), strict=True):
        assert float(error.removesuffix(" %")) == pytest.approx(
            100 * (p["estimate"] / float(true) - 1), rel=0.01, abs=1e-6
        )
        assert inside == ("yes" if p["ci95"][0] <= float(true) <= p["ci95"][1] else "no"), name


# What a page says


def test_every_record_of_an_experiment_is_drawn_with_its_fit(made):
    for name, count in (("one", 1), ("both", 2)):
        words = page_of(made / name).words
        captions = [w for w in words if "measured and simulated output" in w]
        assert len(captions) == count


def test_a_page_says_how_to_do_it_again(made, tmp_path):
    for name, line in (("both", f"excite {BOTH} --out both"),
                       ("bench", "excite study run two.toml --out bench")):  # fmt: skip
        assert read(made / name / "run.json")["command"] == line
        assert line in page_of(made / name).words
    assert "excite study run studies/half.toml --out runs/half" in page_of(RESULTS / "half").words
    shutil.copytree(RESULTS / "half", tmp_path / "half")
    marker = read(tmp_path / "half" / "run.json")
    (tmp_path / "half" / "run.json").write_text(json.dumps({**marker, "command": ""}))
    old = page_of(tmp_path / "half").section("Repeat the run")
    assert "Most likely" in old
    assert "excite study run half.toml --out FOLDER" in old


def test_a_record_says_how_the_experiment_ended(made):
    ended = read(made / "rig.csv".replace("csv", "json"))["ended"]
    words = page_of(made / "rig.csv").words
    assert "How it ended" in words
    assert ended["reason"] in words
    assert "How it ended" not in page_of(made / "chirp.csv").words


def test_a_record_that_was_cut_off_says_so(here):
    sidecar = here / "rig.json"
    sidecar.write_text(json.dumps({**read(sidecar), "ended": None}))
    assert "is still running, or its process was killed" in report_html([here / "rig.csv"])


def test_levels_that_were_reached_are_named(here):
    sidecar = read(here / "chirp.json")
    for warning, critical, said in (
        (None, None, "–"),
        (8, 9, "below both"),
        (0.1, 9, "warning level reached, as measured"),
        (0.05, 0.1, "critical level reached, as measured"),
    ):
        output = sidecar["plant"]["outputs"][0]
        output |= {"warning_level": warning, "critical_level": critical}
        (here / "chirp.json").write_text(json.dumps(sidecar))
        page = Page(report_html([here / "chirp.csv"]))
        assert page.table_with("signal")[2][-1] == said


def test_one_episode_of_every_method_is_drawn(here, drawn):
    path = here / "bench" / "episodes.json"
    episodes = read(path)
    assert list(episodes) == ["random", "chirp"]
    assert episodes["random"]["inputs"] != episodes["chirp"]["inputs"]
    assert {len(e["time"]) for e in episodes.values()} == {121}
    shown = Page(report_html([here / "bench"])).section("One episode each")
    assert ">random<" in shown
    assert ">chirp<" in shown
    assert "arx-rls / true" in shown
    path.unlink()
    assert "One episode each" not in report_html([here / "bench"])


def test_a_study_says_what_was_set_inferred_and_its_own():
    settings, page = read(RESULTS / "table1" / "study.json"), page_of(RESULTS / "table1")
    for sentence in (*settings["inferred"], *settings["ours"]):
        assert sentence in page.words
    _, *agents = page.table_with("agent")
    assert [row[0] for row in agents] == list(settings["agents"])
    assert "weight 5" in agents[2][3]


@pytest.mark.science
def test_learning_is_drawn_from_all_seeds_or_not_at_all(tmp_path):
    assert "RL(all), 10 seeds" in page_of(RESULTS / "table1", drawn=True).words
    assert "J_p bound [%]" in page_of(RESULTS / "frontier", drawn=True).words
    old = tmp_path / "old"
    shutil.copytree(RESULTS / "table1", old, ignore=shutil.ignore_patterns("seeds"))
    page = Page(report_html([old]))
    assert "RL(all), 10 seeds" not in page.words
    assert "img" not in page.tags


def test_several_runs_stand_side_by_side(made):
    page = page_of(made / "one", made / "both", made / "bench", made / "one")
    assert_is_self_contained(page)
    header, *rows = page.table_with("", "unit")
    assert header[2:] == ["1. one", "2. both", "4. one"]  # as in the contents
    shown = {row[0]: row[2:] for row in rows}
    for name, cells in shown.items():
        assert cells[0] == cells[2], name
    for column, run in enumerate(("one", "both")):
        for name, p in estimate(made / run).params.items():
            own = parameter_cells(name, p)
            assert shown[name][column] == f"{own[2]} ({own[4]})"
    assert {"run1", "run2", "run3", "run4"} <= page.uses & set(page.ids)


def test_several_studies_stand_side_by_side_by_their_common_methods():
    page = page_of(RESULTS / "table1", RESULTS / "paper", RESULTS / "emps")
    assert_is_self_contained(page)
    header, *rows = page.table_with("method", "estimator", "study")
    shown = {tuple(row[:3]): dict(zip(header[3:], row[3:], strict=True)) for row in rows}
    assert {title for _, _, title in shown} == {"1. table1", "2. paper"}
    assert {method for method, _, _ in shown} == {"RL(all)"}
    for name, title in (("table1", "1. table1"), ("paper", "2. paper")):
        for row in read(RESULTS / name / "table.json")["rows"]:
            if row["method"] == "RL(all)" and row["estimator"] in ("arx-rls", "nls"):
                cells = shown["RL(all)", row["estimator"], title]
                error = row["relative_error_percent"]["D_p"]
                assert cells["D_p error %"] == f"{number(error['mean'])} ± {number(error['sd'])}"
                assert cells["violations (95 %)"].endswith(("of 10 seeds", "(10 seeds)"))
    settings = {row[0]: row[1:] for row in page.table_with("", "1. table1", "2. paper")[1:]}
    assert all(first != second for first, second in settings.values())
    assert settings["decision: output_scale: pitch"] == ["0.3", "–"]


def test_studies_without_a_common_method_say_so_and_other_plants_are_not_compared(here):
    shutil.copytree("bench", "other")
    for name in ("random", "chirp"):
        renamed(here / "other" / "table.json", name, new=f"new {name}")
    sentence = "1. bench and 2. other have no method and estimator in common."
    assert sentence in Page(report_html([here / "bench", here / "other"])).words
    renamed(here / "other" / "table.json", "J_p", new="other")
    assert "side by side" not in report_html([here / "bench", here / "other"])


@pytest.mark.science
def test_long_records_make_no_large_page(here, drawn, monkeypatch):
    result, rng = read(here / "one" / "estimate.json"), np.random.default_rng(0)
    count, length = 2, 7999
    for i in range(1, count + 1):
        time, noise = 0.02 * np.arange(length), rng.normal(size=(3, length))
        for name, columns in (("record", "time,voltage,pitch"), ("simulated", "time,pitch")):
            values = [time, noise[0], noise[1]] if name == "record" else [time, 0.2 * noise[2]]
            np.savetxt(here / "one" / f"{name}_{i}.csv", np.transpose(values), delimiter=",",
                       header=columns, comments="")  # fmt: skip
    (here / "one" / "estimate.json").write_text(json.dumps({**result, "files": ["a.csv"] * count}))
    whole = len(report_html([here / "one", here / "one"]))
    monkeypatch.setattr("excite.report.html.MAX_BYTES", 2 * whole // 3)
    page = Page(report_html([here / "one", here / "one"]))
    assert_is_self_contained(page)
    assert len(page.text) <= 2 * whole // 3
    monkeypatch.setattr("excite.report.html._NUM_POINTS", (4000,))
    assert "larger than" in report_html([here / "one", here / "one"])


def test_what_scrolls_on_a_screen_is_reached_by_the_keyboard_and_named(made):
    text = page_of(RESULTS / "table1").text
    boxes = re.findall('<div class="scroll[^>]*>', text)
    stops = [box for box in boxes if "tabindex" in box]
    assert 0 < len(stops) < len(boxes)
    names = [re.findall('role="region" aria-label="([^"]*)"', box) for box in stops]
    assert all(len(name) == 1 and len(name[0]) > 15 for name in names)
    assert "table: Table 1: learned excitation beside the baselines" in [name[0] for name in names]
    assert "tabindex" not in page_of(made / "one").text  # nothing in it is that wide


def test_a_single_run_needs_no_list_of_contents(made):
    assert page_of(made / "one").tags["nav"] == 0
    assert page_of(made / "one").tags["h1"] == 1


def test_progress_is_told(made):
    told = []
    report_html([made / "chirp.csv", made / "rig.csv"], lambda *now: told.append(now))
    assert told == [("chirp.csv", 0, 2), ("rig.csv", 1, 2), ("done", 2, 2)]


# Nothing in a file is obeyed


def renamed(path: Path, *old: str, new: str) -> None:
    """Another name of some things in a JSON file."""
    text = path.read_text()
    for name in old:
        assert f'"{name}"' in text
        text = text.replace(f'"{name}"', json.dumps(new))
    path.write_text(text)


@pytest.mark.parametrize("hostile", [SCRIPT, '"><img src=x onerror=alert(1)>', MATHS])
def test_a_name_that_is_code_is_shown_and_not_obeyed(hostile, here, drawn):
    result = read(here / "one" / "estimate.json")
    words = ("J_p", "nls", "successful", "kg m²", *result["files"], *result["verdict"])
    renamed(here / "one" / "estimate.json", *words, new=hostile)
    renamed(here / "one" / "record.json", "chirp", new=hostile)
    record = here / "one" / "record.csv"
    rows = list(csv.reader(record.read_text().splitlines()))
    with record.open("w", newline="") as file:  # a column that nobody asked for
        writer = csv.writer(file)
        writer.writerows([*row, "0" if k else hostile] for k, row in enumerate(rows))
    for name in ("study.json", "table.json", "episodes.json"):
        renamed(here / "bench" / name, "chirp", "arx-rls", new=hostile)
    renamed(here / "bench" / "study.json", "two", new=hostile)
    page = Page(report_html([here / "one", here / "bench"]))
    assert_is_self_contained(page)
    assert page.tags["img"] == 0
    assert page.table_with("symbol")[1][:2] == [hostile, hostile]
    assert page.table_with("method", "estimator")[-2][:2] == [hostile, hostile]
    for title in ("Correlation of the estimates", "Error against bound", "One episode each"):
        assert hostile in html.unescape(page.section(title))


# Bad input: one sentence, exit code 2, nothing written


def damage(path: str, text: str = "{") -> object:
    return lambda: Path(path).write_text(text)


def without(path: str, key: str) -> object:
    def remove() -> None:
        content = read(Path(path))
        del content[key]
        Path(path).write_text(json.dumps(content))

    return remove


BAD = {
    "no such folder": (None, "nowhere", "nowhere: no such folder or record"),
    "no run folder": (lambda: Path("mine").mkdir(), "mine", "mine is no run folder"),
    "another file": (damage("a.txt", "text"), "a.txt", "neither a run folder nor a record"),
    "another kind": (damage("one/run.json", '{"kind": ["x"]}'), "one", "run of another kind"),
    "run.json": (damage("one/run.json"), "one", "run.json is damaged"),
    "no plant": (without("one/run.json", "plant"), "one", "run.json is damaged"),
    "estimate.json": (damage("one/estimate.json"), "one", "estimate.json is damaged"),
    "estimate without": (without("one/estimate.json", "verdict"), "one", "estimate.json is dam"),
    "other parameters": (
        damage("one/estimate.json", '{"params": 3, "fit_percent": {}, "files": [1]}'),
        "one",
        "estimate.json is damaged",
    ),
    "truncated record": (damage("one/record.csv", "time,voltage,pitch\n0,1"), "one", "truncated"),
    "no record": (lambda: Path("one/record.csv").unlink(), "one", "no such file"),
    "simulated.csv": (damage("one/simulated.csv"), "one", "simulated.csv is damaged"),
    "another length": (
        damage("one/simulated.csv", "time,pitch\n0,1\n1,1\n"), "one", "simulated.csv is damaged",
    ),
    "study.json": (damage("bench/study.json", "[]"), "bench", "study.json is damaged"),
    "settings": (without("bench/study.json", "spread"), "bench", "study.json is damaged"),
    "table.json": (damage("bench/table.json"), "bench", "table.json is damaged"),
    "rows": (damage("bench/table.json", '{"rows": [{}]}'), "bench", "table.json is damaged"),
    "no rows": (damage("bench/table.json", '{"rows": []}'), "bench", "table.json is damaged"),
    "unfinished": (lambda: Path("bench/table.json").unlink(), "bench", "not finished"),
    "episodes": (damage("bench/episodes.json", '{"a": {}}'), "bench", "episodes.json is damaged"),
    "no sidecar": (lambda: Path("rig.json").unlink(), "rig.csv", "has no sidecar rig.json"),
    "a foreign sidecar": (
        damage("rig.json", '{"kind": "mine", "plant": 1}'), "rig.csv", "no sidecar of a record",
    ),
    "a sidecar by hand": (
        damage("rig.json", '{"kind": "excite record", "plant": 1}'), "rig.csv", "rig.json",
    ),
    "the second": (damage("bench/table.json"), "one bench", "table.json is damaged"),
}  # fmt: skip


@pytest.mark.parametrize(("prepare", "runs", "sentence"), BAD.values(), ids=list(BAD))
def test_a_bad_run_is_one_sentence_and_leaves_nothing(prepare, runs, sentence, here, capsys):
    if prepare:
        prepare()
    refused("report", *runs.split(), "--out", "r.html", sentence=sentence, capsys=capsys)


@pytest.mark.parametrize(
    ("out", "sentence"),
    [
        ("r.pdf", "reports end in .html"),
        ("nowhere/r.html", "nowhere does not exist"),
        ("old.html", "--overwrite"),
        ("folder.html", "is a folder"),
    ],
)
def test_a_page_that_may_not_be_written_is_one_sentence(out, sentence, here, capsys):
    (here / "old.html").write_text("mine")
    (here / "folder.html").mkdir()
    refused("report", "one", "--out", out, sentence=sentence, capsys=capsys)


def refused(*words: str, sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(Path())
    capsys.readouterr()
    assert excite(*words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("excite: ")
    assert err.count("\n") == 1
    assert sentence in err
    assert contents(Path()) == before


def test_the_command_writes_the_page_and_tells(here, capsys):
    assert excite("report", "one", "rig.csv", "--out", "r.html", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    written = (here / "r.html").read_bytes()
    about = {"file": "r.html", "runs": ["one", "rig.csv"], "bytes": len(written)}
    assert told == {**about, "figures": None}
    assert written.decode() == report_html([Path("one"), Path("rig.csv")])
    assert excite("report", "rig.csv", "--out", "r.html", "--overwrite") == 0
    assert (here / "r.html").read_text() == report_html([Path("rig.csv")])


def test_numbers_that_do_not_exist_are_dashes(here):
    path = here / "bench" / "table.json"
    content = read(path)
    content["rows"][0]["relative_error_percent"]["J_p"] = dict.fromkeys(
        ("mean", "sd", "median", "rms")
    )
    path.write_text(json.dumps(content))
    page = Page(report_html([here / "bench"]))
    assert page.table_with("method", "estimator")[1][2] == "– ± –"
    assert "nan" not in " ".join(page.words).split()
