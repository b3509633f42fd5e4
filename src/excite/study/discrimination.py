"""Which of several plants is the true one, and which experiment tells them apart."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jaxtyping import Float

from ..description import (
    HALF_95,
    LARGEST_SEED,
    RARE,
    SpreadLike,
    by_name,
    names_of,
    path_from,
    require_whole,
    wrong_type,
)
from ..estimation.diagnosis import chi2_tail
from ..estimation.evidence import Fit, Rival, fitted, probabilities, unplayed
from ..estimation.from_records import experiments_of, parts_of, sampled_as
from ..estimation.identify import RecordLike, record_for, records_in
from ..excitation import Replay
from ..files import json_ready
from ..information import require_noise
from ..plant import AbstractPlant
from ..plant.catalogue import PlantLike, plant_from
from ..plant.uncertainty import Range, Uncertainty
from ..progress import SHOWN, Progress
from ..record import Record, require_record_path, write_record
from ..report.numbers import digits_for, number
from ..report.tables import html_table, text_table
from ..rig.contract import Interval
from ..training.design import designed_record
from ..training.discrimination import discriminating, error_bound, first_signals
from .next_experiment import COAST

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RivalLike: TypeAlias = PlantLike | tuple[PlantLike, Mapping[str, Range]]
"""A plant, and ranges of its parameters: `"aero2_lag,tau=0.05:0.25"` or a pair of the two."""

_SMALLEST = 1e-99  # bound that is told
DECIDED = 0.99  # probability at which a rival is chosen


@dataclass(frozen=True)
class JudgedRival:
    """One of several plants, after the records.

    Attributes:
        name: as it was given.
        probability: of being the true one, if all rivals were as probable before.
        misfit_factor: root mean square of the residual over the declared noise; NaN before the
            first record.
        explains: whether the residual is no larger than the noise makes it.
        estimate: of each quantity of its box, with half of the 95 % interval.
    """

    name: str
    probability: float
    misfit_factor: float
    explains: bool
    estimate: Mapping[str, Interval]


@dataclass(frozen=True, repr=False)
class Discrimination:
    """The rivals after the records, and the experiment that tells them apart.

    Attributes:
        rivals: in the order in which they were given.
        inputs: of the experiment, in the inputs' units; None where no safe one was found, or one
            rival is chosen.
        bounds: on the probability that the wrong rival has the largest evidence, now and after
            the experiment: an estimate; see `excite.training.discrimination`.
        nearness: largest output over its critical level, on plants of all rivals that are still
            possible, coast included; NaN where no experiment was designed.
    """

    rivals: tuple[JudgedRival, ...]
    inputs: Float[np.ndarray, "time input"] | None
    bounds: tuple[float, float]
    nearness: float
    _rivals: tuple[Rival, ...]
    _fits: tuple[Fit, ...]

    @property
    def chosen(self) -> JudgedRival | None:
        """The rival whose probability is at least 0.99, if it explains the records."""
        best = max(self.rivals, key=lambda rival: rival.probability)
        return best if best.probability >= DECIDED and best.explains else None

    @property
    def is_explained(self) -> bool:
        """Whether the residual of any rival is no larger than the noise makes it."""
        return any(rival.explains for rival in self.rivals)

    @property
    def plants(self) -> dict[str, str]:
        """Hash of each rival's plant, by the rival's name."""
        return {rival.name: rival.box.plant.description.hash for rival in self._rivals}

    @property
    def rival_plants(self) -> tuple[AbstractPlant, ...]:
        """The plant of each rival, with its nominal parameters."""
        return tuple(rival.box.plant for rival in self._rivals)

    @property
    def plant(self) -> AbstractPlant | None:
        """The plant of the chosen rival, with the constants and the initial state of its fit."""
        if (chosen := self.chosen) is None:
            return None
        index = self.rivals.index(chosen)
        own = self._rivals[index]
        if {*own.box.names} <= {*names_of(own.box.plant.definition.parameters)}:
            return own.box.plant
        return own.box.at(2 * ndtr(self._fits[index].z) - 1)[0]

    @property
    def fitted_beside(self) -> tuple[dict[str, float], bool]:
        """What the chosen rival has ranges of, beside its parameters.

        That is the standard deviation of each such constant, if it has one, and whether initial
        states are among them. Two constants whose fits are correlated count as independent.
        """
        if (chosen := self.chosen) is None:
            return {}, False
        d = self._rivals[self.rivals.index(chosen)].box.plant.definition
        others = chosen.estimate.keys() - names_of(d.parameters)
        constants = others & {*names_of(d.constants)}
        sd = {name: chosen.estimate[name].ci95_half / HALF_95 for name in sorted(constants)}
        return {n: own for n, own in sd.items() if own > 0}, len(others) > len(constants)

    def after(self, records: Sequence[Record], room: tuple[int, int] = (0, 0)) -> Discrimination:
        """The same rivals after these records; see `judged`."""
        return judged(self._rivals, records, room)

    @property
    def decision(self) -> str:
        """Which rival is chosen, or what to play, as a sentence."""
        best = max(self.rivals, key=lambda rival: rival.probability)
        if self.chosen is not None:
            return f"{best.name} is chosen (probability {best.probability:.4f})"
        if not self.is_explained:
            return (
                f"no rival explains the records: the residual of {best.name} is "
                f"{best.misfit_factor:.2g} times the declared noise"
            )
        before, after = self.bounds
        if self.inputs is None:
            if not np.isnan(self.nearness):
                return "undecided; no safe signal was found"
            told = ", ".join(f"{r.name} {r.probability:.2f}" for r in self.rivals)
            return f"undecided; probabilities: {told}"
        return (
            f"undecided; play the signal of {len(self.inputs)} samples: it lowers the probability "
            f"of a wrong choice from at most {before:.2g} to at most "
            f"{max(after, _SMALLEST):.2g} (estimated)"
        )

    @property
    def excitation(self) -> Replay:
        """The experiment, to be played from rest; ValueError where there is none."""
        return Replay(jnp.asarray(self._played))

    @property
    def _played(self) -> Float[np.ndarray, "time input"]:
        if self.inputs is None:
            raise ValueError(f"there is no experiment to play: {self.decision}")
        return self.inputs

    @cached_property
    def responses(self) -> dict[str, Float[np.ndarray, "sample output"]]:
        """Noise-free outputs of each rival's best fit in the experiment."""
        inputs = jnp.asarray(self._played)
        return {
            rival.name: np.asarray(rival.response(fit.z, inputs))
            for rival, fit in zip(self._rivals, self._fits, strict=True)
        }

    def save(self, path: str | Path, overwrite: bool = False) -> None:
        """Writes the experiment (.csv, .mat); `excite run --input` plays the file.

        Raises:
            ValueError: for another ending, a file that exists, unless `overwrite`, or where there
                is no experiment.
        """
        require_record_path(Path(path), overwrite)
        outputs = next(iter(self.responses.values()))
        plant = self._rivals[0].box.plant
        about = {"design": "discrimination", "rivals": list(self.responses)}
        record = designed_record(plant, jnp.asarray(self._played), jnp.asarray(outputs), about)
        write_record(path, record, plant.description)

    def plot(self) -> Figure:
        """The experiment, and the outputs of each rival's best fit."""
        from ..report.figures import rivals_figure

        plant = self._rivals[0].box.plant
        time = np.arange(len(self._played) + 1) * float(plant.dt)
        return rivals_figure(plant.description, time, self._played, self.responses)

    def to_dict(self) -> dict[str, Any]:
        """Rivals and decision as JSON-ready data."""
        content = {
            "rivals": [
                {
                    "plant": r.name,
                    "probability": r.probability,
                    "misfit_factor": r.misfit_factor,
                    "explains": r.explains,
                    "estimate": {n: interval._asdict() for n, interval in r.estimate.items()},
                }
                for r in self.rivals
            ],
            "chosen": None if self.chosen is None else self.chosen.name,
            "decision": self.decision,
            "num_steps": None if self.inputs is None else len(self.inputs),
            "error_bound": {"now": self.bounds[0], "after": self.bounds[1]},
            "nearness": self.nearness,
        }
        return json_ready(content)

    header = ("rival", "probability", "residual / noise", "parameters of its own")

    def rows(self) -> list[list[str]]:
        """Rows of the table: one per rival, the most probable first."""
        shared = set.intersection(*(set(r.estimate) for r in self.rivals))
        rows = []
        for r in sorted(self.rivals, key=lambda rival: -rival.probability):
            own = [
                f"{name} = {number(value, digits_for(value, half))} ± {half:.2g}"
                for name, (value, half) in r.estimate.items()
                if name not in shared
            ]
            probability = f"{r.probability:.4f}" if self.is_explained else "–"
            rows.append([r.name, probability, number(r.misfit_factor), ", ".join(own)])
        return rows

    def __repr__(self) -> str:
        """The table that `excite discriminate` prints."""
        table = text_table("rivals", self.header, self.rows())
        return f"{table}\n{textwrap.fill(self.decision, 80)}"

    def _repr_html_(self) -> str:
        """The same for a notebook."""
        return html_table(self.decision, self.header, self.rows())


