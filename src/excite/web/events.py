"""What a worker is asked and tells, and what the page is told: one type for every kind of event.

They are JSON from the worker to the browser: a number that is not finite is None there.
"""

from __future__ import annotations

from typing import Literal, NotRequired, TypedDict

Numbers = dict[str, float]
"""By the name of a parameter or an output; NaN where there is none."""
Rows = list[list[float]]
"""One row a sample, one column a channel."""


class ExperimentRequest(TypedDict):
    """A simulated experiment, and the excitations to compare it with."""

    plant: str
    excitation: str
    amplitude: float | None
    noise: Numbers
    params: Numbers
    steps: int
    seed: int
    others: list[str]


class IdentificationRequest(TypedDict):
    """How an uploaded file is identified."""

    plant: str
    estimator: str
    initial_state: str
    columns: dict[str, str]
    scales: Numbers


class StartedEvent(TypedDict):
    """A worker has begun."""

    kind: Literal["started"]


class EndEvent(TypedDict):
    """Everything was told."""

    kind: Literal["end"]


class FailedEvent(TypedDict):
    """The call ended early."""

    kind: Literal["failed"]
    sentence: str


class Catalogue(TypedDict):
    """What can be chosen; a plant is its description, with `policies` that fit."""

    kind: Literal["catalogue"]
    version: str
    plants: dict[str, dict[str, object]]
    excitations: list[str]
    estimators: list[str]


class Episode(TypedDict):
    """All samples of a simulated experiment."""

    kind: Literal["episode"]
    plant: dict[str, object]
    excitation: str
    warning: str | None
    params: Numbers
    time: list[float]
    inputs: Rows
    outputs: Rows


class Estimate(TypedDict):
    """The estimate from the samples up to `k`, half its 95 % interval, and that of the bound."""

    kind: Literal["estimate"]
    k: int
    estimate: Numbers
    half: Numbers
    bound: Numbers


class ParameterRow(TypedDict):
    """A parameter in the comparison of experiments; percentages are of the true value."""

    estimate: float | None
    true: float
    error_percent: float | None
    half_percent: float | None
    cramer_rao_bound: float
    cramer_rao_percent: float
    unit: str


class Row(TypedDict):
    """An experiment in the comparison."""

    excitation: str
    status: str
    params: dict[str, ParameterRow]
    is_violation: bool
    max_abs_output: Numbers
    log_det_information: float


class Concluded(TypedDict):
    """What the experiment asked for comes to; `result` names its files, for the browser."""

    kind: Literal["result"]
    row: Row
    identification: dict[str, object] | None
    result: NotRequired[str]


class Compared(TypedDict):
    """Another excitation on the same plant."""

    kind: Literal["other"]
    row: Row


class LeftOut(TypedDict):
    """Another excitation that cannot be compared."""

    kind: Literal["left_out"]
    excitation: str
    sentence: str


class Columns(TypedDict):
    """Columns of an uploaded file, and how many samples each has."""

    kind: Literal["columns"]
    columns: dict[str, int]


class Identified(TypedDict):
    """Parameters of an uploaded record, and the samples of it that a screen can show."""

    kind: Literal["identified"]
    plant: dict[str, object]
    identification: dict[str, object]
    time: list[float]
    inputs: Rows
    outputs: Rows
    simulated: Rows
    result: NotRequired[str]


class Reported(TypedDict):
    """A report was written."""

    kind: Literal["reported"]
    bytes: int


JobEvent = (
    StartedEvent | EndEvent | FailedEvent | Catalogue | Episode | Estimate | Concluded | Compared
    | LeftOut | Columns | Identified | Reported
)  # fmt: skip
"""What is told of a call."""


class Begun(TypedDict):
    """The first of a stream: the name by which it is stopped."""

    kind: Literal["job"]
    job: str


class Pulse(TypedDict):
    """Nothing for a while: the stream lives."""

    kind: Literal["pulse"]


class Stopped(TypedDict):
    """The browser has asked for it."""

    kind: Literal["stopped"]


class Plan(TypedDict):
    """An experiment before its first sample."""

    kind: Literal["plan"]
    plant: dict[str, object]
    excitation: str
    warning: str | None
    params: Numbers
    num_samples: int


class Samples(TypedDict):
    """The next samples."""

    kind: Literal["samples"]
    time: list[float]
    inputs: Rows
    outputs: Rows


StreamEvent = JobEvent | Begun | Pulse | Stopped | Plan | Samples
"""What a browser is told in a stream."""
