"""`excite report` as Markdown, LaTeX and notebook, and the answer with which a report begins."""

import json
import re
import shutil
import subprocess
from html import escape
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest
from markdown_it import MarkdownIt
from test_html_report import Page, contents, estimate, excite, read, refused, renamed, with_runs

import excite as ex
from excite.description import PlantDescription
from excite.record.figure import new_figure
from excite.report import latex, markdown
from excite.report.answer import told_of_identification, told_of_record
from excite.report.content import (
    Bullets,
    Code,
    Document,
    Element,
    Facts,
    Figure,
    Paragraph,
    Section,
    Table,
)
from excite.report.estimates import parameter_cells
from excite.report.latex import latex_page
from excite.report.markdown import markdown_page
from excite.report.report import FORMATS
from excite.report.rows import EstimateSummary
from excite.study.table import finished_table

STUDY = """
name = "two"
plant = "aero2"
episodes = 4
num_steps = 60
methods = { random = { excitation = "random" }, chirp = { excitation = "chirp" } }
estimators = { nls = { kind = "nls" } }
"""
BOTH = "identify chirp.csv prbs.csv --validate prbs.csv --plant aero2"
HOSTILE = [
    "<script>alert(1)</script>", r"$\frac{$", "a|b_c%&#~^{}", r"\input{/etc/passwd}", "[x](y)![z]",
    "# 1. `x` *y* _z_", "½ ≤ Ω² µ – „ß“",
]  # fmt: skip
SPECIAL = re.compile(r"[^\x00-\u017f\u2018-\u201d]|[#~^|<>`]|(?<!\\)_(?!\{)")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run of every kind; no test writes to it."""
    return with_runs(tmp_path_factory.mktemp("made"), STUDY, BOTH)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are most of the work, and most tests read the words."""
    monkeypatch.setattr("excite.report.report._drawn", lambda *_: b"")
    monkeypatch.setattr("excite.report.html.inline_svg", lambda *_: "<svg></svg>")