def discriminate(
    plants: Sequence[RivalLike],
    records: RecordLike | Sequence[RecordLike] = (),
    *,
    spread: SpreadLike = 0.3,
    steps: int = 20,
    coast: int = COAST,
    initial_state: str = "auto",
    seed: int = 0,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress = SHOWN,
) -> Discrimination:
    """Which of several plants is the true one, and which experiment, from rest, tells them apart.

        >>> import excite as ex
        >>> rivals = ["aero2", "aero2_lag,tau=0.05:0.25"]
        >>> truth = ex.simulate("aero2_lag", "prbs", steps=40, params={"tau": 0.1}, seed=1)
        >>> ex.discriminate(rivals, truth).chosen.name
        'aero2_lag,tau=0.05:0.25'

    Args:
        plants: at least two, with the same inputs and outputs; each as a name with ranges of its
            parameters, constants and effects: "aero2+dead_zone,dead_zone_voltage=0.1:2". A range
            is LOW:HIGH, a percentage, or a factor ("factor:3"). A plant or its class goes with a
            dict of ranges: (MyPlant, {"tau": "0.05:0.25"}).
        records: of experiments so far, from rest, or their files; none before the first.
        spread: of parameters without a range.
        steps: samples of the experiment.
        coast: samples after the experiment in which the plant must be safe too.
        initial_state: "known" where the records are from rest and their sidecars do not say so.
        seed: of the starts of the search.
        out: file of the experiment (.csv, .mat), which `excite run --input` plays; it is not
            written where no experiment is needed, or none is safe.
        overwrite: replaces an existing file.
        progress: called with a text, how much is done, and the total.

    Raises:
        ValueError: for rivals with other inputs or outputs, records that do not start at rest,
            and a name or a value that is not allowed.
        TypeError: for an argument of another type.
    """
    require_whole("steps", steps, 2, 10_000)
    given = records_in(records, "records")
    require_whole("coast", coast, 0)
    require_whole("seed", seed, 0, LARGEST_SEED)
    if initial_state not in ("auto", "known"):
        raise ValueError(f"initial_state must be auto or known: got {initial_state!r}")
    if out is not None:
        require_record_path(path_from("out", out), overwrite)
    rivals = rivals_from(plants, spread)
    own = [_from_rest(record, rivals[0], initial_state) for record in given]
    progress("comparing", 0, 2)
    found = judged(sampled_like(rivals, own), own)
    if found.chosen is None and found.is_explained:
        progress("designing", 1, 2)
        found = with_experiment(found, steps, coast, seed)
    progress("done", 2, 2)
    if out is not None and found.inputs is not None:
        found.save(out, overwrite)
    return found


