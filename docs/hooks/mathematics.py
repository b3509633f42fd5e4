"""Equations as MathML: `$...$` and `$$...$$` are translated when the site is built.

A browser sets MathML without a script, so that the site needs no network. GitHub sets the same
source itself.
"""

import re
from html import unescape
from typing import Any

from latex2mathml.converter import convert

# What pymdownx.arithmatex makes of a formula, with `generic: true`.
_FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\s*\\[(\[](?P<latex>.*?)\\[)\]]\s*</(?P=tag)>', re.S
)


def on_page_content(html: str, **_: Any) -> str:
    """Every formula of a page as MathML."""
    return _FORMULA.sub(_mathml, html)


def _mathml(found: re.Match[str]) -> str:
    display = "block" if found["tag"] == "div" else "inline"
    formula = convert(unescape(found["latex"]).strip(), display=display)
    return formula if display == "inline" else f'<div class="equation">{formula}</div>'
