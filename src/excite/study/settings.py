"""Tables of a study file: base models, and pydantic's errors as sentences."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, TypeVar

import pydantic
import tomlkit
import tomlkit.exceptions
from pydantic import BaseModel, ConfigDict, Field

from ..description import Spread, unknown
from ..policy import POLICY_ENDING
from ..record.read import SIGNAL_ENDINGS

_T = TypeVar("_T")


class Settings(BaseModel):
    """A table of a study file: keys that do not exist are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Choice(Settings):
    """One of several kinds, and its options."""

    model_config = ConfigDict(extra="allow", frozen=True)

    @property
    def options(self) -> dict[str, object]:
        """All but the kind."""
        return dict(self.model_extra or {})


Count = Annotated[int, Field(gt=0, strict=True)]
Magnitude = Annotated[float, Field(ge=0, strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, strict=True, allow_inf_nan=False)]


def _spread(value: object) -> object:
    """The value, where it is allowed; ValueError otherwise."""
    return Spread.of(value).setting  # pyright: ignore[reportArgumentType]


SpreadSetting = Annotated[float | str, pydantic.BeforeValidator(_spread)]


class EstimatorSettings(Choice):
    """One estimator: a kind and its options."""

    kind: str


def checked(
    kind: type[_T],
    values: Mapping[str, object],
    where: str,
    tables: Mapping[str, type[BaseModel]] = MappingProxyType({}),
) -> _T:
    """Settings of one kind from a table of the study; ValueError for what is not allowed."""
    fields = [f.name for f in dataclasses.fields(kind)] if dataclasses.is_dataclass(kind) else []
    fields = fields or list(getattr(kind, "model_fields", {}))
    for name in values:
        if name not in fields:
            raise unknown(f"{where} setting", name, fields)
    try:
        # As JSON, because a strict check of Python types would require tuples for lists.
        content = json.dumps(dict(values), default=str)
        return pydantic.TypeAdapter(kind).validate_json(content, strict=True)
    except pydantic.ValidationError as error:
        raise ValueError(f"{where}: {sentence(error, tables)}") from None


def read_toml(path: Path) -> dict[str, Any]:
    """The content of a TOML file; ValueError where it cannot be read."""
    try:
        return tomlkit.parse(path.read_text(encoding="utf-8")).unwrap()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"{path}: cannot be read ({reason})") from None
    except tomlkit.exceptions.ParseError as error:
        raise ValueError(f"{path}: not valid TOML: {error}") from None


def excitation_beside(folder: Path, word: str) -> str:
    """An excitation as it is written in a file of this folder: a file's name is relative to it."""
    file = folder / word
    is_file = file.suffix in (POLICY_ENDING, *SIGNAL_ENDINGS) and file.is_file()
    return str(file) if is_file else word


_ALLOWED = {
    "bool": "true or false",
    "int": "a whole number",
    "float": "a number",
    "string": "a string",
    "list": "a list",
    "tuple": "a list",
    "dict": "a table",
    "model": "a table",
}
"""The allowed type for an error of pydantic, by its first word."""


def sentence(
    error: pydantic.ValidationError, tables: Mapping[str, type[BaseModel]] = MappingProxyType({})
) -> str:
    """One of pydantic's errors as a sentence: an unknown key before a missing one.

    Args:
        tables: the settings in each table of the file, those of the file itself under "".
    """
    first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    location = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        table = str(first["loc"][0]) if len(first["loc"]) > 1 else ""
        model = tables[table if table in tables else ""]
        where, _, key = location.rpartition(".")
        return f"{where}: " * bool(where) + str(unknown("key", key, model.model_fields))
    if first["type"] == "missing":
        return f"the key {location!r} is missing"
    if first["type"] == "value_error" and "ctx" in first:  # a message of this package
        text = str(first["ctx"]["error"])
        return text if text.startswith(location) else f"{location}: {text}"
    got = json.dumps(first["input"], default=str)
    if isinstance(first["input"], float) and not math.isfinite(first["input"]):
        got = str(first["input"])
    if first["type"] == "too_short" and "ctx" in first:
        return f"{location} needs at least {first['ctx']['min_length']} in its list, got {got}"
    msg, _, rest = first["msg"].partition("Input should be ")
    kind = re.match(r"([a-z]+)_(type|parsing|from|attributes)", first["type"])
    allowed = _ALLOWED.get(kind[1], rest) if kind else rest
    if allowed == "a list" and not isinstance(first["input"], dict | list):
        allowed = f"a list such as [{got}]"
    what = f" must be {allowed}" if allowed else f": {msg}"
    return f"{location}{what}, got {got}"
