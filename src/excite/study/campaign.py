"""Campaigns: rounds of experiments until the parameters are known as precisely as asked.

Where several plants may be the true one, the first rounds play signals that tell them apart, until
one is chosen. A round then plays from rest: a policy, or, where there is none, a signal that is
safe for the whole spread; once there is an estimate or a prior, a signal redesigned for what is
known, where that is better. It ends with its last sample, or as soon as the running estimate
reaches every target and the free motion that would follow is predicted to be safe. After every
round all records are identified together. Where the state is carried over, the safe input is played
while the next round is decided, and a redesigned signal goes on from the state that it leads to.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..description import (
    RARE,
    PlantDescription,
    Spread,
    SpreadLike,
    names_of,
    require_whole,
    wrong_type,
)
from ..environment import run_episodes
from ..estimation import Status
from ..estimation.diagnosis import chi2_tail
from ..estimation.identify import RecordLike, identify, record_for
from ..estimation.prior import Prior, uniform_names
from ..estimation.prior_knowledge import PriorLike, plants_of, with_prior
from ..estimation.result import Identification
from ..excitation import Replay
from ..information import Past, Start, require_noise, running_information, start_after
from ..plant import AbstractPlant, Params
from ..plant.catalogue import PlantLike, plant_from, require_inputs
from ..policy import Policy, mismatch, read_policy
from ..policy.file import shipped_policies
from ..record import Record
from ..report.tables import html_table, text_table
from ..rig.contract import Interval, as_data
from ..rig.loop import COMPLETE
from ..safety import critical_levels, max_abs_output
from ..training.design import design
from ..training.redesign import Region
from .discrimination import Discrimination, RivalLike, judged, rivals_from, with_experiment
from .falsify import trained_in
from .knowledge import (
    contradicted,
    excluded,
    intervals_in,
    intervals_of_prior,
    noise_factors,
    region_of,
    told_by,
    unexplained,
)
from .monitor import Monitor
from .next_experiment import (
    COAST,
    Candidate,
    NextExperiment,
    best_of,
    candidate,
    candidates,
    played_as,
)
from .quantities import (
    AbstractQuantity,
    OneParameter,
    half_intervals,
    known_of,
    require_defined,
    slopes,
)
from .targets import (
    TargetLike,
    farthest,
    known_row,
    others_of,
    quantities_of,
    shares_of,
    targets_from,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REACHED = "every target is reached"
WHOLE = (COMPLETE, REACHED)  # ends of rounds that count in the budget

DISCRIMINATING, ROBUST, FOR_PRIOR = "signal for rivals", "robust", "signal for the prior"
NO_POLICY = "none"  # instead of a policy's name

DESIGNED = 50  # samples of a round without a policy, unless another number is given

_SHORT = 20  # samples of a round that tells rivals apart
_PADDED = 8  # rounds for which identification and the fits of rivals are compiled, or 16, 24, ...
_PLANTS = 32  # drawn to predict what a campaign reaches
_FEWER = 8  # where a signal is redesigned for each of them
_HARDLY = 0.98  # what all rounds that are left must make of an interval, or none is played


@dataclass(frozen=True)
class Round:
    """One round of a campaign.

    Attributes:
        num_samples: of the round.
        played: the policy, a robust or redesigned signal, or one that tells rivals apart.
        ended: why, as a sentence.
        nearness: largest measured output over its critical level.
        known: of each parameter and target, the estimate from this and all earlier rounds with half
            of its 95 % interval; empty where there is no estimate.
        status: of that estimate.
        decision: what follows, and why.
    """

    num_samples: int
    played: str
    ended: str
    nearness: float
    known: Mapping[str, Interval]
    status: str
    decision: str

    def to_dict(self) -> dict[str, Any]:
        """The round as JSON-ready data."""
        return {**dataclasses.asdict(self), "known": as_data(self.known)}


@dataclass(frozen=True)
class Expected:
    """What a campaign reaches on plants drawn from its spread or prior, by the Cramér-Rao bound.

    Attributes:
        samples: of each plant, until every target is reached; infinite where that takes more
            rounds than there are.
        shares: of each target, half of the interval over that allowed after all rounds, of the
            plant on which it is smallest.
        drawn_from: spread or prior.
        nearness: of each plant, the largest output over its critical level in a whole round of what
            is played first.
        nearness_after: the same, with the free motion after it.
    """

    samples: Float[np.ndarray, " plant"]
    shares: Mapping[str, float]
    drawn_from: str
    nearness: Float[np.ndarray, " drawn"]
    nearness_after: Float[np.ndarray, " drawn"]

    @property
    def missed(self) -> dict[str, float]:
        """Of targets that are reached on no plant, the share."""
        return {name: share for name, share in self.shares.items() if not share <= 1}

    def __str__(self) -> str:
        reached = np.isfinite(self.samples)
        if not reached.any():
            return f"no plant of the {self.drawn_from} reaches every target"
        count = len(self.samples)
        share, word = (0.9, "90 %") if count >= _PLANTS else (1.0, "largest")
        median, most = np.quantile(self.samples, [0.5, share], method="inverted_cdf")
        told = f"{median:.0f} samples" if np.isfinite(median) else "more rounds than there are"
        often = f"{most:.0f}" if np.isfinite(most) else "more rounds than there are"
        return f"{told} (median of {count} plants of the {self.drawn_from}; {word}: {often})"


class Campaign:
    """Rounds of experiments on one plant, until its parameters are known.

    `run` plays them on a rig. Whoever has a loop of their own asks and tells:

        >>> import excite as ex
        >>> campaign = ex.Campaign("aero2", {"D_p": "2%"}, policy="aero2", rounds=2)
        >>> while (policy := campaign.ask()) is not None:
        ...     record = ex.simulate("aero2", policy, params={"D_p": 0.0012}, seed=1)
        ...     told = campaign.tell(record)
        >>> campaign.reason
        'every target is reached'

    Attributes:
        declared: the plant as it was given.
        plant: as identification knows it: the declared one, or the rival that was chosen.
        discrimination: of the rivals, when they were last compared; None where there are none.
        targets: what is to be known, and how precisely.
        policy: that is played in the first round; None for a robust signal.
        steps: samples of a round; a robust signal has half as many.
        redesign: whether signals are redesigned for later rounds.
        spread: of the parameters before the campaign.
        prior: what else was known of them.
        most_rounds, most_samples: the budget; samples are not limited where that is None.
        coast: samples of free motion after an end that must be safe.
        carry: samples of the safe input after which the next round goes on; None for rest.
        records: of all rounds, from rest; one that went on is in the record of the one before.
        rounds: what each of them brought.
        result: estimate from all records; None before the first.
        reason: why the campaign ended; empty before its end.
        playing: what `ask` returned last, as `Round` names it; empty after the round.
        next: how the coming round was chosen, after the first estimate.
        interrupted: what interrupted `campaign`, such as a signal; empty if nothing did.
        haste: by how much smaller than asked the running intervals must be to end a round, because
            one ended too early.
        prediction: what was expected before the first round, as a sentence; empty if that was not
            computed.
        unsafe: a sentence where the first round, or the free motion after it, was expected to reach
            a critical level.
    """

    def __init__(
        self,
        plant: PlantLike,
        target: TargetLike,
        *,
        policy: str | Path | Policy | None = None,
        steps: int | None = None,
        spread: SpreadLike | None = None,
        rounds: int = 10,
        samples: int | None = None,
        coast: int | None = None,
        carry: int | None = None,
        redesign: bool = True,
        rivals: Sequence[RivalLike] = (),
        prior: PriorLike | Sequence[PriorLike] | None = None,
    ) -> None:
        """A campaign before its first round.

        Args:
            plant: its name, `path/to/file.py:ClassName`, the plant or its class.
            target: half of a 95 % interval by quantity: "1%" of the estimate, a number in the
                quantity's unit, or with a unit, "0.1 deg". A quantity is a parameter; a function
                of the parameters, or its file `path/to/file.py:function`; or an output that is
                predicted for an experiment from rest, `pitch@2:step.csv` after 2 s of the inputs
                in a file, or of a signal by name.
            policy: to be played, its name or file; default the shipped one of the plant's name
                and `-wide`, or else of the plant's name. "none", or a plant without one, begins
                with a robust signal, which `design` makes safe for the spread.
            steps: samples of a round without a policy, default 50; the first has half as many,
                because little is known of the plant.
            spread: of the parameters; default that of the policy's training, or 0.3.
            rounds: that are played at most.
            samples: of all rounds together at most, and so the time on the plant; a round that
                could take more does not begin.
            coast: samples after a round's end in which the plant must be safe; default that of the
                policy's training, or 100; at least `carry`.
            carry: samples of the safe input in which a round is decided. The next one then goes
                on from the state that they lead to, with a redesigned signal that is safe from
                there. Default is rest before every round, as where there is no such signal.
            redesign: whether signals are redesigned for later rounds, and played where they reach
                the targets with fewer samples than what was played first; see `next_experiment`.
            rivals: other plants of which one may be the true one, as for `discriminate`. Signals
                tell them apart first, in rounds of 20 samples.
            prior: what is known beside the spread, as for `identify`: the run folder of earlier
                records, or distributions by parameter. The first round then plays a signal that
                is designed for it, where that is better than the policy; without a policy no
                robust signal is needed. Not with rivals.

        Raises:
            ValueError: for a name or a value that is not allowed.
            TypeError: for an argument of another type.
        """
        self.declared = self.plant = plant_from(plant)
        require_inputs(self.plant)
        require_noise(self.plant)
        description = self.plant.description
        self.targets = targets_from(self.plant, target)
        require_whole("rounds", rounds, 1, 1000)
        self.most_rounds, self.most_samples = rounds, samples
        self.policy = _policy(policy, description)
        if steps is not None and self.policy is not None:
            raise ValueError("steps are for rounds without a policy: a policy has its own")
        self.steps = self.policy.layout.num_steps if self.policy else steps or DESIGNED
        require_whole("steps", self.steps if steps is None else steps, 4)
        if samples is not None:
            require_whole("samples", samples, 1)
            if samples < self.steps:
                raise ValueError(
                    f"a budget of {samples} samples is shorter than a round of {self.steps}: give "
                    f"at least {self.steps} (--samples)"
                )
        usual, _, usual_coast = trained_in(self.policy, self.plant)
        self.spread = Spread.of(usual if spread is None else spread)
        self.coast = coast if coast is not None else usual_coast or COAST
        require_whole("coast", self.coast, 0)
        if carry is not None:
            require_whole("carry", carry, 1, 10_000)
            if not redesign:
                raise ValueError("carry needs redesigned signals: others begin at rest")
            self.coast = max(self.coast, carry)
        self.carry, self._is_at_rest = carry, True
        self.redesign = redesign
        self.prior = None if prior is None else self._normal(prior, bool(rivals))
        self.discrimination: Discrimination | None = None
        if isinstance(rivals, str) or not isinstance(rivals, Sequence):
            raise wrong_type("rivals", rivals, "a list of plants")
        if rivals:
            self.discrimination = judged(rivals_from([self.plant, *rivals], self.spread), [])
            for rival in self.discrimination.rivals:
                for name in [t.name for t in self.targets if isinstance(t.quantity, OneParameter)]:
                    if name not in rival.estimate:
                        raise ValueError(f"rival {rival.name} has no parameter {name!r}, a target")
            for own in self.discrimination.rival_plants:
                for quantity in others_of(own, self.targets):
                    require_defined(quantity, own)
        self.records: list[Record] = []
        self.rounds: list[Round] = []
        self.result: Identification | None = None
        self.next: NextExperiment | None = None
        self.reason, self.interrupted, self.prediction, self.unsafe = "", "", "", ""
        self.haste, self.playing = 1.0, ""
        self._counts_prior = True
        if self.prior is not None:
            if told := excluded(self.plant, self._before, self.spread, "the prior"):
                raise ValueError(f"{told}, or another prior")
            if max(shares_of(self.targets, self.known).values()) <= 1:
                raise ValueError("every target is reached by the prior: ask for more")

    def _normal(self, given: PriorLike | Sequence[PriorLike], has_rivals: bool) -> Prior | None:
        """All priors as one, which is read once; ValueError for one that cannot be used."""
        if has_rivals:
            raise ValueError("a prior is of one plant: it does not go with rivals")
        bounded, joint, _ = with_prior(self.plant, given, self.plant.nominal, {}, {})
        if names := uniform_names(bounded):
            raise ValueError(
                "a campaign takes normal and lognormal priors, and no uniform one: got "
                + ", ".join(names)
            )
        return joint

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about policy and plant, and where the plant does not explain the records."""
        told = [*_about_policy(self.policy, self.plant, self.spread), *unexplained(self.result)]
        is_declared = self.plant.description.hash == self.declared.description.hash
        told += [self.unsafe] if self.unsafe and is_declared else []
        if self.result is not None and is_declared:
            region = region_of(self.plant, self.result, self.spread)
            told += [sentence] if (sentence := excluded(self.plant, region, self.spread)) else []
        if self.next is not None and self.next.chosen is None:
            told.append(f"{self.next.decision}; the {self._opening_told} is played all the same")
        return tuple(told)

    @cached_property
    def _before(self) -> Region:
        """Plants that are possible before the first round, by prior and spread."""
        return region_of(self.declared, self.prior or {}, self.spread)

    @cached_property
    def _of_prior(self) -> Region:
        """What the prior alone tells: nothing without one."""
        return told_by(self.declared, self.prior or {})

    @cached_property
    def opening(self) -> Policy | Replay:
        """What the first round plays: the policy, a signal for the prior, or a robust one.

        Designing a robust signal takes minutes.

        Raises:
            ValueError: for a signal that reaches a critical level on a plant of the spread, or on
                one that the prior leaves possible.
        """
        if self.policy is not None:
            return self.policy
        if self.prior is not None:
            made = candidates(
                self.plant, self._before, self.targets, None,
                num_steps=self.steps, coast=self.coast,
            )[-1]  # fmt: skip
            if not made.is_safe:
                raise ValueError(
                    "no safe first signal was found for the prior; a narrower one, fewer steps or "
                    "a policy may help"
                )
            return made.excitation
        steps, spread = self.steps // 2, self.spread.setting
        made = design(self.declared, steps=steps, spread=spread, coast=self.coast)
        if made.violations:
            raise ValueError(
                f"no safe first signal was found: the best one reaches a critical level on "
                f"{made.violations} of {made.evaluations} plants of the spread {self.spread}; a "
                "smaller spread, fewer steps or a policy may help"
            )
        return made.excitation

    @property
    def continues(self) -> bool:
        """Whether what `ask` returned begins where the last round ended, and not at rest.

        It must begin at the last sample of the record that was told. Its first `carry` samples are
        the safe input, which is to be played while `ask` computes. The next record that is told
        is that of all samples since rest.
        """
        return self._past is not None

    def rest(self) -> None:
        """The plant has come to rest: the next round begins there."""
        if not self._is_at_rest:
            self._is_at_rest, self.next, self.playing = True, None, ""

    @property
    def longest(self) -> int:
        """Most samples of one record, which is that of all rounds since rest."""
        if self.carry is None:
            return self.steps
        longest = min(_PADDED, self.most_rounds) * (self.steps + self.carry)
        return longest if self.most_samples is None else min(longest, self.most_samples)

    @property
    def _past(self) -> Past | None:
        """What was played since rest, where the next round goes on from there."""
        if self.carry is None or self._is_at_rest or self.is_undecided:
            return None
        if self.plant.delay(self.plant.nominal) is not None:  # of a rival
            return None
        played, room, coming = self.records[-1].inputs[:-1], self.longest, self.carry + self.steps
        if len(played) + coming > room or not self._fits(self.num_samples + self.carry):
            return None
        return Past.of(played, self.carry, room)

    def ask(self) -> Policy | Replay | None:
        """What to play in the next round; None once the campaign has ended.

        It begins at rest, unless it `continues`.

        That is the policy or a robust signal; after the first estimate, a signal redesigned for
        what is known, where that is better. No signal is redesigned where the plant does not
        explain the records. While several rivals are possible, it is a signal that tells them
        apart.
        """
        if self.reason:
            return None
        if self.discrimination is not None and self.is_undecided:
            if self.discrimination.inputs is None:
                self.discrimination = with_experiment(
                    self.discrimination, _SHORT, self.coast, seed=len(self.rounds)
                )
            if self.discrimination.inputs is None:
                self.reason = self.discrimination.decision
                return None
            self.playing = DISCRIMINATING
            return self.discrimination.excitation
        if not self.continues:
            self.rest()
        if self.redesign and self.next is None:
            self.next = self._next()
            if self.continues and (self.next is None or self.next.chosen is None):
                self.rest()
                self.next = self._next()
        chosen = None if self.next is None else self.next.chosen
        is_other = self.plant.description.hash != self.declared.description.hash
        if self.next is not None and chosen is None and is_other:
            self.reason = self.next.decision  # the opening may be unsafe on this plant
            return None
        if is_other and not self.redesign:
            made_for, own = self.declared.description.name, self.plant.description.name
            own += " with other constants" * (own == made_for)
            self.reason = f"the {self._opening_told} is for {made_for}, not for {own}"
            return None
        if told := self._nothing_more():
            self.reason = told
            return None
        self.playing = self._opening_name if chosen is None else chosen.name
        self.playing += ", without rest" * self.continues
        return self.opening if chosen is None else chosen.excitation

    def _fits(self, played: int) -> bool:
        """Whether the budget has samples for another round after so many."""
        longest = _SHORT if self.is_undecided else self.steps
        return self.most_samples is None or played + longest <= self.most_samples

    @property
    def _whole_rounds(self) -> int:
        """Rounds of full length in the budget."""
        return self._rounds_after(0, 0)

    def _rounds_after(self, rounds: int, samples: int) -> int:
        """Rounds of full length that are left in the budget after so many."""
        left = self.most_rounds - rounds
        if self.most_samples is None:
            return left
        return min(left, (self.most_samples - samples) // self.steps)

    @property
    def is_undecided(self) -> bool:
        """Whether several rivals are still possible."""
        return self.discrimination is not None and self.discrimination.chosen is None

    def _next(self) -> NextExperiment | None:
        """The candidates of the coming round; None where no estimate is to be trusted."""
        if self.result is None and (self.rounds or not self._may_redesign_first):
            return None
        if self.result is not None and (unexplained(self.result) or self.result.held):
            return None
        made = self._candidates(self._region, self._past)
        best = best_of(made, self.targets)
        return NextExperiment(self.plant, self.known, self.targets, tuple(made), best)

    @property
    def _may_redesign_first(self) -> bool:
        """Whether the first round may play a signal for the prior in place of the policy."""
        return self.redesign and self.prior is not None and self.policy is not None

    def _candidates(self, region: Region, past: Past | None = None) -> list[Candidate]:
        """What could be played, given what is known: a redesigned signal, or from rest others."""
        opening = None if past is not None else (self._opening_name, self.opening)
        return candidates(
            self.plant, region, self.targets, opening,
            num_steps=self.steps, coast=self.coast, seed=len(self.rounds), past=past,
        )  # fmt: skip

    @property
    def _region(self) -> Region:
        """What is known, from all rounds and before them."""
        if self.result is None:
            return self._before
        return region_of(self.plant, self.result, self.spread)

    def _nothing_more(self) -> str:
        """A sentence where all rounds that are left would tell hardly more; else nothing.

        Each of them is taken to bring what the coming one is predicted to bring.
        """
        if self.result is None or unexplained(self.result):
            return ""
        left = self._rounds_after(sum(r.ended in WHOLE for r in self.rounds), self.num_samples)
        coming, now = None if self.next is None else self.next.chosen, self._region
        if coming is None:
            coming = candidate(
                self.plant, now, self.targets, self._opening_name, self.opening,
                self.steps, self.coast, len(self.rounds),
            )  # fmt: skip
        params, inputs = self.plant.Params(*now.center), jnp.asarray(coming.inputs)
        past = self._past
        start = None if past is None else start_after(self.plant, params, past)
        gained = running_information(self.plant, params, inputs, start)[-1]
        noise = float(np.nanmin(noise_factors(self.plant, self.result)))  # the intervals know it
        gained = gained / max(noise, 1e-3) ** 2
        then = Region(now.center, now.information + left * gained)
        others = others_of(self.plant, self.targets)
        before, after = (
            shares_of(self.targets, intervals_in(self.plant, region, others))
            for region in (now, then)
        )
        name, share = max(after.items(), key=lambda item: item[1])
        if not 1 < share < math.inf or share < _HARDLY * before[name]:
            return ""
        target = next(t for t in self.targets if t.name == name)
        more, known = f"{left} more round{'s' * (left != 1)}", self.known
        reached = shares_of(self.targets, known)[name]
        told = f"known to {target.at(reached)}" if reached < math.inf else "not identifiable"
        return f"nothing more can be had: {more} would hardly tell more of {name}, which is {told}"

    def tell(
        self,
        record: RecordLike,
        ended: str = COMPLETE,
        unsafe: bool = False,
        goes_on: bool = False,
        played: str = "",
    ) -> Round:
        """Takes the record of a round, identifies, and decides whether another one follows.

        Args:
            record: of the round, from rest, its file or its DataFrame. Of one that continues,
                that of the rounds before it, too, since rest.
            ended: why the round ended.
            unsafe: whether it ended because a level was near, or no declared plant explains it.
            goes_on: whether the next record exists already, so that reached targets end nothing.
            played: what the round played, as `Round` names it; default what `ask` returned last.

        Raises:
            ValueError: where the campaign has ended, or for a record of another plant.
        """
        if self.reason:
            raise ValueError(f"the campaign has ended: {self.reason}")
        d = self.plant.description
        record = record_for(d, record)
        if len(record.time) < 2:
            raise ValueError("the record of a round needs at least two samples: got one")
        if record.metadata.get("starts_at_initial_state") is False:
            raise ValueError("a round begins at rest, and this record says that it does not")
        interval, dt = float(np.median(np.diff(record.time))), float(self.plant.dt)
        if not 0.9 < interval / dt < 1.1:
            raise ValueError(f"a round is sampled every {dt:g} s: got one of {interval:g} s")
        before = 0
        if self._goes_on(record):
            before = len(self.records.pop().time) - 1
        elif self.playing and self.continues and not played:
            raise ValueError(
                "this round goes on from the last one: tell the record of everything since rest, "
                "which begins with the same samples as the last one, or call rest() before ask()"
            )
        self.records.append(record)
        self._is_at_rest = self.carry is None
        played, structure = played or self.playing or self._opening_name, ""
        others = self.discrimination is not None and any(self.discrimination.fitted_beside)
        if self.is_undecided or others:  # these are fitted to all records, too
            structure = self._compare()
        count, status = len(record.time) - 1 - before, structure
        if not self.is_undecided:
            status = self._identify()
            is_doubtful = status != Status.SUCCESSFUL.sentence or not self._is_explained()
            if self.discrimination is not None and not structure and is_doubtful:
                structure = self._compare()  # the record may contradict an earlier choice
                status = structure if self.is_undecided else self._identify()
        sizes = np.abs(record.outputs[before:]) / critical_levels(d)[None]
        near = float(np.nanmax(sizes, initial=0.0))
        known = self.known if self.result is not None else {}  # a prior is no estimate
        shares = shares_of(self.targets, known)
        if ended == REACHED:  # says the running estimate; the intervals of all records may be wider
            self.haste = max([self.haste, *(s for s in shares.values() if math.isfinite(s))])
        if goes_on:
            self.reason = ""
        elif unsafe or near >= 1:
            self.reason = f"unsafe: {ended if unsafe else 'a critical level was reached'}"
        elif told := self._contradicted():
            self.reason, known = told, self.known
        elif shares and max(shares.values()) <= 1:
            self.reason = REACHED
        elif self.discrimination is not None and not self.discrimination.is_explained:
            self.reason = structure
        elif sum(e in WHOLE for e in [*(r.ended for r in self.rounds), ended]) >= self.most_rounds:
            self.reason = "all rounds are played" + f"; {structure}" * self.is_undecided
        elif self.most_samples is not None and not self._fits(self.num_samples + count):
            self.reason = f"the budget of {self.most_samples} samples is used up"
        if self.reason and self.result is not None and unexplained(self.result):
            self._look_for_causes(self.result)
        if not shares:
            missing = f"there is no estimate yet ({status})"
        elif max(shares.values()) <= 1:  # the next round was played for other targets
            missing = "every target is reached already"
        else:
            missing = farthest(shares)
        decision = f"end: {self.reason}" if self.reason else f"go on: {missing}"
        if structure and not self.is_undecided:
            decision = f"{structure}; {decision}"
        told = Round(count, played, ended, near, known, status, decision)
        self.rounds.append(told)
        self.next, self.playing = None, ""
        return told

    def _goes_on(self, record: Record) -> bool:
        """Whether a record is the last one, and more."""
        if self.carry is None or not self.records:
            return False
        last = self.records[-1]
        count = len(last.time)
        return len(record.time) > count and all(
            np.array_equal(*pair, equal_nan=True)
            for pair in (
                (record.outputs[:count], last.outputs),
                (record.inputs[: count - 1], last.inputs[:-1]),
            )
        )

    def _compare(self) -> str:
        """Compares the rivals; the plant is the one that is chosen. Returns the decision."""
        if self.discrimination is None:
            return ""
        before = self.discrimination.chosen
        self.discrimination = self.discrimination.after(self.records, self._room(_SHORT))
        now = self.discrimination.chosen
        if now is None or before is None or now.name != before.name:
            self.result = None
        self.plant = self.discrimination.plant or self.plant
        return self.discrimination.decision

    def _identify(self) -> str:
        """Identifies all records together; returns the status."""
        try:
            result = self._identified(self.prior)
        except ValueError as error:  # this record tells nothing; another one may
            return str(error)
        self.result = result if result.is_usable else self.result
        return result.status

    def _identified(self, prior: Prior | None, causes: bool = False) -> Identification:
        """The estimate from all records together."""
        uncertain, is_free = (
            ({}, False) if self.discrimination is None else self.discrimination.fitted_beside
        )
        return identify(
            self.records, self.plant, start=self._start(), prior=prior, uncertain=uncertain,
            initial_state="free" if is_free else "known", room=self._room(self.steps),
            causes=causes,
        )  # fmt: skip

    def _room(self, steps: int) -> tuple[int, int]:
        """Number and length of records for which programs are compiled: whole rounds of `steps`."""
        longest = max(len(record.time) for record in self.records) - 1
        if self.carry is not None and not self.is_undecided:
            return len(self.records), self.longest + 1 + self.plant.has_feedthrough
        count = _PADDED * math.ceil(len(self.records) / _PADDED)
        return count, steps * math.ceil(longest / steps) + 1 + self.plant.has_feedthrough

    def _look_for_causes(self, result: Identification) -> None:
        """Looks for likely causes of the residual, which takes longer than a decision.

        With a prior there are none: it may explain what they explain.
        """
        if self.prior is not None or len(result.fitted) < len(self.records):
            return
        with contextlib.suppress(ValueError):
            found = self._identified(None, causes=True)
            if found.is_usable:
                self.result = dataclasses.replace(
                    result, suspects=found.suspects, verdict=found.verdict
                )

    def _contradicted(self) -> str:
        """A sentence where the records contradict the prior, which then counts no more."""
        if self.prior is None or self.result is None:
            return ""
        alone = cache(lambda: self._identified(None))
        if not (names := contradicted(self.prior, self.result, alone)):
            return ""
        with contextlib.suppress(ValueError):
            if alone().is_usable:
                self.result, self._counts_prior = alone(), False
        still = ", which the estimate still counts" * self._counts_prior
        return f"the records contradict the prior of {', '.join(names)}{still}"

    def _is_explained(self) -> bool:
        """Whether the residual is noise, of the declared size where there are rivals.

        Without rivals the declared size may be wrong, and nothing else could be chosen.
        """
        if self.result is None or self.result.misfit_factor > 1:
            return False
        if self.discrimination is None:
            return True
        sd = np.asarray(self.plant.sensor.sd)[None]
        sizes = np.concatenate([f.computed["residual"] / sd for f in self.result.fitted]) ** 2
        return chi2_tail(int(np.isfinite(sizes).sum()), float(np.nansum(sizes))) > RARE

    @property
    def _opening_name(self) -> str:
        if self.policy is not None:
            return "policy"
        return ROBUST if self.prior is None else FOR_PRIOR

    @property
    def _opening_told(self) -> str:
        return "robust signal" if self._opening_name == ROBUST else self._opening_name

    @property
    def known(self) -> dict[str, Interval]:
        """Of each parameter and target, the estimate and half of its 95 % interval.

        It is that from all rounds, or before them that of the prior; empty without one.
        """
        others = others_of(self.plant, self.targets)
        if self.result is not None:
            return known_of(self.plant, self.result, others)
        return self._known_before(others)

    def _known_before(self, others: Sequence[AbstractQuantity]) -> dict[str, Interval]:
        """What the prior tells of each parameter and of other quantities; empty without one."""
        if self.prior is None:
            return {}
        return intervals_of_prior(self.declared, self._of_prior, others)

    def _start(self) -> dict[str, float] | None:
        """Where the next identification begins."""
        if self.result is not None:
            return dict(self.result.params)
        chosen = None if self.discrimination is None else self.discrimination.chosen
        names = names_of(self.plant.definition.parameters)
        return chosen and {name: chosen.estimate[name].estimate for name in names}

    def monitor(self, waits: bool = False) -> Monitor:
        """A judge of the next rounds until rest, while they run; see `Monitor`."""
        before, room = self.prior if self.result is None else self.result, 1 / self.haste
        return Monitor(
            self.plant, before, self.targets, self.longest, self.coast, waits, self.spread, room,
            ends_at_once=self.carry is None,
        )  # fmt: skip

    @cached_property
    def expected(self) -> Expected:
        """What the campaign will reach; computed once, in seconds, or a minute without a policy.

        With a policy, every round plays it. Without one, or where that reaches too little, all
        rounds after the first play what is redesigned for each plant, and with a prior the first
        one what is redesigned for it. With `carry` each of them is taken to bring what the second
        one brings, which goes on from the first.
        """
        redesigns = self._may_redesign_first or (self.redesign and self._whole_rounds > 1)
        if self.policy is None:
            return self._expected(redesigns)
        found = self._expected(False)
        if not (found.missed and redesigns):
            return found
        other = self._expected(True)
        least = {name: min(share, found.shares[name]) for name, share in other.shares.items()}
        return dataclasses.replace(
            other, shares=least, nearness=found.nearness, nearness_after=found.nearness_after
        )

    def _expected(self, redesigns: bool) -> Expected:
        """The same, with redesigned signals after the first round or without them."""
        excitation, steps = played_as(self.opening)
        count = _FEWER if redesigns or self.policy is None else _PLANTS
        keys = jax.random.split(jax.random.key(0), count)
        drawn = None if self.prior is None else plants_of(self.plant, self.prior, self.spread)
        episodes = run_episodes(
            self.plant, excitation, steps, self.spread, keys, coast=self.coast, prior=drawn
        )
        first = later = episodes.trajectory.inputs
        if redesigns and self._may_redesign_first:
            made = self._candidates(self._before)[-1]
            if made.is_safe:
                first = later = jnp.broadcast_to(jnp.asarray(made.inputs), first.shape)
        goes_on = None
        if redesigns and self._whole_rounds > 1:
            made = [
                self._redesigned(jax.tree.map(lambda x, i=i: x[i], episodes.params), first[i])
                for i in range(count)
            ]
            later = jnp.stack([inputs for inputs, _ in made])
            if self.carry is not None:
                goes_on = jnp.asarray([is_safe for _, is_safe in made])
        asked = [t.quantity for t in self.targets]
        outlook = _halves(
            self.plant, episodes.params, first, later, self._whole_rounds, asked,
            self._of_prior.information, goes_on,
        )  # fmt: skip
        values, halves = map(np.asarray, outlook)
        shares = {
            t.name: t.share(values[:, None, i], halves[..., i]) for i, t in enumerate(self.targets)
        }
        is_reached = np.max(list(shares.values()), axis=0) <= 1  # plant, sample
        samples = np.where(is_reached.any(axis=1), is_reached.argmax(axis=1) + 1.0, np.inf)
        best = {name: float(np.nanmin(s[:, -1])) for name, s in shares.items()}
        levels = critical_levels(self.plant.description)
        largest = max_abs_output(episodes.trajectory.outputs), episodes.max_abs_output
        sizes = [np.max(np.asarray(own) / levels, axis=1) for own in largest]
        return Expected(samples, best, "spread" if self.prior is None else "prior", *sizes)

    def _redesigned(
        self, params: Params, first: Float[Array, "time input"]
    ) -> tuple[Float[Array, "step input"], bool]:
        """What would be played on a plant after the first round, and whether it was found.

        Otherwise it is the first one again.
        """
        gained = running_information(self.plant, params, first)[-1]
        region = Region(jnp.stack(list(params)), self._before.information + gained)
        past = None if self.carry is None else Past.of(first, self.carry)
        made = self._candidates(region, past)[-1]
        again = np.resize(first, made.inputs.shape)
        return jnp.asarray(made.inputs if made.is_safe else again), made.is_safe

    def require_reachable(self, brakes: bool = False) -> None:
        """Predicts what is reached, and whether the first round is safe.

        Args:
            brakes: whether a guard brakes after a round, in place of the safe input.

        Raises:
            ValueError: where no plant of the spread reaches the targets.
        """
        if far := self.expected.missed:
            name, share = max(far.items(), key=lambda item: item[1])
            target = next(t for t in self.targets if t.name == name)
            count = self._whole_rounds
            more = ["rounds (--rounds)"] * (count == self.most_rounds)
            if self.most_samples is not None and self.most_samples // self.steps == count:
                more.append("samples (--samples)")
            more = " and ".join(more) + " or longer rounds (--steps)" * (self.policy is None)
            raise ValueError(
                f"no campaign of at most {count} round{'s' * (count != 1)} of {self.steps} samples "
                f"reaches {name} to {target}: at best {target.at(share)}; ask for less, or for "
                f"more {more}"
            )
        self.prediction = str(self.expected)
        self.unsafe = self._unsafe(brakes)

    def _unsafe(self, brakes: bool) -> str:
        """A sentence where the first round reaches a level on drawn plants; else nothing."""
        what, sizes = f"a whole round of the {self._opening_told}", self.expected.nearness
        if np.all(sizes < 1) and not brakes:
            what, sizes = f"the free motion after {what}", self.expected.nearness_after
        count = np.sum(~(sizes < 1))
        if not count:
            return ""
        instead = "a smaller spread or fewer steps (--spread, --steps)"
        if self.policy is not None:
            instead = "another policy or none (--policy)"
            if self.policy.guard is not None and self.carry is None and not brakes:
                instead += ", or let its guard brake (--guard)"
        most = f"reaches up to {100 * np.max(sizes):.0f} % of a critical level, on"
        if not np.isfinite(sizes).all():
            most = "diverges or reaches a critical level on"
        return (
            f"{what} {most} {count} of {len(sizes)} plants of the {self.expected.drawn_from}: "
            f"give {instead}"
        )

    @property
    def num_samples(self) -> int:
        """Played in all rounds."""
        return sum(r.num_samples for r in self.rounds)

    def to_dict(self) -> dict[str, Any]:
        """The campaign as JSON-ready data."""
        return {
            "plant": self.plant.description.name,
            "plant_hash": self.declared.description.hash,
            "policy_hash": self.policy.hash if self.policy else "",
            "steps": 0 if self.policy else self.steps,
            "targets": {t.name: str(t) for t in self.targets},
            "allowed": self._allowed(),
            "units": {q.name: q.unit for q in quantities_of(self.plant, self.targets)},
            "spread": self.spread.setting,
            "most_rounds": self.most_rounds,
            **({} if self.most_samples is None else {"most_samples": self.most_samples}),
            "coast": self.coast,
            **({} if self.carry is None else {"carry": self.carry}),
            "redesign": self.redesign,
            "prior": as_data(self._known_before(())),
            "rivals": {} if self.discrimination is None else self.discrimination.plants,
            "structure": self.discrimination and self.discrimination.to_dict(),
            "warnings": list(self.warnings),
            "expected": self.prediction,
            **({"unsafe": self.unsafe} if self.unsafe else {}),
            "reason": self.reason,
            "playing": self.playing,
            "interrupted": self.interrupted,
            "estimate": as_data(self.known),
            "num_samples": self.num_samples,
            "rounds": [r.to_dict() for r in self.rounds],
        }

    def _allowed(self) -> dict[str, float]:
        """Of each target, half of the interval that is allowed; empty without an estimate."""
        known = self.known
        return {t.name: float(t.allowed(known[t.name].estimate)) for t in self.targets if known}

    header = ("parameter", "estimate", "± 95 %", "relative", "target", "")

    @property
    def title(self) -> str:
        """What was played, and how it ended."""
        count = len(self.rounds)
        played = f"{self.num_samples} samples in {count} round{'s' * (count != 1)}"
        return f"{self.plant.description.name}: {self.reason or 'not ended'} ({played})"

    def rows(self) -> list[list[str]]:
        """Rows of the table: one per parameter, and per other target."""
        known = self.rounds[-1].known if self.rounds else {}
        shares, rows = shares_of(self.targets, known), []
        for quantity in quantities_of(self.plant, self.targets):
            share = shares.get(quantity.name)
            reached = "" if share is None else "reached" if share <= 1 else "missed"
            rows.append([*known_row(quantity, self.targets, known), reached])
        return rows

    def round_rows(self) -> list[list[str]]:
        """Rows of the table of rounds."""
        rows = []
        for i, r in enumerate(self.rounds, 1):
            is_told = r.ended == COMPLETE or r.ended in r.decision
            ended = "ended early by the running estimate" if r.ended == REACHED else r.ended
            decision = r.decision if is_told else f"{ended}; {r.decision}"
            level = f"{100 * r.nearness:.0f} %"
            rows.append([str(i), r.played, str(r.num_samples), level, decision])
        return rows

    round_header = ("round", "played", "samples", "of the level", "decision")

    def __repr__(self) -> str:
        """The tables that `excite campaign` prints."""
        tables = [
            text_table(self.title, self.header, self.rows()),
            text_table("rounds", self.round_header, self.round_rows()),
        ]
        if self.discrimination is not None and self.is_undecided:
            rows = self.discrimination.rows()
            tables.append(text_table("rivals", self.discrimination.header, rows))
        told = [f"warning: {sentence}" for sentence in self.warnings]
        if self.prediction:
            without = ", without the rounds for rivals" * (self.discrimination is not None)
            told.append(f"expected before the first round{without}: {self.prediction}")
        tables += [textwrap.fill(sentence, 80) for sentence in told]
        return "\n".join(tables)

    def _repr_html_(self) -> str:
        """The same for a notebook."""
        rounds = html_table("rounds", self.round_header, self.round_rows())
        return html_table(self.title, self.header, self.rows()) + rounds

    def knowledge(self) -> tuple[Int[np.ndarray, " sample"], Float[np.ndarray, "sample quantity"]]:
        """Half of the 95 % intervals after each sample, by the Cramér-Rao bound.

        Of each parameter, and of what else the targets are about, at the final estimate, for the
        inputs that were played; infinite before a parameter is identifiable.
        """
        if self.result is None:
            raise ValueError("the campaign has no estimate yet")
        params = self.plant.Params(*self.result.params.values())
        before, parts = jnp.zeros((len(params), len(params))), []
        if self.prior is not None and self._counts_prior:  # otherwise the plant may be a rival's
            before = self._of_prior.information
        for record in self.records:
            inputs = jnp.asarray(record.inputs[:-1])
            parts.append(running_information(self.plant, params, inputs) + before[None])
            before = parts[-1][-1]
        quantities = quantities_of(self.plant, self.targets)
        halves = half_intervals(quantities, self.plant, params, jnp.concatenate(parts))
        return np.arange(1, len(halves) + 1), np.asarray(halves)

    def plot(self) -> Figure:
        """What was known after each sample, over what was asked."""
        from ..report.figures import knowledge_figure

        samples, halves = self.knowledge()
        bounds = dict(zip(self.known, halves.T, strict=True))
        rounds = [r.to_dict() for r in self.rounds]
        return knowledge_figure(self.title, samples, bounds, rounds, self._allowed())


@eqx.filter_jit
def _halves(
    plant: AbstractPlant,
    params: Params,
    first: Float[Array, "plant time input"],
    later: Float[Array, "plant step input"],
    rounds: int,
    quantities: Sequence[AbstractQuantity],
    known: Float[Array, "param param"],
    goes_on: Bool[Array, " plant"] | None,
) -> tuple[Float[Array, "plant quantity"], Float[Array, "plant sample quantity"]]:
    """Values, and half of each interval after every sample of all rounds.

    Args:
        plant: with its sensor.
        params: of each plant.
        first: inputs of the first round.
        later: inputs of each other round.
        rounds: of the campaign.
        quantities: that are asked.
        known: information before the first round.
        goes_on: whether each other round begins in the state after the first one; None for rest.
    """

    def one(
        params: Params, first: Array, later: Array, goes_on: Array | None
    ) -> tuple[Array, Array]:
        opened = known[None] + running_information(plant, params, first)
        start = None
        if goes_on is not None:
            on = start_after(plant, params, Past.of(first, 0))
            state = jnp.where(goes_on, on.state, plant.initial_state)
            start = Start(state, jnp.where(goes_on, on.slope, 0.0))
        each = running_information(plant, params, later, start)
        before = opened[-1][None] + jnp.arange(rounds - 1)[:, None, None] * each[-1][None]
        others = (before[:, None] + each[None]).reshape((rounds - 1) * len(each), *each.shape[1:])
        values, _ = slopes(quantities, plant, params)
        running = jnp.concatenate([opened, others])
        return values, half_intervals(quantities, plant, params, running)

    return jax.vmap(one)(params, first, later, goes_on)


def usual_policy(plant: PlantDescription, guarded: bool = False) -> str:
    """Name of the shipped policy that a campaign plays: for a wide spread, where there is one.

    Args:
        plant: of the campaign.
        guarded: whether one that has a guard goes first.
    """
    shipped = shipped_policies()
    names = [n for n in (f"{plant.name}-wide", plant.name) if n in shipped]
    if guarded:
        names.sort(key=lambda name: read_policy(name).guard is None)
    return next(iter(names), NO_POLICY)


def _policy(given: str | Path | Policy | None, plant: PlantDescription) -> Policy | None:
    """The policy to play, if there is one; ValueError where it cannot be played on the plant."""
    given = usual_policy(plant) if given is None else given
    if isinstance(given, str) and given == NO_POLICY:
        return None
    found = given if isinstance(given, Policy) else read_policy(given)
    mismatch(found, plant)
    return found


def _about_policy(policy: Policy | None, plant: AbstractPlant, spread: Spread) -> tuple[str, ...]:
    """What is to be known of a policy that is played on this plant, with this spread."""
    if policy is None:
        return ()
    about = mismatch(policy, plant.description)
    trained = Spread.of(trained_in(policy, plant)[0])
    told = [] if about is None else [about]
    if spread.relative > trained.relative * (1 + 1e-9):
        told.append(
            f"the policy was trained for a spread of {trained}; outside it, it promises nothing"
        )
    return tuple(told)
