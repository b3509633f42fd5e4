r"""A report as a LaTeX document; its figures are files.

A table that does not fit the page is continued in another one, so that each is a `tabular` that
can be copied into a paper.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence

from .. import __version__
from . import content
from .content import Document, Element
from .tables import PROSE, fitting_tables

_WIDTH = 120  # characters of a line in small print
_SURE = 90  # of them that are narrower than a page in any font
_LEAST = 20  # of them for a column of prose
_LINES = 56  # of small print on a page
_PREAMBLE = r"""\documentclass[a4paper]{article}
\usepackage[T1]{fontenc}
\IfFileExists{lmodern.sty}{\usepackage{lmodern}}{}
\usepackage[margin=2.2cm]{geometry}
\usepackage{array,booktabs,float,graphicx}
\setlength{\parindent}{0pt}
\setlength{\parskip}{0.7ex}
\setlength{\tabcolsep}{4pt}
\setlength{\belowcaptionskip}{5pt}
\sloppy
\begin{document}
"""
_TO_THE_PAGE = r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{"

_PLAIN = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "%": r"\%",
    "#": r"\#", "_": r"\_", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", "`": r"\textasciigrave{}",
    "–": r"\textendash{}", "—": r"\textemdash{}", "…": r"\dots{}",
    "‘": r"\textquoteleft{}", "’": "'", "„": r"\quotedblbase{}",
    "“": r"\textquotedblleft{}", "”": r"\textquotedblright{}",
}  # fmt: skip
_SMALL = (
    "alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi pi rho varsigma "
    "sigma tau upsilon phi chi psi omega"
)
_LARGE = "Gamma Delta Theta Lambda Xi Pi Sigma Upsilon Phi Psi Omega"
_GREEK = zip("αβγδεζηθικλμνξπρςστυφχψωΓΔΘΛΞΠΣΥΦΨΩ", f"{_SMALL} {_LARGE}".split(), strict=True)
_MATHS = {letter: f"\\{word}" for letter, word in _GREEK} | {
    "±": r"\pm", "×": r"\times", "÷": r"\div", "·": r"\cdot", "−": "-", "²": "^2", "³": "^3",
    "°": r"^\circ", "µ": r"\mu", "∞": r"\infty", "≤": r"\leq", "≥": r"\geq", "≈": r"\approx",
    "→": r"\to", "√": r"\surd", "∂": r"\partial", "∑": r"\sum",
}  # fmt: skip
_NOT_THERE = "ħĸĿŀſ"  # of the letters up to U+017F


def latex_page(document: Document, folder: str) -> str:
    """A report as a LaTeX document.

    Args:
        document: what it says.
        folder: of its figures, `NAME.pdf`, from the place of the document.
    """
    blocks = [rf"\section*{{\LARGE {text(document.title)}}}"]
    for title, body in document.beside:
        blocks += [rf"\section*{{{text(title)}}}", *_blocks(body, folder)]
    several = len(document.sections) > 1
    for title, section in zip(document.titles, document.sections, strict=True):
        blocks += [rf"\clearpage\section*{{{text(title)}}}"] * several
        blocks += [rf"\emph{{{text(section.name)}}}", *_blocks(section.body, folder)]
    made = f"% Made by excite {__version__}; for pdflatex or lualatex."
    return "\n".join([made, _PREAMBLE + "\n\n".join(blocks), r"\end{document}"]) + "\n"


def text(value: str) -> str:
    """Text that LaTeX sets as it is, with symbols such as K_pu as mathematics.

    A character that its usual fonts do not have is shown by its number.
    """
    minus = re.sub(r"(?<![\w.-])-(?=\.?\d)", "$-$", _escaped(value))
    return re.sub(r"(?<![\w\\])([A-Za-z])\\_([A-Za-z0-9]{1,3})(?![\w\\])", r"$\1_{\2}$", minus)


def _escaped(value: str) -> str:
    characters = "".join(map(_character, " ".join(value.split())))
    return re.sub("(?<=-)-", "{}-", characters)  # no dash in place of two hyphens


def _character(letter: str) -> str:
    if letter in _MATHS:
        return f"${_MATHS[letter]}$"
    if letter in _PLAIN:
        return _PLAIN[letter]
    if " " <= letter <= "~" or ("¡" <= letter <= "ſ" and letter not in _NOT_THERE):
        return letter
    return f"[U+{ord(letter):04X}]"


def _blocks(parts: Iterable[Element], folder: str) -> list[str]:
    return [block for part in parts if (block := _element(part, folder))]


def _element(part: Element, folder: str) -> str:
    """One element; empty where it says nothing."""
    match part:
        case content.Answer(lines):
            return "\n\n".join(map(text, lines))
        case content.Heading(words):
            return rf"\subsection*{{{text(words)}}}"
        case content.Paragraph(words):
            return text(words)
        case content.Notes(lines):
            small = "\n\n".join(map(text, lines))
            return rf"{{\footnotesize {small}\par}}"
        case content.Bullets(items):
            return _list("itemize", [rf"\item{_begun(item)}" for item in items])
        case content.Facts(pairs):
            items = [rf"\item[{{{text(name)}}}]{_begun(value)}" for name, value in pairs]
            return _list("description", items)
        case content.Table():
            return "\n\n".join(_tables(part))
        case content.Figure(_, name, caption):
            size = r"width=\linewidth,height=0.8\textheight,keepaspectratio"
            shown = rf"\includegraphics[{size}]{{{folder}/{name}.pdf}}"
            return _float("figure", [r"\centering", shown, rf"\caption{{{text(caption)}}}"])
        case content.Code(lines):
            typed = "\n\n".join(map(_escaped, lines.splitlines()))
            typed = typed.replace("'", r"\textquotesingle{}")
            return rf"{{\raggedright\ttfamily {typed}\par}}"
        case content.Folded(summary, body):
            return "\n\n".join([rf"\subsubsection*{{{text(summary)}}}", *_blocks(body, folder)])


def _float(kind: str, lines: Iterable[str]) -> str:
    return "\n".join([rf"\begin{{{kind}}}[H]", *lines, rf"\end{{{kind}}}"])


def _list(kind: str, items: Sequence[str]) -> str:
    if not items:
        return ""
    near = r"\setlength{\itemsep}{0pt}\setlength{\parsep}{0pt}"
    return "\n".join([rf"\begin{{{kind}}}{near}", *items, rf"\end{{{kind}}}"])


def _tables(table: content.Table) -> Iterator[str]:
    """A table as one or several of a page's width and height at most."""
    title = table.title[:1].upper() + table.title[1:]
    caption = f"{title}. {table.caption}".strip() if table.caption else f"{title}."
    repeated = table.labels if table.labels < len(table.header) else 1
    for header, rows in fitting_tables(table.header, table.rows, _WIDTH, repeated):
        widths = _widths(header, rows)
        kinds = ["l"] * table.labels + ["r"] * len(header)
        columns = "".join(_prose(w) if w else k for k, w in zip(kinds, widths, strict=False))
        longest = sum(2 + max(map(len, column)) for column in zip(header, *rows, strict=True))
        begin, end = (_TO_THE_PAGE, "}") if longest > _SURE else ("", "")
        for part in _pages(rows, widths):
            lines = [rf"\caption{{{text(caption)}}}", r"\centering\footnotesize"]
            lines += [rf"{begin}\begin{{tabular}}{{{columns}}}", r"\toprule"]
            lines += [_row(header), r"\midrule"] * any(header)
            lines += [*map(_row, part), r"\bottomrule", rf"\end{{tabular}}{end}"]
            yield _float("table", lines)
            caption = f"{title}, continued."


