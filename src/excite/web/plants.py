"""The description of a plant as the page shows it."""

from __future__ import annotations

from ..description import PlantDescription, display_unit
from ..record.units import known_units


def shown_plant(description: PlantDescription) -> dict[str, object]:
    """A description, with the display unit of each quantity and its factor."""
    data = description.to_dict()
    for part in (*data["inputs"], *data["outputs"]):
        part["shown_unit"], part["factor"] = display_unit(part["unit"])
        part["units"] = known_units(part["unit"])
    return {**data, "units_of_time": known_units("s")}
