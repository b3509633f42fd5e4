"""A plant's description and a table as the page shows them."""

from __future__ import annotations

from ..description import PlantDescription, display_unit
from ..record.units import known_units
from ..report.tables import Table
from .events import ShownTable


def shown_plant(description: PlantDescription) -> dict[str, object]:
    """A description, with the display unit of each quantity and its factor."""
    data = description.to_dict()
    for part in (*data["inputs"], *data["outputs"]):
        part["shown_unit"], part["factor"] = display_unit(part["unit"])
        part["units"] = known_units(part["unit"])
    return {**data, "units_of_time": known_units("s")}


def shown_table(title: str, table: Table) -> ShownTable:
    """A table of texts."""
    return {"title": title, "header": table[0], "rows": table[1]}