def _prose(width: int) -> str:
    """A column of prose."""
    return rf">{{\raggedright\arraybackslash}}p{{{width / _WIDTH:.2f}\linewidth}}"


def _row(cells: Sequence[str]) -> str:
    line = " & ".join(map(text, cells))
    return ("{}" * line.startswith(("[", "*"))) + line + r" \\"  # no argument of the line before


def _begun(value: str) -> str:
    """Text after a command, which could take its beginning for an argument."""
    return f"{{}} {text(value)}"


def _widths(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[int]:
    """Characters of the columns of prose, whose cells are broken into lines; 0 of the others."""
    widest = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    is_prose = [size > PROSE for size in widest]
    left = _WIDTH - sum(
        2 + size * (not prose) for size, prose in zip(widest, is_prose, strict=True)
    )
    whole = sum(size for size, prose in zip(widest, is_prose, strict=True) if prose)
    return [
        prose * min(size, max(_LEAST, left * size // (whole or 1)))
        for size, prose in zip(widest, is_prose, strict=True)
    ]


def _pages(
    rows: Sequence[Sequence[str]], widths: Sequence[int]
) -> Iterator[Sequence[Sequence[str]]]:
    """Rows in groups that fit a page."""
    page, used = [], 0
    for row in rows:
        needed = max(-(-len(c) // w) if w else 1 for c, w in zip(row, widths, strict=True))
        if page and used + needed > _LINES:
            yield page
            page, used = [], 0
        page.append(row)
        used += needed
    yield page
