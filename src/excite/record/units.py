"""Units as words, and their factors."""

from __future__ import annotations

import math
import reprlib

_TABLES: tuple[dict[str, float], ...] = (
    {"s": 1.0, "us": 1e-6, "µs": 1e-6, "ms": 1e-3, "min": 60.0, "h": 3600.0, "d": 86400.0},
    {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "°": math.pi / 180, "rev": 2 * math.pi},
    {"rad/s": 1.0, "deg/s": math.pi / 180, "°/s": math.pi / 180, "rpm": math.pi / 30},
    {"m": 1.0, "um": 1e-6, "µm": 1e-6, "mm": 1e-3, "cm": 1e-2, "km": 1e3},
    {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "km/h": 1 / 3.6},
    {"m/s²": 1.0, "m/s^2": 1.0, "mm/s²": 1e-3, "mm/s^2": 1e-3},
    {"V": 1.0, "mV": 1e-3, "kV": 1e3},
    {"A": 1.0, "mA": 1e-3, "kA": 1e3},
    {"N": 1.0, "mN": 1e-3, "kN": 1e3},
    {"N m": 1.0, "Nm": 1.0, "mNm": 1e-3, "kNm": 1e3},
    {"W": 1.0, "mW": 1e-3, "kW": 1e3},
    {"Hz": 1.0, "kHz": 1e3},
    {"kg": 1.0, "g": 1e-3, "t": 1e3},
    {"Pa": 1.0, "mbar": 100.0, "hPa": 100.0, "kPa": 1e3, "bar": 1e5, "MPa": 1e6},
    {"m³/s": 1.0, "m^3/s": 1.0, "m³/h": 1 / 3600, "m^3/h": 1 / 3600, "l/s": 1e-3, "l/min": 1 / 6e4},
    {"degC": 1.0, "°C": 1.0},
    {"": 1.0, "1": 1.0, "-": 1.0, "%": 1e-2},
)  # fmt: skip


def unit_factor(name: str, word: str, unit: str) -> float:
    """The factor from a unit to that of a column.

        >>> from excite.record.units import unit_factor
        >>> unit_factor("position", "mm", "m")
        0.001

    Args:
        name: the column, for the message.
        word: the unit in the file.
        unit: the plant's unit.

    Raises:
        ValueError: for a word that is not known, or of another quantity.
    """
    if word == unit:
        return 1.0
    table = _table_of(unit)
    if word not in table:
        allowed = ", ".join(known or "1" for known in table)
        raise ValueError(
            f"unit {reprlib.repr(word)} of {name!r} is not allowed: the plant has it in "
            f"{unit or '1'!r}, and known are {allowed} (for another unit give a "
            f"factor with --scale {name}=FACTOR)"
        )
    return table[word] / table[unit]


def known_units(unit: str) -> list[str]:
    """The units of the same quantity, this one first."""
    return [unit, *(word for word in _table_of(unit) if word != unit)]


def _table_of(unit: str) -> dict[str, float]:
    """The factors of the units of a quantity."""
    return next((table for table in _TABLES if unit in table), {unit: 1.0})