def rivals_from(given: Sequence[RivalLike], spread: SpreadLike) -> tuple[Rival, ...]:
    """Rivals with the sensor and the sampling time of the first.

    Raises:
        ValueError: for rivals with other inputs, outputs, units, limits or levels.
        TypeError: for an argument of another type.
    """
    if isinstance(given, str) or not isinstance(given, Sequence):
        raise wrong_type("plants", given, "a list of at least two plants")
    if len(given) < 2:
        raise ValueError(f"at least two plants are needed: got {len(given)}")
    rivals = [_rival(own, spread) for own in given]
    first = rivals[0].box.plant
    require_noise(first)
    for rival in rivals:
        _require_alike(rival, rivals[0])
    names = [rival.name for rival in rivals]
    twice = [name for i, name in enumerate(names) if name in names[:i]]
    if twice:
        raise ValueError(f"{twice[0]} is given twice")
    return tuple(
        eqx.tree_at(
            lambda r: r.box.plant, rival, rival.box.plant.changed(sensor=first.sensor, dt=first.dt)
        )
        for rival in rivals
    )


def _require_alike(rival: Rival, first: Rival) -> None:
    """Raises ValueError where one signal cannot be played, or is not as safe, on both."""
    d, other = rival.box.plant.definition, first.box.plant.definition
    if not d.inputs:
        raise ValueError(f"{rival.name} has no inputs: there is no experiment to design")
    for what, attributes in (
        ("inputs", ("name", "unit", "lower", "upper")),
        ("outputs", ("name", "unit", "warning_level", "critical_level")),
    ):
        for attribute in attributes:
            own, others = (
                [getattr(part, attribute) for part in getattr(x, what)] for x in (d, other)
            )
            if own != others:
                raise ValueError(
                    f"rivals need the same {what}: {attribute.replace('_', ' ')} of {rival.name} "
                    f"is {', '.join(map(str, own))}; of {first.name} {', '.join(map(str, others))}"
                )


