"""Types of the files of studies and identifications: rows, differences, estimates.

They are computed in `study` and `estimation`, kept as JSON and shown by `report`;
docs/reference/machine-readable.md lists the keys. A number that does not exist is NaN here and
`null` in a file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Strict,
    ValidationError,
    model_validator,
)

from ..files import damaged, json_ready, read_json


def _or_nan(value: object) -> object:
    return math.nan if value is None else value


Count = Annotated[int, Strict()]
Number = Annotated[float, Strict(), BeforeValidator(_or_nan)]
MaybeNumber = Annotated[float | None, BeforeValidator(_or_nan)]
"""NaN for a number that does not exist; None, its default, where it was not computed."""
Interval = tuple[Number, Number]
Options = dict[str, object]


class Saved(BaseModel):
    """Part of a file in a run folder."""

    model_config = ConfigDict(frozen=True, defer_build=True)

    @classmethod
    def read(cls, path: Path, advice: str = "") -> Self:
        """The content of a JSON file.

        Args:
            advice: what helps where the file is damaged; it ends the message.

        Raises:
            ValueError: where it cannot be read, or holds something else.
        """
        try:
            return cls.model_validate(read_json(path, advice=advice))
        except ValidationError:
            raise damaged(path, advice) from None

    def data(self) -> dict[str, Any]:
        """The content as JSON-ready data, as far as it was set."""
        return json_ready(self.model_dump(exclude_unset=True))


class MeanSd(Saved):
    """Mean and standard deviation."""

    mean: Number
    sd: Number


class ErrorStatistics(MeanSd):
    """Relative errors of one parameter [%]; `all_seeds` includes seeds that are not viable."""

    median: Number
    rms: Number
    all_seeds: MeanSd | None = None


class Rate(Saved):
    """A rate and its 95 % interval (Wilson)."""

    estimate: Number
    ci95: Interval


class LargestOutput(MeanSd):
    """Largest magnitude of the supervised output, in the unit in which it is shown."""

    output: str
    unit: str


class CountsBySeed(Saved):
    """Experiments of each of an agent's seeds that reached a critical level."""

    evaluations: Count
    violations: tuple[Count, ...]
    own_plants: Annotated[bool, Strict()]
    """Whether every seed has plants of its own; otherwise the seeds share them."""


class RigCounts(Saved):
    """Experiments on a simulated rig that the supervisor ended, and the safety filter's part."""

    trips: Count
    filtered_violations: Count | None = None
    filtered_trips: Count | None = None
    interventions: Count | None = None


class BoundByLength(Saved):
    """Mean Cramér-Rao bound [%] of shorter experiments, by parameter."""

    num_steps: tuple[Count, ...]
    cramer_rao_percent: dict[str, tuple[Number, ...]]


class Nats(Saved):
    """A mean in nats, with its standard error."""

    mean: Number
    std_error: Number


class ExpectedGain(Saved):
    """Expected information gain: bounds, of how many plants and samples, and what to know of them.

    Of an agent they are means over its viable seeds.
    """

    lower: Nats
    upper: Nats
    plants: Count
    samples: Count
    from_prior: Annotated[bool, Strict()]
    warnings: tuple[str, ...] = ()


class Row(Saved):
    """One method and one estimator over all episodes, or an agent over all its seeds."""

    method: str
    estimator: str
    evaluations: Count
    failed: Count
    failures: dict[str, Count]
    violations: Count
    violation_rate: Rate
    by_seed: CountsBySeed | None = None
    on_rig: RigCounts | None = None
    max_abs_output: LargestOutput
    log_det_information: Number
    log_det_information_sd: Number
    log_det_of_clairvoyant_plants: MaybeNumber = None
    relative_error_percent: dict[str, ErrorStatistics]
    cramer_rao_percent: dict[str, Number]
    rms_over_cramer_rao: dict[str, Number]
    coverage95_percent: dict[str, Number]
    beyond_6_std_errors: Count
    bound_by_length: BoundByLength | None = None
    expected_gain: ExpectedGain | None = None
    viable_seeds: Count | None = None
    seeds: Count | None = None
    train_seconds: float | None = None
    d_efficiency: MaybeNumber = None

    @model_validator(mode="after")
    def _require_same_parameters(self) -> Self:
        names = self.relative_error_percent.keys()
        parts = (self.cramer_rao_percent, self.rms_over_cramer_rao, self.coverage95_percent)
        if not names or any(part.keys() != names for part in parts):
            raise ValueError("columns differ in their parameters")
        if self.seeds is not None:
            errors = self.relative_error_percent.values()
            if None in (self.viable_seeds, self.train_seconds, *(e.all_seeds for e in errors)):
                raise ValueError("the row of an agent is incomplete")
        return self

    @property
    def parameters(self) -> list[str]:
        """Names of the plant's parameters."""
        return list(self.relative_error_percent)


class Rows(Saved):
    """`methods.json`, and `clairvoyant.json` with the spread between starts of the search."""

    rows: tuple[Row, ...]
    log_det_spread_of_starts: tuple[Number, ...] = ()


class SeedMetrics(Saved):
    """`metrics.json` of one seed of an agent."""

    agent: str = ""
    seed: int = 0
    rows: tuple[Row, ...]
    rms_input_fraction: Number = math.nan
    viable: Annotated[bool, Strict()]
    validation: dict[str, Number]
    train_seconds: Number
    resumed_at_steps: int | None = None
    fingerprint: str = ""


