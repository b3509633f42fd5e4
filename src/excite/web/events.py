"""Types of the requests to workers, of their events, and of the events for the page.

They are JSON from the worker to the browser: a number that is not finite is None there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NotRequired, TypedDict

Numbers = dict[str, float]
"""Number by the name of a parameter or an output; NaN where there is none."""
Rows = list[list[float]]
"""One row per sample, one column per channel."""


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
    """How uploaded files are identified; but for these, the arguments of `identify`.

    `effects` are what the plant leaves out; `others` are plants that are compared with it; `fitted`
    and `held_out` are names of files.
    """

    plant: str
    effects: list[str]
    others: list[str]
    fitted: list[str]
    held_out: list[str]
    estimator: str
    initial_state: str
    intervals: str
    likelihood: str
    hold_input: str
    columns: dict[str, str]
    validate_columns: dict[str, str]
    scales: Numbers
    units: dict[str, str]
    set_inputs: Numbers
    dt: float | None
    rows: str | None
    start: Numbers
    hold: Numbers
    priors: dict[str, str]
    uncertain: dict[str, str]


class StartedEvent(TypedDict):
    """A worker has started."""

    kind: Literal["started"]


class EndEvent(TypedDict):
    """The last event of a completed call."""

    kind: Literal["end"]


class FailedEvent(TypedDict):
    """The call failed."""

    kind: Literal["failed"]
    sentence: str


class Catalogue(TypedDict):
    """The choices of the page; each plant has its description and its `policies`."""

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


class Traces(TypedDict):
    """Signals of an experiment at the times of its samples, and what it tells over time.

    `bound_percent` is the Cramér-Rao bound of each parameter, one standard deviation, in percent
    of the true value; it and `log_det` have one number after each input.
    """

    inputs: Rows
    outputs: Rows
    log_det: list[float]
    bound_percent: dict[str, list[float]]


class Concluded(TypedDict):
    """Results of the requested experiment; `result` names its files."""

    kind: Literal["result"]
    row: Row
    traces: Traces
    command: str
    identification: dict[str, object] | None
    result: NotRequired[str]


class Compared(TypedDict):
    """Result of another excitation on the same plant, and its estimates from first to last."""

    kind: Literal["other"]
    row: Row
    traces: Traces
    estimates: list[Estimate]


class LeftOut(TypedDict):
    """Another excitation that cannot be compared."""

    kind: Literal["left_out"]
    excitation: str
    sentence: str


class Preview(TypedDict):
    """A column of an uploaded file: its first cells, and numbers for a small plot.

    `values` are those of the rows `index`; empty for a column of texts. `note` says what is found
    in it: sampling and gaps of a column that increases, missing values, a suspected saturation.
    """

    first: list[str]
    note: str
    index: list[int]
    values: list[float]


class Columns(TypedDict):
    """Columns of an uploaded file, how many samples each has, and what is in them."""

    kind: Literal["columns"]
    columns: dict[str, int]
    previews: dict[str, Preview]


class ShownTable(TypedDict):
    """A table of texts."""

    title: str
    header: list[str]
    rows: list[list[str]]


class ShownRecord(TypedDict):
    """A record and what the fitted plant does in it: the samples that a screen can show.

    `is_whole` says whether these are all samples.
    """

    file: str
    time: list[float]
    inputs: Rows
    outputs: Rows
    simulated: Rows
    is_whole: bool


class Identified(TypedDict):
    """Parameters from uploaded records; those held out come last.

    `comparison` is the table of several plants, None where there is one.
    """

    kind: Literal["identified"]
    command: str
    plant: dict[str, object]
    identification: dict[str, object]
    records: list[ShownRecord]
    comparison: ShownTable | None
    result: NotRequired[str]


class Reported(TypedDict):
    """A report was written."""

    kind: Literal["reported"]
    bytes: int


JobEvent = (
    StartedEvent | EndEvent | FailedEvent | Catalogue | Episode | Estimate | Concluded | Compared
    | LeftOut | Columns | Identified | Reported
)  # fmt: skip
"""Events of a call."""


class Begun(TypedDict):
    """The first event of a stream: what was asked, and the name.

    By the name it can be stopped and followed again, and its result is found.
    """

    kind: Literal["job"]
    job: str
    asked: Mapping[str, object]


class Pulse(TypedDict):
    """Sent during long computations to keep the stream alive."""

    kind: Literal["pulse"]


class Stopped(TypedDict):
    """The browser has stopped the stream."""

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
"""Events of a stream for a browser."""