def _rival(given: RivalLike, spread: SpreadLike) -> Rival:
    """One rival, from a plant and ranges; the name tells both."""
    plant, ranges = given if isinstance(given, tuple) and len(given) == 2 else (given, None)
    ranges = by_name("ranges", ranges, "a dict of ranges by name")
    word, texts = plant, []
    if isinstance(plant, str):
        word, *texts = plant.split(",")
    for text in texts:
        name, _, value = (part.strip() for part in text.partition("="))
        if not (name and value):
            raise ValueError(
                f"rival {plant!r}: {text!r} is no range: a rival is PLANT,NAME=LOW:HIGH,..."
            )
        if name in ranges:
            raise ValueError(f"rival {plant!r}: the range of {name} is given twice")
        ranges = {**ranges, name: value}
    found = plant_from(word)
    title = word if isinstance(word, str) else found.definition.name
    told = plant if isinstance(plant, str) else title
    if "noise" in ranges:
        raise ValueError(f"rival {told!r}: the noise is that of the first plant's sensor")
    try:
        box = Uncertainty.of(found, spread, ranges)
    except ValueError as error:
        raise ValueError(f"rival {told!r}: {error}") from None
    shown = (f"{name}={_shown(value)}" for name, value in ranges.items())
    return Rival(",".join([title, *shown]), box)


def _shown(given: Range) -> str:
    """A range as a text."""
    return given if isinstance(given, str) else ":".join(f"{value:g}" for value in given)


def sampled_like(rivals: Sequence[Rival], records: Sequence[Record]) -> tuple[Rival, ...]:
    """The rivals with the sampling time of the records."""
    return tuple(
        eqx.tree_at(lambda r: r.box.plant, rival, sampled_as(records, rival.box.plant))
        if records
        else rival
        for rival in rivals
    )


def _from_rest(given: RecordLike, rival: Rival, initial_state: str) -> Record:
    """A record from the plant's initial state; ValueError for any other."""
    record = record_for(rival.box.plant.description, given)
    if initial_state == "auto" and not record.starts_at_initial_state:
        raise ValueError(
            f"{record.source or 'the record'} does not say that it starts at rest, which comparing "
            "rivals needs: if it does, say so with initial_state='known' (--initial-state known)"
        )
    return record


def judged(
    rivals: Sequence[Rival], records: Sequence[Record], room: tuple[int, int] = (0, 0)
) -> Discrimination:
    """The rivals after the records.

    Args:
        rivals: with the sensor and the sampling time of the records.
        records: from rest; of one with a gap in time, the part before the gap counts.
        room: number of records, and of samples in each, for which programs are compiled.
    """
    fits, count = [unplayed(rival) for rival in rivals], 0
    if records:
        whole = [_until_gap(record) for record in records]
        linear = np.zeros(records[0].inputs.shape[1], bool)
        for i, rival in enumerate(rivals):
            experiments = experiments_of(rival.box.plant, whole, True, linear)
            experiments = experiments.padded(*room)
            fits[i], count = fitted(rival, experiments), int(np.sum(experiments.valid))
    each = tuple(
        _judged(rival, fit, float(p), count)
        for rival, fit, p in zip(rivals, fits, probabilities(fits), strict=True)
    )
    return Discrimination(each, None, (np.nan, np.nan), np.nan, tuple(rivals), tuple(fits))


def _until_gap(record: Record) -> Record:
    """The part before the first gap in time: behind it the state is not known."""
    part = parts_of(record)[0]
    return replace(
        record,
        time=record.time[part], inputs=record.inputs[part], outputs=record.outputs[part],
    )  # fmt: skip


def _judged(rival: Rival, fit: Fit, probability: float, count: int) -> JudgedRival:
    """A rival's fit in the units of its quantities."""
    reach = HALF_95 * jnp.sqrt(jnp.diagonal(jnp.linalg.inv(fit.information)))
    low, value, high = (rival.values(fit.z + part * reach) for part in (-1.0, 0.0, 1.0))
    estimate = {
        name: Interval(float(value[i]), float(high[i] - low[i]) / 2)
        for i, name in enumerate(rival.box.names)
    }
    misfit = float(fit.misfit)
    factor = float(np.sqrt(misfit / count)) if count else np.nan
    explains = not count or chi2_tail(count, misfit) > RARE
    return JudgedRival(rival.name, probability, factor, explains, estimate)


def with_experiment(found: Discrimination, steps: int, coast: int, seed: int) -> Discrimination:
    """The same with the experiment that tells the rivals apart, where a safe one is found."""
    starts = first_signals(found._rivals[0].box.plant, steps, seed)
    made = discriminating(found._rivals, found._fits, starts, coast)
    after, near = float(jnp.exp(jnp.min(made.log_bounds))), float(made.nearness)
    inputs = np.asarray(made.inputs) if np.isfinite(after) else None
    p = jnp.asarray([rival.probability for rival in found.rivals])
    bounds = (float(error_bound(p)), after)
    return replace(found, inputs=inputs, bounds=bounds, nearness=near)
