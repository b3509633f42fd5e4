"""Numbers as text, with the digits that their uncertainty allows."""

from __future__ import annotations

import math


def number(value: float | None, digits: int = 3) -> str:
    """A number with this number of significant digits; a dash for None."""
    if value is None or not math.isfinite(value):
        return "–"
    if value != 0 and not 1e-3 <= abs(value) < 1e5:
        return f"{value:.{digits - 1}e}"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value)))) if value else 0
    return f"{value:.{decimals}f}"


def digits_for(value: float, error: float | None) -> int:
    """Number of significant digits of a value so that two digits of its error are shown."""
    if error is None or not math.isfinite(error) or not 0 < error < abs(value):
        return 5
    return min(12, 2 + math.ceil(math.log10(abs(value) / error)))


def mean_sd(mean: float | None, sd: float | None) -> str:
    """Mean ± standard deviation."""
    return f"{number(mean)} ± {number(sd)}"
