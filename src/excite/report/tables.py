"""Tables as plain text, HTML, Markdown, CSV and LaTeX, and the cells in them."""

from __future__ import annotations

import csv
import html
import io
import math
import re
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..description import RARE
from ..files import csv_text
from .numbers import digits_for, mean_sd, number

Table = tuple[list[str], list[list[str]]]
"""Column titles and rows."""

_PROSE = 40  # characters from which the cells of a column are broken into lines


def text_table(
    title: str,
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    width: int = 80,
    labels: int = 1,
) -> str:
    """A table as plain text, no line of it wider than `width` where that can be.

    A table that is too wide continues below, its first columns repeated. Lines are broken
    between words only, never inside an interval such as `0.0249998 ± 2.8e-7`.

    Args:
        title: first line; none where empty.
        header: column titles; no line of titles where all are empty.
        labels: how many columns begin every part of a table that is continued below.
    """
    parts = fitting_tables(header, rows, width, labels)
    text = "\n\n".join("\n".join(_lines(names, cells, width)) for names, cells in parts)
    return f"{title}\n{text}" if title else text


def _lines(header: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> list[str]:
    """One table, first column and prose to the left, the rest to the right."""
    columns = list(zip(header, *rows, strict=True))
    widths, least = [max(map(len, c)) for c in columns], list(map(_least_width, columns))
    is_left = [i == 0 or max(map(len, c[1:]), default=0) > _PROSE for i, c in enumerate(columns)]
    while sum(widths) + 2 * (len(widths) - 1) > width and widths != least:
        widths[max(range(len(widths)), key=lambda i: (widths[i] > least[i], widths[i]))] -= 1

    def lines(row: Sequence[str]) -> list[str]:
        cells = [_wrapped(cell, w) for cell, w in zip(row, widths, strict=True)]
        filled = [cell + [""] * (max(map(len, cells)) - len(cell)) for cell in cells]
        return [
            "  ".join(
                text.ljust(w) if left else text.rjust(w)
                for text, w, left in zip(line, widths, is_left, strict=True)
            ).rstrip()
            for line in zip(*filled, strict=True)
        ]

    rule = "─" * (sum(widths) + 2 * (len(widths) - 1))
    head = [*lines(header), rule] if any(header) else []
    return [*head, *(line for row in rows for line in lines(row))]


def _words(cell: str) -> str:
    """A cell whose intervals are glued: `3 ± 1` and `3 to 4` are one word."""
    return re.sub(r"(?<=[\d–]) (±|to) (?=[-\d–])", "\N{NO-BREAK SPACE}\\1\N{NO-BREAK SPACE}", cell)


def _wrapped(cell: str, width: int) -> list[str]:
    lines = textwrap.wrap(
        _words(cell), max(width, 1), break_long_words=False, break_on_hyphens=False
    )
    return [line.replace("\N{NO-BREAK SPACE}", " ") for line in lines] or [""]


def _least_width(column: Sequence[str]) -> int:
    """Characters that a column needs: all of its cells, or of prose some words a line."""
    widest = max(map(len, column))
    if widest <= _PROSE:
        return widest
    return min(
        widest, max(_PROSE // 2, *(len(w) for cell in column for w in _words(cell).split(" ")))
    )


def fitting_tables(
    header: Sequence[str], rows: Sequence[Sequence[str]], width: int, labels: int = 2
) -> list[Table]:
    """A table as several below each other, none wider than `width` where that can be.

    Each begins with the first `labels` columns; a bound stays beside its error.
    """
    needed = [2 + _least_width(column) for column in zip(header, *rows, strict=True)]
    first = list(range(labels))
    tables = [first]
    for i in range(labels, len(header)):
        if header[i] == "bound %":
            continue
        group = [i, i + 1] if header[i + 1 : i + 2] == ["bound %"] else [i]
        if tables[-1] != first and sum(needed[c] for c in tables[-1] + group) > width + 2:
            tables.append(first)
        tables[-1] = tables[-1] + group
    return [([header[c] for c in t], [[row[c] for c in t] for row in rows]) for t in tables]


def html_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table as HTML, for a notebook."""

    def line(tag: str, cells: Sequence[str]) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(c)}</{tag}>" for c in cells) + "</tr>\n"

    caption = f"<caption>{html.escape(title)}</caption>\n" if title else ""
    head = f"<thead>{line('th', header)}</thead>\n" if any(header) else ""
    body = "".join(line("td", row) for row in rows)
    return f"<table>\n{caption}{head}<tbody>\n{body}</tbody></table>\n"


def table_header(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Column titles of a benchmark table."""
    largest = rows[0]["max_abs_output"]
    header = ["method", "estimator"]
    for name in rows[0]["relative_error_percent"]:
        header += [f"{name} error %", "bound %"]
    header += [f"max {largest['output']} {largest['unit']}", "violations (95 %)", "failed"]
    header += _rig_cells(rows[0]).keys()
    header += ["log det"] if "log_det_information" in rows[0] else []
    header += ["D-efficiency"] if "d_efficiency" in rows[0] else []
    return [*header, "viable seeds", "training"] if "seeds" in rows[0] else header


def table_cells(row: Mapping[str, Any]) -> list[str]:
    """The cells of one row, errors and magnitudes as mean ± standard deviation."""
    cells = [row["method"], row["estimator"]]
    for name, error in row["relative_error_percent"].items():
        text = mean_sd(error["mean"], error["sd"])
        if row.get("viable_seeds") != row.get("seeds"):
            every = error["all_seeds"]
            text += f" (all seeds: {mean_sd(every['mean'], every['sd'])})"
        cells += [text, number(row["cramer_rao_percent"][name], 2)]
    low, high = row["violation_rate"]["ci95"]
    count = f"{row['violations']}/{row['evaluations']} ({100 * low:.1f}–{100 * high:.1f} %)"
    largest = row["max_abs_output"]
    failed = f"{row['failed']}/{row['evaluations']}"
    cells += [mean_sd(largest["mean"], largest["sd"]), count, failed, *_rig_cells(row).values()]
    if "log_det_information" in row:
        cells.append(number(row["log_det_information"], 4))
    if "d_efficiency" in row:
        cells.append(number(row["d_efficiency"], 2))
    return [*cells, *_training_cells(row)] if "seeds" in row else cells


def _rig_cells(row: Mapping[str, Any]) -> dict[str, str]:
    """What happened on a simulated rig, by the column's title; nothing without one."""
    seen, count = row.get("on_rig"), row["evaluations"]
    if seen is None:
        return {}
    cells = {"trips": f"{seen['trips']}/{count}"}
    if "interventions" in seen:
        cells["violations, filter"] = f"{seen['filtered_violations']}/{count}"
        cells["trips, filter"] = f"{seen['filtered_trips']}/{count}"
        cells["interventions"] = f"{number(seen['interventions'] / count)} an experiment"
    return cells


def _training_cells(row: Mapping[str, Any]) -> list[str]:
    """Viable seeds and training time; dashes for a method that is not trained."""
    if row["seeds"] is None:
        return ["–", "–"]
    minutes = row["train_seconds"] / 60 / row["seeds"]
    return [f"{row['viable_seeds']}/{row['seeds']}", f"{number(minutes, 2)} min a seed"]


def reference_cells(row: Mapping[str, Any], reference: Mapping[str, Any]) -> list[str]:
    """A published row in the columns of the method's own `row`."""
    cells = [row["method"], "as published"]
    for name in row["relative_error_percent"]:
        published = reference["relative_error_percent"].get(name)
        cells += ["–" if published is None else mean_sd(*published), "–"]
    cells += [mean_sd(*reference["max_abs_output"]), reference["violations"], "–"]
    cells += ["–"] * len(_rig_cells(row))
    cells += ["–"] * sum(key in row for key in ("log_det_information", "d_efficiency"))
    return [*cells, reference.get("viable_seeds") or "–", "–"] if "seeds" in row else cells


def all_cells(
    rows: Sequence[Mapping[str, Any]], reference: Mapping[str, Mapping[str, Any]]
) -> list[list[str]]:
    """All rows of a table, after each method's the published one, if there is one."""
    cells = []
    for i, row in enumerate(rows):
        cells.append(table_cells(row))
        is_last = i + 1 == len(rows) or rows[i + 1]["method"] != row["method"]
        if is_last and row["method"] in reference:
            cells.append(reference_cells(row, reference[row["method"]]))
    return cells


def footnotes(study: Mapping[str, Any]) -> list[str]:
    """What a reader of the table must know."""
    notes = [
        "Errors are relative errors in percent, mean ± standard deviation over the estimates "
        "that did not fail. The bound is the mean Cramér-Rao bound of the same data, a standard "
        "deviation: the mean error of an efficient estimator is 0.80 of it.",
    ]
    if study.get("agents"):
        notes.append(
            f"Agents: cross-seed mean ± standard deviation of the mean errors of {study['seeds']} "
            f"training seeds, {study['episodes']} evaluation episodes each, over viable seeds (a "
            "seed has collapsed where the RMS input is below 1 % of its limit); violations and "
            "failures over all evaluations of all seeds. The policy is evaluated without "
            "exploration noise."
        )
    if study.get("clairvoyant"):
        count = min(study["clairvoyant"]["plants"], study["episodes"])
        notes.append(
            "log det is that of the relative Fisher information. The D-efficiency compares it, on "
            f"the first {count} plants, with signals designed for each plant as if its parameters "
            "were known: 1 is what no experiment can beat."
        )
    if study.get("rig"):
        notes.append(
            "Experiments were made on the plant's simulated rig, with its latency and jitter, "
            "watched by the supervisor; one that it ended (a trip) has no estimate. Columns with "
            "a filter are of the same experiments behind the predictive safety filter."
        )
    if study.get("ours"):
        notes.append("Ours, other than the source: " + "; ".join(study["ours"]) + ".")
    if study.get("reference"):
        notes.append(f"Published rows: {study['source']}.")
    if study.get("inferred"):
        notes.append("Inferred, not stated by the source: " + "; ".join(study["inferred"]) + ".")
    return notes


def benchmark_markdown(rows: Sequence[Mapping[str, Any]], study: Mapping[str, Any]) -> str:
    """The table as Markdown, with its footnotes."""
    header = table_header(rows)
    lines = [f"# {study.get('title') or study['name']}", ""]
    lines += ["| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
    lines += ["| " + " | ".join(c) + " |" for c in all_cells(rows, study.get("reference", {}))]
    lines += [line for note in footnotes(study) for line in ("", note)]
    return "\n".join(lines) + "\n"


def benchmark_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """The table as CSV, numbers unrounded."""
    text = {"method": [r["method"] for r in rows], "estimator": [r["estimator"] for r in rows]}
    columns: dict[str, list[float]] = {
        key: [row[key] for row in rows] for key in ("evaluations", "failed", "violations")
    }
    for key in ("viable_seeds", "seeds", "train_seconds"):
        if key in rows[0]:
            columns[key] = [math.nan if row[key] is None else row[key] for row in rows]
    for key in rows[0].get("on_rig", {}):
        columns[key] = [row["on_rig"][key] for row in rows]
    for key in ("log_det_information", "log_det_information_sd", "d_efficiency"):
        if key in rows[0]:
            columns[key] = [row.get(key, math.nan) for row in rows]
    largest = rows[0]["max_abs_output"]
    for part in ("mean", "sd"):
        title = f"max_abs_{largest['output']}_{largest['unit']}_{part}"
        columns[title] = [row["max_abs_output"][part] for row in rows]
    for name in rows[0]["relative_error_percent"]:
        for part in ("mean", "sd", "median", "rms"):
            columns[f"{name}_error_percent_{part}"] = [
                row["relative_error_percent"][name][part] for row in rows
            ]
        if "seeds" in rows[0]:
            for part in ("mean", "sd"):
                columns[f"{name}_error_percent_all_seeds_{part}"] = [
                    row["relative_error_percent"][name].get("all_seeds", {}).get(part, math.nan)
                    for row in rows
                ]
        columns[f"{name}_cramer_rao_percent"] = [row["cramer_rao_percent"][name] for row in rows]
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    numbers = csv.reader(csv_text(columns).splitlines())
    labels = [["method", "estimator"], *zip(text["method"], text["estimator"], strict=True)]
    writer.writerows([*pair, *values] for pair, values in zip(labels, numbers, strict=True))
    return buffer.getvalue()


def benchmark_latex(rows: Sequence[Mapping[str, Any]], study: Mapping[str, Any]) -> str:
    """The table as LaTeX (booktabs), its footnotes as comments."""
    header = table_header(rows)
    lines = [f"% {note}" for note in footnotes(study)]
    lines += [r"\begin{tabular}{ll" + "r" * (len(header) - 2) + "}", r"\toprule"]
    lines += [_latex_row(header), r"\midrule"]
    lines += [_latex_row(cells) for cells in all_cells(rows, study.get("reference", {}))]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def _latex_row(cells: Sequence[str]) -> str:
    """One line of a tabular; parameters like K_pu are set as mathematics."""
    text = " & ".join(cells)
    for plain, latex in (("%", r"\%"), ("±", r"$\pm$"), ("–", "--")):
        text = text.replace(plain, latex)
    return re.sub(r"([A-Za-z])_([A-Za-z]+)", r"$\1_{\2}$", text) + r" \\"


def differences_csv(differences: Sequence[Mapping[str, Any]]) -> str:
    """Differences between methods in percent, with 95 % intervals, as CSV."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["method", "minus", "estimator", "parameter", "mean", "low", "high", "seeds"])
    for pair in differences:
        for name, gap in pair["relative_error_percent"].items():
            where = [pair["method"], pair["minus"], pair["estimator"], name]
            writer.writerow([*where, gap["mean"], *gap["ci95"], gap["seeds"]])
    return buffer.getvalue()


def differences_markdown(differences: Sequence[Mapping[str, Any]]) -> str:
    """Differences in the errors of the study's first estimator, as a section of its table."""
    if not differences:
        return ""
    header, cells = differences_cells(differences)
    lines = [f"## Differences, {differences[0]['estimator']}", "", DIFFERENCES, ""]
    lines += ["| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
    lines += ["| " + " | ".join(row) + " |" for row in cells]
    return "\n".join(["", *lines]) + "\n"


DIFFERENCES = (
    "Mean error of the first method minus that of the second, in points of percent, with "
    "the 95 % interval over the seeds; plants and noise are common to both."
)


def differences_cells(
    differences: Sequence[Mapping[str, Any]],
) -> tuple[list[str], list[list[str]]]:
    """Column titles and rows of the differences in the errors of the study's first estimator."""
    first, names = differences[0]["estimator"], list(differences[0]["relative_error_percent"])
    chosen = [pair for pair in differences if pair["estimator"] == first]
    return ["method", "minus", *names], [
        [p["method"], p["minus"], *(_gap(p["relative_error_percent"][n]) for n in names)]
        for p in chosen
    ]


def _gap(gap: Mapping[str, Any]) -> str:
    low, high = gap["ci95"]
    return f"{number(gap['mean'])} ({number(low)} to {number(high)})"


def parameter_header() -> list[str]:
    """Column titles of a table of estimates."""
    return ["symbol", "unit", "estimate", "standard error", "95 % interval", "relative to nominal"]


def parameter_cells(name: str, param: Mapping[str, Any]) -> list[str]:
    """One estimate as `estimate.json` has it, to two digits of its error."""
    relative = param["relative_to_nominal"]
    relative = "–" if relative is None else f"{relative:.4f}"
    if param["held"]:
        estimate = f"{number(param['estimate'], 5)} (held)"
        return [name, param["unit"], estimate, "–", "–", relative]
    digits, (low, high) = digits_for(param["estimate"], param["std_error"]), param["ci95"]
    return [
        name,
        param["unit"],
        number(param["estimate"], digits),
        number(param["std_error"]),
        f"{number(low, digits)} to {number(high, digits)}",
        relative,
    ]


def residual_cells(result: Mapping[str, Any], output: str) -> list[str]:
    """Whether a residual is white and whether it follows the input, each with its p-value."""
    cells = []
    for test, words in (("whiteness", ("yes", "no")), ("structure", ("no", "yes"))):
        # Folders of before the second test do not have it.
        p = result.get(f"{test}_p_value", {}).get(output)
        if p is None or not math.isfinite(p):
            cells += ["–", "–"]
        else:
            cells += [words[p < RARE], number(p)]
    return cells


def residual_in_words(result: Mapping[str, Any], output: str) -> str:
    """The same tests as a part of a sentence."""
    white, p_white, follows, p_follows = residual_cells(result, output)
    parts = []
    if white != "–":
        parts.append(f"residual {'white' if white == 'yes' else 'not white'} (p = {p_white})")
    if follows != "–":
        word = "follows" if follows == "yes" else "does not follow"
        parts.append(f"{word} the input (p = {p_follows})")
    return ", ".join(parts) or "residual too small to be tested"


def largest_correlation(result: Mapping[str, Any]) -> str:
    """The largest correlation between two estimates, and between which."""
    names, table = list(result["params"]), np.array(result["correlation"], float)
    table = np.nan_to_num(np.triu(table, 1))
    i, j = np.unravel_index(np.argmax(np.abs(table)), table.shape)
    return f"{table[i, j]:+.3f} between {names[i]} and {names[j]}"