@pytest.fixture
def here(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder: a copy of those."""
    folder = tmp_path / "here"
    shutil.copytree(made, folder)
    monkeypatch.chdir(folder)
    return folder


def sentences(run: str) -> tuple[str, ...]:
    """The answer of a run, from its files."""
    if run.endswith(".csv"):
        record = ex.read_record(run)
        return told_of_record(record.description, record)
    return told_of_identification(estimate(Path(run)))


def shown(text: str) -> Page:
    """Markdown as a browser gets it."""
    return Page(MarkdownIt("commonmark").enable(["table", "strikethrough"]).render(text))


def assert_is_latex(text: str) -> None:
    """Whether environments, braces, mathematics and the columns of tables are balanced."""
    begun = []
    for word, name in re.findall(r"\\(begin|end)\{(\w+\*?)\}", text):
        if word == "begin":
            begun.append(name)
        else:
            assert begun.pop() == name
    assert begun == []
    body = text.split(r"\begin{document}")[1]
    plain = re.sub(r"\\[{}$%&#_]", "", body)
    assert plain.count("{") == plain.count("}")
    assert plain.count("$") % 2 == 0
    assert "%" not in plain
    for table in re.findall(r"\\begin\{tabular\}(.*?)\\end\{tabular\}", plain, re.S):
        columns, _, lines = table.partition("\n")
        count = len(re.sub(r"[^lrp]", "", re.sub(r">\{\\\w+\\\w+\}p\{[^}]*\}", "p", columns)))
        rows = [line for line in lines.splitlines() if line.endswith(r"\\")]
        assert {row.count("&") + 1 for row in rows} == {count}
    outside = re.sub(
        r"\\ifdim\\width>|\$[^$]*\$|\\includegraphics\S+|\\begin\{tabular\}.*", "", plain
    )
    assert "&" not in re.sub(r"^.*\\\\$", "", outside, flags=re.M)
    assert not SPECIAL.findall(outside)


def code_of(path: str) -> str:
    """The code of a valid notebook."""
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    return "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "code")


# What every format says


@pytest.mark.parametrize("run", ["one", "both", "chirp.csv", "rig.csv"])
def test_every_format_begins_with_the_answer(run, here, undrawn):
    pages = {kind: ex.report(run, f"r.{kind}") for kind in FORMATS}
    first_cells = [cell["source"] for cell in json.loads(pages["ipynb"])["cells"][:3]]
    beginnings = {
        "html": pages["html"].partition("<h3>")[0],
        "md": pages["md"].partition("## ")[0],
        "tex": pages["tex"].partition(r"\subsection")[0],
        "ipynb": "".join(line for lines in first_cells for line in lines),
    }
    shown = {"html": escape, "md": markdown.text, "tex": latex.text, "ipynb": markdown.text}
    for kind, page in pages.items():
        assert Path(f"r.{kind}").read_text("utf-8") == page
        for sentence in sentences(run):
            assert shown[kind](sentence) in beginnings[kind]


def test_tables_are_those_of_the_command_line(here, undrawn):
    tables = shown(ex.report(["one", "bench"], "r.md")).tables
    header, *rows = next(t for t in tables if t[0][0] == "symbol")
    assert header[:3] == ["symbol", "unit", "estimate"]
    assert rows == [parameter_cells(n, p) for n, p in estimate(here / "one").params.items()]
    header, rows = finished_table(here / "bench").cells()
    assert [header, *rows] in tables
    page = ex.report("bench", "r.tex")
    assert_is_latex(page)
    for row in rows:
        assert all(latex.text(cell) in page for cell in row)


@pytest.mark.parametrize(("kind", "ending"), [("md", ".svg"), ("tex", ".pdf")])
def test_figures_are_files_and_have_captions(kind, ending, here):
    page = ex.report(["both", "bench", "rig.csv"], f"r.{kind}")
    named = re.findall(r"[({](r_files/[\w-]+\.\w+)[)}]", page)
    assert sorted(named) == sorted(str(f) for f in Path("r_files").iterdir())
    assert len(named) == len(set(named)) > 8
    assert {Path(name).suffix for name in named} == {ending}
    begins = {".svg": b"<?xml", ".pdf": b"%PDF"}[ending]
    assert all(Path(name).read_bytes().startswith(begins) for name in named)
    assert page.count("prbs.csv: measured and simulated output, residual, and parameters.") > 0


@pytest.mark.parametrize("kind", ["md", "tex", "ipynb"])
def test_the_same_runs_make_the_same_files(kind, here):
    for name in ("a", "b"):
        Path(name).mkdir()
        ex.report(["rig.csv", "bench"], f"{name}/r.{kind}")
    assert contents(Path("a")) == contents(Path("b"))


def test_a_notebook_reads_the_runs_and_draws_their_figures(here, monkeypatch):
    drawn = []

    def remembered(*given: Any, **options: Any) -> Any:
        drawn.append(given)
        return new_figure(*given, **options)

    monkeypatch.setattr("excite.report.figures.new_figure", remembered)
    Path("sub").mkdir()
    ex.report(["one", "both", "bench", "rig.csv"], "sub/r.ipynb")
    monkeypatch.chdir("sub")
    drawn.clear()
    names: dict[str, Any] = {}
    exec(code_of("r.ipynb"), names)  # what a kernel would do, in the folder of the notebook
    assert len(drawn) == 8  # two fits and a test of each residual, two correlations, errors
    assert names["result"] == estimate(here / "both")
    assert names["table"] == finished_table(here / "bench")
    assert np.array_equal(names["record"].outputs, ex.read_record(here / "rig.csv").outputs)


# Nothing in a file is obeyed


@pytest.mark.parametrize("hostile", HOSTILE)
def test_a_name_that_is_code_is_shown_and_not_obeyed(hostile, here, undrawn):
    words = ("J_p", "nls", "kg m²", *read(Path("one/estimate.json"))["verdict"])
    renamed(Path("one/estimate.json"), *words, new="harmless")
    renamed(Path("one/record.json"), "chirp", new="harmless")
    tags = shown(ex.report("one", "harmless.md")).tags
    for name in ("estimate", "record"):
        renamed(Path(f"one/{name}.json"), "harmless", new=hostile)
    seen = shown(ex.report("one", "r.md"))
    assert seen.tables[0][1][:2] == [hostile, hostile]
    assert hostile in seen.words  # the sentence of the verdict
    assert seen.tags == tags
    page = ex.report("one", "r.tex")
    assert_is_latex(page)
    assert latex.text(hostile) in page
    assert r"\input" not in page
    ex.report("one", "r.ipynb")
    assert hostile not in code_of("r.ipynb")


ODD = Table(["", "a_b"], [["[x]", "-1"], ["*y", "J_p -- ±2 %"]])


def document(*body: Element) -> Document:
    return Document([Section("Title", Path("run"), body, "")], [])


def test_every_element_is_markdown():
    page = markdown_page(
        document(
            Paragraph("1000. is no list"), Bullets([]), Bullets(["- one", "#two"]),
            Facts([("a", "b")]), ODD, Code("excite x\n`y`"),
            Figure(new_figure(1)[0], "run1-a", "A*"),
        ),
        "my r_files",
    )  # fmt: skip
    for line in (r"1000\. is no list", r"- \- one", r"- \#two", "- a: b", "    `y`",
                 r"![A\*](my%20r_files/run1-a.svg)", r"*A\**"):  # fmt: skip
        assert line in page.splitlines()
    seen = shown(page)
    assert seen.tables[0] == [["", "a_b"], ["[x]", "-1"], ["*y", "J_p -- ±2 %"]]
    assert {"1000. is no list", "- one", "#two", "A*", "excite x\n`y`\n"} <= set(seen.words)


def test_a_character_that_the_fonts_do_not_have_is_shown_by_its_number():
    assert latex.text("K_pu λ 中\x07 Ä") == r"$K_{pu}$ $\lambda$ [U+4E2D][U+0007] Ä"


def test_every_element_is_latex():
    page = latex_page(
        document(Bullets([]), Facts([("[a]", "[b]")]), ODD, Code("a --b 'c'\nd")), "r"
    )
    assert_is_latex(page)
    assert r"{}[x] & $-$1 \\" in page
    assert r"{}*y & $J_{p}$ -{}- $\pm$2 \% \\" in page
    assert r"\item[{[a]}]{} [b]" in page
    assert r"a -{}-b \textquotesingle{}c\textquotesingle{}" "\n\nd" in page
    assert "itemize" not in page


def test_a_large_table_is_continued_in_others_that_fit_a_page():
    header = ["method", "estimator", *(f"column {i}" for i in range(20))]
    rows = [[f"m{k}", "nls", *(f"{k}.{i:05}" for i in range(20))] for k in range(130)]
    prose = Table(["name", "what"], [["a", "some words " * 30]])
    page = latex_page(document(Table(header, rows), prose), "r")
    assert_is_latex(page)
    *parts, last = re.findall(r"\\begin\{tabular\}.*?\\end\{tabular\}", page, re.S)
    lines = [[line for line in part.splitlines() if line.endswith(r"\\")] for part in parts]
    assert max(len(line) for part in lines for line in part) < 130
    assert max(map(len, lines)) < 60
    assert all(part[0].startswith("method & estimator & ") for part in lines)
    assert {cell for row in rows for cell in row} <= {
        cell for part in lines for line in part for cell in line[:-3].split(" & ")
    }
    assert r"p{" in last


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="needs pdflatex")
def test_a_document_can_be_compiled(here):
    renamed(Path("one/record.json"), "chirp", new=" ".join(HOSTILE))
    ex.report(["one", "bench", "rig.csv"], "a_b.tex")
    words = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "a_b.tex"]
    log = subprocess.run(words, capture_output=True, check=False)
    assert log.returncode == 0, log.stdout[-2000:]
    assert b"Overfull" not in log.stdout


# Bad input: one sentence, exit code 2, nothing written


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("--out r.pdf", "r.pdf: reports end in .html, .md, .tex, .ipynb"),
        ("--out r", "r: reports end in"),
        ("--out r.md --format html", "r.md ends in .md, but the format is html"),
        ("--out r.md --format word", "unknown format 'word' (there is html, md, tex, ipynb)"),
        ("--out old.md", "old.md exists"),
        ("--out kept.md", "kept_files has figures; choose another name or add --overwrite"),
        ("--out mine.md --overwrite", "mine_files has other files (notes.txt)"),
        ("--out file.tex --overwrite", "file_files is no folder of a report's figures"),
        ("--out a%.tex", "LaTeX finds no figures"),
    ],
)
def test_a_report_that_may_not_be_written_is_one_sentence(words, sentence, here, capsys):
    Path("old.md").write_text("mine")
    Path("file_files").write_text("mine")
    for name in ("mine_files/notes.txt", "kept_files/run1-in1.svg"):
        Path(name).parent.mkdir()
        Path(name).write_text("mine")
    refused("report", "one", *words.split(), sentence=sentence, capsys=capsys)


def test_without_a_file_there_are_no_figures_beside_it(made, undrawn):
    for kind in ("md", "tex"):
        with pytest.raises(ValueError, match="needs out"):
            ex.report(made / "chirp.csv", format=kind)
    assert json.loads(ex.report(made / "chirp.csv", format="ipynb"))["nbformat"] == 4
    assert ex.report(made / "chirp.csv", format="html") == ex.report(made / "chirp.csv")


def test_formats_share_a_folder_and_replace_only_their_own_figures(here, capsys, undrawn):
    assert excite("report", "both", "--out", "r.md") == 0
    assert excite("report", "rig.csv", "--out", "r.tex", "--json") == 0
    told = json.loads(capsys.readouterr().out.rpartition("\n{")[2].join(["{", ""]))
    assert told["figures"] == "r_files"
    names = {file.name for file in Path("r_files").iterdir()}
    assert {"run1-fit2.svg", "run1-in.pdf"} <= names
    assert excite("report", "rig.csv", "--out", "r.md", "--overwrite") == 0
    assert {file.name for file in Path("r_files").iterdir()} == {"run1-in.svg", "run1-in.pdf"}


def test_a_disk_that_is_full_leaves_nothing(here, monkeypatch):
    before, write = contents(Path()), Path.write_bytes

    def full(path: Path, content: bytes) -> int:
        if path.suffix == ".md":
            raise OSError(28, "No space left on device")
        return write(path, content)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(ValueError, match=r"r\.md: cannot be written \(No space left on device\)"):
        ex.report("rig.csv", "r.md")
    assert contents(Path()) == before
    assert not Path("r_files").exists()


# Answers


def levelled(here: Path, warning: float | None, critical: float | None) -> PlantDescription:
    sidecar = read(here / "chirp.json")
    sidecar["plant"]["outputs"][0] |= {"warning_level": warning, "critical_level": critical}
    return PlantDescription.from_dict(sidecar["plant"])


@pytest.mark.parametrize(
    ("warning", "critical", "told"),
    [
        (None, None, "No output has a safety level."),
        (8.0, 9.0, "stayed below its warning level (458.4 deg): its largest value is 13.9 deg"),
        (None, 9.0, "stayed below its critical level (515.7 deg): its largest"),
        (0.1, 9.0, "reached its warning level (5.73 deg) after {:.4g} s and stayed below its crit"),
        (0.05, 0.1, "reached its critical level (5.73 deg) after {:.4g} s: its largest value"),
    ],
)
def test_a_record_is_answered_by_the_level_it_reached_and_when(warning, critical, told, made):
    record = ex.read_record(made / "chirp.csv")
    over = np.flatnonzero(np.abs(record.outputs[:, 0]) >= 0.1)[0]
    (sentence,) = told_of_record(levelled(made, warning, critical), record)
    assert told.format(record.time[over]) in sentence


def test_a_record_of_a_rig_is_answered_by_its_end(made):
    record = ex.read_record(made / "rig.csv")
    *_, ended = told_of_record(record.description, record)
    assert ended == "The experiment ended after 10 s: complete."


def changed(result: EstimateSummary, **values: object) -> tuple[str, ...]:
    return told_of_identification(result.model_copy(update=values))


def test_an_identification_is_answered_by_its_parameters_and_whether_to_believe_them(made):
    result = estimate(made / "one")
    first, second = told_of_identification(result)
    for name, p in result.params.items():
        half = 100 * (p.ci95[1] - p.estimate) / p.estimate
        assert f"{name} = {parameter_cells(name, p)[2]} {p.unit} ± {half:.2g} %" in first
    assert f"The plant fits pitch by {result.fit_percent['pitch']:.2f} %; the tests" in second
    assert second.endswith("no reason to doubt the intervals.")
    more = changed(result, verdict=(*result.verdict, "something else"))[1]
    assert more.endswith("no reason to doubt the intervals, but read what can be identified.")
    ahead = changed(result, prediction_fit_percent={"pitch": 12.34})[1]
    assert ahead.startswith("One step ahead, the plant fits pitch by 12.34 %")
    wrong, coloured = {"pitch": 1e-9}, {"pitch": 1e-9}
    doubted = changed(result, structure_p_value=wrong, misfit_factor=3.0)[1]
    assert "follows the input" in doubted
    assert "doubted; the intervals are 3 times as wide" in doubted
    assert "is not white" in changed(result, whiteness_p_value=coloured)[1]
    nothing = {"pitch": float("nan")}
    untested = changed(result, whiteness_p_value=nothing, structure_p_value=nothing)[1]
    assert "too small or too short" in untested
    held = result.params["D_p"].model_copy(update={"held": True})
    assert (
        "; D_p is held, not estimated." in changed(result, params=result.params | {"D_p": held})[0]
    )
    (none,) = changed(result, status="not finite", verdict=("the simulation diverged",))
    assert none == "There is no estimate (not finite): the simulation diverged."
    assert "(held out: " in told_of_identification(estimate(made / "both"))[1]
