"""The result of an identification."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float

from .. import __version__
from ..description import RARE, Named, PlantDescription, names_of
from ..record import Record
from ..record.run_folder import write_run
from ..record.table import data_frame
from ..report.results import identification_html, identification_text, wrapped
from ..report.rows import USABLE, EstimateSummary
from .contract import Basis
from .diagnosis import correlation, fit_percent
from .remedies import Suspect

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame
    from xarray import DataTree


KIND = "excite identification"  # of its run folders


@dataclass(frozen=True)
class Predicted:
    """One-step prediction of a record by an estimator that takes the plant as disturbed.

    Attributes:
        outputs: predicted from all earlier samples; NaN where none was measured.
        sd: of measured minus predicted outputs.
        fit_percent: by output, as for the simulation.
        inside_percent: by output, share of the measured values inside predicted ± 1.96 sd.
    """

    outputs: Float[np.ndarray, "sample output"]
    sd: Float[np.ndarray, "sample output"]
    fit_percent: Mapping[str, float]
    inside_percent: Mapping[str, float]


@dataclass(frozen=True)
class Noise:
    """Estimated noise, by name.

    Attributes:
        process: diffusion of each state [state unit / sqrt(s)].
        measurement: standard deviation of each output [output unit].
    """

    process: Mapping[str, float]
    measurement: Mapping[str, float]


@dataclass(frozen=True)
class Fitted:
    """One record and its simulation.

    Attributes:
        record: the measurements.
        simulated: noise-free outputs of the estimated plant.
        fit_percent: by output, 100 (1 - |y - y_s| / |y - mean y|).
        predicted: one step ahead, with `pem`; otherwise None.
        initial_state: where that of a held-out record comes from.
    """

    record: Record
    simulated: Float[np.ndarray, "sample output"]
    fit_percent: Mapping[str, float]
    predicted: Predicted | None = None
    initial_state: str = ""

    @property
    def model(self) -> Float[np.ndarray, "sample output"]:
        """Outputs that the residual is measured from: predicted ones where there are any."""
        return self.simulated if self.predicted is None else self.predicted.outputs

    @property
    def computed(self) -> dict[str, Float[np.ndarray, "sample output"]]:
        """Simulated outputs, residuals, and those of the prediction, by name."""
        found = {"simulated": self.simulated, "residual": self.record.outputs - self.model}
        if self.predicted is not None:
            found |= {"predicted": self.predicted.outputs, "predicted_sd": self.predicted.sd}
        return found


@dataclass(frozen=True, repr=False)
class Identification:
    """The result of `identify`; its `repr` is the table of `excite identify`.

        >>> import excite as ex
        >>> result = ex.identify(ex.simulate("aero2", "chirp"))
        >>> low, high = result.ci95("J_p")
        >>> low < result.params.J_p < high
        True

    Attributes:
        plant: the plant, sampled as the records are.
        estimator: its name on the command line.
        status: in a few words; docs/reference/machine-readable.md lists them.
        params, std_error: by parameter, in its unit, as attribute or item; the error of a held
            one is nan.
        intervals: 95 % interval of each parameter.
        held: parameters not estimated: not identifiable, or held at a bound that they reached.
        covariance, information: of the estimates; see `excite.estimation.Estimate`. The covariance,
            and with it the errors, allow for coloured noise and for an error of the structure.
        whiteness: by output, p-value of the residual being white (Ljung-Box); with `pem` the
            residual is the error of the one-step prediction.
        structure: by output, p-value of the residual not following past inputs.
        misfit_factor: by which errors and intervals are wider because a residual follows the input;
            1 where none does.
        verdict: sentences on identifiability and on the validity of the intervals.
        suspects: what the plant may leave out, the likeliest first; see `Suspect`.
        fitted, validation: records and their simulation.
        initial_state_known: whether initial states were taken as known.
        noise: estimated with `pem`; otherwise None.
        starts: costs at which several starts of the search ended: weighted sums of squares, or
            numbers that grow as the likelihood falls where the noise is estimated with them.
        profiles: with profile intervals, by parameter the values that were tried, and the growth
            of the sum of squares over the limit of the interval.
        basis: what it was computed from; None for a result that was loaded.
    """

    plant: PlantDescription
    estimator: str
    status: str
    params: Named[float]
    std_error: Named[float]
    intervals: Named[tuple[float, float]]
    held: tuple[str, ...]
    covariance: Float[np.ndarray, "param param"]
    information: Float[np.ndarray, "param param"]
    whiteness: Mapping[str, float]
    structure: Mapping[str, float]
    misfit_factor: float
    verdict: tuple[str, ...]
    suspects: tuple[Suspect, ...]
    fitted: tuple[Fitted, ...]
    validation: tuple[Fitted, ...]
    initial_state_known: bool
    noise: Noise | None = None
    starts: tuple[float, ...] = ()
    profiles: Mapping[str, Float[np.ndarray, "point 2"]] = field(default_factory=dict)
    basis: Basis | None = field(default=None, compare=False)

    @property
    def is_usable(self) -> bool:
        """Whether there is an estimate."""
        return self.status in USABLE

    def __getstate__(self) -> dict[str, Any]:
        """What is pickled: all but the plant's own code."""
        return self.__dict__ | {"basis": None}

    def ci95(self, name: str) -> tuple[float, float]:
        """95 % interval of a parameter: estimate ± t standard errors, or by profile likelihood.

        t is 1.96 where the noise is known; where its size is estimated from the residual, it is
        that of Student's distribution. No interval leaves a parameter's bounds or its uniform
        prior. An end where a profile stays open is infinite.
        """
        return self.intervals[name]

    def fit(self) -> dict[str, float]:
        """Fit of the simulation in percent by output, over all records together."""
        return self._fit_of([f.simulated for f in self.fitted])

    def prediction_fit(self) -> dict[str, float] | None:
        """The same of the one-step prediction, with `pem`."""
        if self.noise is None:
            return None
        predicted = [f.model for f in self.fitted]
        return self._fit_of(predicted, [np.isnan(values) for values in predicted])

    def residual(self) -> dict[str, dict[str, Any]]:
        """Size of the residual by output, over all records: `rms`, `sum_of_squares`, `unit`.

        The residual is that of the simulation, with `pem` that of the one-step prediction.
        """
        values = np.concatenate([f.record.outputs - f.model for f in self.fitted])
        squares = np.nansum(values**2, axis=0)
        counts = np.sum(~np.isnan(values), axis=0)
        return {
            o.name: {
                "rms": math.sqrt(s / n) if n else math.nan,
                "sum_of_squares": float(s),
                "unit": o.unit,
            }
            for o, s, n in zip(self.plant.outputs, squares, counts, strict=True)
        }

    def _fit_of(
        self, values: Sequence[np.ndarray], without: Sequence[np.ndarray] | None = None
    ) -> dict[str, float]:
        """Fit of some outputs of all records, but of samples that are left out."""
        means = [np.nanmean(f.record.outputs, axis=0) for f in self.fitted]
        measured = np.concatenate(
            [f.record.outputs - mean for f, mean in zip(self.fitted, means, strict=True)]
        )
        own = np.concatenate([v - mean for v, mean in zip(values, means, strict=True)])
        if without is not None:
            measured = np.where(np.concatenate(without), np.nan, measured)
        names = names_of(self.plant.outputs)
        return {n: fit_percent(measured[:, i], own[:, i]) for i, n in enumerate(names)}

    def __str__(self) -> str:
        return identification_text(self.summary())

    def __repr__(self) -> str:
        return wrapped(str(self))

    def _repr_html_(self) -> str:
        return identification_html(self.summary())

    def plot(self, what: Literal["fit", "diagnosis"] = "fit") -> Figure:
        """A figure of the fit, or of how far the estimate can be trusted.

        Args:
            what: "fit": measured against simulated outputs of the first record, residuals,
                intervals; "diagnosis": starts of the search, correlation of the estimates,
                autocorrelation of the residuals, and profiles where there are any.

        Raises:
            ValueError: for another word.
        """
        from ..report.figures import diagnosis_figure, identification_figure

        if what == "diagnosis":
            residuals = [f.record.outputs - f.model for f in self.fitted]
            return diagnosis_figure(self.plant, self.summary(), residuals)
        if what != "fit":
            raise ValueError(f"a figure shows 'fit' or 'diagnosis': got {what!r}")
        first = self.fitted[0]
        return identification_figure(self.plant, self.summary(), first.record, first.model)

    def to_pandas(self) -> DataFrame:
        """One row per parameter: estimate, standard error, 95 % interval, unit.

        Raises:
            ValueError: where pandas is not installed.
        """
        intervals = [self.ci95(name) for name in self.params]
        columns = {
            "estimate": list(self.params.values()),
            "std_error": list(self.std_error.values()),
            "ci95_low": [low for low, _ in intervals],
            "ci95_high": [high for _, high in intervals],
            "unit": [p.unit for p in self.plant.parameters],
            "held": [name in self.held for name in self.params],
        }
        return data_frame(columns, list(self.params))

    def posterior(
        self,
        num_samples: int = 1000,
        chains: int = 4,
        seed: int = 0,
        progress: Callable[[str, float, float], None] = lambda *_: None,
    ) -> DataTree:
        """Samples of the posterior of the parameters, in the groups and with the names of ArviZ.

        The likelihood is that of the estimator `nls` with independent noise of one size for each
        output. The prior is that of `identify`; where it was given none, it is flat in the
        logarithms of positive parameters, flat in others and in initial states, and 1/sd in the
        size of the noise. Uncertain constants are log-normal. Held parameters stay held. The
        chains begin around the estimate.

        Args:
            num_samples: of each chain.
            chains: number of chains.
            seed: of the sampler.
            progress: called with the current step, how many draws are done, and their total.

        Returns:
            `posterior`: parameters, uncertain constants, `noise_sd` by output unless it is known,
            `initial_state` if it was estimated; `sample_stats`; `observed_data`;
            `log_likelihood` of every measured value, unless there are more than ten million;
            `constant_data`: held parameters.

        Raises:
            ValueError: for a failed estimate, an estimator other than `nls`, a record without
                noise, and where the extra `bayes` is not installed.
        """
        from .posterior import sampled

        if self.is_usable and self.basis is None:
            raise ValueError("a result that was loaded has no posterior; identify again")
        if self.basis is None or not self.is_usable:
            raise ValueError(f"a failed estimate has no posterior (status: {self.status})")
        coloured = [name for name, p in self.whiteness.items() if p < RARE]
        return sampled(self.basis, coloured, num_samples, chains, seed, progress)

    def summary(self) -> EstimateSummary:
        """The result as tables, figures and reports read it."""
        return EstimateSummary.of(self.to_dict())

    def save(self, path: str | Path, overwrite: bool = False, command: str = "") -> None:
        """Writes a run folder: records, simulated outputs, residuals, estimate, information.

        Args:
            path: of the folder.
            overwrite: whether a run folder at `path` is replaced; your own files in it are kept.
            command: that made it.

        Raises:
            ValueError: where `path` is not a run folder, is one and `overwrite` is False, or is
                that of a campaign or a study.
        """
        information = {
            "coordinates": "logarithm of positive parameters, free ones over their scale",
            "parameters": names_of(self.plant.parameters),
            "information": self.information,
            "covariance": self.covariance,
        }
        about = {"kind": KIND, "excite": __version__, "command": command}
        contents = {
            "estimate": self.to_dict(),
            "information": information,
            "run": {**about, "plant": self.plant.to_dict()},
        }
        records = [(f.record, f.computed) for f in self.fitted]
        write_run(Path(path), self.plant, records, contents, overwrite, KIND)

    def to_dict(self) -> dict[str, object]:
        """The result as JSON-ready data; docs/reference/machine-readable.md lists its keys."""
        return {
            "plant": self.plant.name,
            "plant_hash": self.plant.hash,
            "estimator": self.estimator,
            "status": self.status,
            "params": {
                p.name: {
                    "estimate": self.params[p.name],
                    "std_error": self.std_error[p.name],
                    "ci95": self.ci95(p.name),
                    "unit": p.unit,
                    "relative_to_nominal": self.params[p.name] / p.nominal if p.nominal else None,
                    "held": p.name in self.held,
                }
                for p in self.plant.parameters
            },
            "fit_percent": self.fit(),
            "residual": self.residual(),
            "validation": [
                {
                    "file": f.record.source,
                    "fit_percent": dict(f.fit_percent),
                    "initial_state": f.initial_state,
                    **_prediction(f),
                }
                for f in self.validation
            ],
            "files": [f.record.source for f in self.fitted],
            "initial_state": "known" if self.initial_state_known else "free",
            "correlation": correlation(self.covariance),
            "whiteness_p_value": dict(self.whiteness),
            "structure_p_value": dict(self.structure),
            "misfit_factor": self.misfit_factor,
            "verdict": list(self.verdict),
            "prediction_fit_percent": self.prediction_fit(),
            "process_noise": None if self.noise is None else dict(self.noise.process),
            "measurement_noise": None if self.noise is None else dict(self.noise.measurement),
            "suspects": [asdict(suspect) for suspect in self.suspects],
            "starts": list(self.starts),
            "profiles": {name: points.tolist() for name, points in self.profiles.items()},
        }


def _prediction(fitted: Fitted) -> dict[str, object]:
    """JSON-ready data on the one-step prediction of a held-out record."""
    p = fitted.predicted
    if p is None:
        return {}
    return {
        "prediction_fit_percent": dict(p.fit_percent),
        "inside_band_percent": dict(p.inside_percent),
    }