class Gap(Saved):
    """Mean difference over the seeds and its 95 % interval (Student)."""

    mean: Number
    ci95: Interval
    seeds: Count


class Difference(Saved):
    """Mean errors of `method` minus those of `minus` [points of percent], by parameter."""

    method: str
    minus: str
    estimator: str
    relative_error_percent: dict[str, Gap]


class EpisodeData(Saved):
    """One experiment of `episodes.json`: columns by name."""

    estimator: str = ""
    seed: int | None = None
    time: tuple[Number, ...]
    inputs: dict[str, tuple[Number, ...]]
    outputs: dict[str, tuple[Number, ...]]
    estimate_over_true: dict[str, tuple[Number, ...]]


class PublishedRow(Saved):
    """A published row: mean and standard deviation of each column."""

    relative_error_percent: dict[str, tuple[float, float]] = {}
    max_abs_output: tuple[float, float]
    violations: str
    viable_seeds: str = ""


class AgentFacts(Saved):
    """Settings of one agent in a study."""

    method: str
    targets: list[str] | None = None
    decision: Options = {}
    training: Options = {}


class ClairvoyantFacts(Saved):
    """Settings of a study's clairvoyant signals."""

    plants: int
    starts: int
    updates: int = 1500


class StudyFacts(Saved):
    """`study.json` as tables and reports read it; `excite.study.Study` documents the settings."""

    name: str
    title: str = ""
    plant: str
    episodes: int
    num_steps: int
    seed: int
    spread: float | str
    prior: dict[str, str] = {}
    gain: Options | None = None
    uncertainty: Options = {}
    coast: int = 0
    sensor: dict[str, Options] = {}
    methods: dict[str, Options] = {}
    estimators: dict[str, Options]
    agents: dict[str, AgentFacts] = {}
    seeds: int = 1
    safety_episodes: int | None = None
    decision: Options = {}
    training: Options = {}
    gradient: Options = {}
    clairvoyant: ClairvoyantFacts | None = None
    lengths: list[int] = []
    rig: Options | None = None
    note: str = ""
    inferred: list[str] = []
    ours: list[str] = []
    reference: dict[str, PublishedRow] = {}
    source: str = ""

    @property
    def heading(self) -> str:
        """The title of tables and figures."""
        return self.title or self.name


class EstimatedParameter(Saved):
    """One estimate with its standard error and 95 % interval, in `unit`."""

    estimate: Number
    std_error: Number
    ci95: Interval
    unit: str
    relative_to_nominal: float | None
    held: bool

    @property
    def has_interval(self) -> bool:
        """Whether there are an estimate other than zero and its error."""
        return bool(self.estimate) and math.isfinite(self.estimate + self.std_error)


class HeldOut(Saved):
    """Fit of a record that was not used in the estimation, by output [%].

    With `pem` also that of its one-step prediction, and the share of values inside its 95 % band.
    """

    file: str
    fit_percent: dict[str, Number]
    initial_state: str = ""
    prediction_fit_percent: dict[str, Number] | None = None
    inside_band_percent: dict[str, Number] | None = None


USABLE = ("successful", "partly identifiable")
"""Statuses of an identification that has estimates."""


class FoundSuspect(Saved):
    """What a plant may leave out; see `excite.estimation.remedies.Suspect`."""

    name: str
    value: float | None
    std_error: Number
    unit: str
    reduction: Number
    log_likelihood: Number
    p_value: float
    remedy: str


class ResidualSize(Saved):
    """Size of the residual of one output, over all records, in `unit` and its square."""

    rms: Number
    sum_of_squares: Number
    unit: str


class EstimateSummary(Saved):
    """`estimate.json`: the result of an identification as plain data.

    With `pem` there are the fit of the one-step prediction and the estimated noise.
    """

    plant: str
    plant_hash: str
    estimator: str
    status: str
    params: dict[str, EstimatedParameter]
    fit_percent: dict[str, Number]
    residual: dict[str, ResidualSize] = {}
    validation: tuple[HeldOut, ...]
    files: tuple[str, ...]
    initial_state: str
    correlation: tuple[tuple[Number, ...], ...]
    whiteness_p_value: dict[str, Number]
    structure_p_value: dict[str, Number]
    misfit_factor: Number = 1.0
    verdict: tuple[str, ...]
    prediction_fit_percent: dict[str, Number] | None = None
    process_noise: dict[str, Number] | None = None
    measurement_noise: dict[str, Number] | None = None
    suspects: tuple[FoundSuspect, ...] = ()
    starts: tuple[Number, ...] = ()
    profiles: dict[str, tuple[tuple[Number, Number], ...]] = {}

    @property
    def is_predicted(self) -> bool:
        """Whether the residual is that of a one-step prediction, not of a simulation."""
        return self.prediction_fit_percent is not None

    @property
    def model_fit_percent(self) -> dict[str, Number]:
        """Fit by output of what the residual is measured from [%]."""
        return self.prediction_fit_percent or self.fit_percent

    @classmethod
    def of(cls, data: Mapping[str, object]) -> EstimateSummary:
        """From data as a file or `Identification` has them."""
        return cls.model_validate(json_ready(data))

    @property
    def is_usable(self) -> bool:
        """Whether there is an estimate."""
        return self.status in USABLE
