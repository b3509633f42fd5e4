"""Inputs, each where the next measurement is expected to tell most of the parameters.

They are the designs of a static task, or the inputs of a plant whose state is observed: there one
step is an experiment of its own. What is known is a set of particles: parameters as probable as the
outcomes so far leave them. Each outcome weights the particles; they are drawn again, and moved
without changing their distribution, in several stages where it tells much (sequential Monte Carlo;
N. Chopin, A sequential particle filter method for static models, 2002; moves of C. ter Braak, A
Markov chain Monte Carlo version of the genetic algorithm differential evolution, 2006). The next
design has the largest expected information gain of its own outcome, by nested Monte Carlo, among
designs at random: first anywhere and near the designs before, then near the best of these. It looks
one outcome ahead, and is not trained.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ..description import Input, Output, SpreadLike, names_of, require_whole
from ..excitation import AbstractExcitation
from ..information import require_bound
from ..plant import AbstractPlant, Params, floats
from ..plant.catalogue import PlantLike, plant_from, require_inputs
from ..plant.static import AbstractStaticTask, has_own_noise
from ..simulation import log_likelihood, next_measurement
from .prior import PriorPlants
from .prior_knowledge import PriorLike, plants_of

MYOPIC = "myopic"
"""Name of the excitation where a prior is given beside it."""

_SMALLEST = 1e-3  # distance of a design near another, in half ranges; the largest is 1
_HALVINGS = 25  # of the search for a power
_LEAST = -70.0  # logarithm of the smallest one
_IMPOSSIBLE = -1e30  # logarithm of the likelihood where it is none
_BEST = 8  # designs near which those of the next round lie
_JUMP = 0.2  # share of the moves by a whole difference of two particles, from mode to mode
_FINE = 1e-3  # part of a move that no difference has, in the particles' standard deviations


class Known(eqx.Module):
    """What the outcomes so far tell.

    Attributes:
        particles: normal coordinates of equally probable parameters.
        first: what was measured before the first design.
        designs: so far, by step; zero from step k.
        outcomes: of these.
        k: number of designs made.
        key: of the particles and the designs that are tried.
    """

    particles: Float[Array, "particle param"]
    first: Float[Array, " output"]
    designs: Float[Array, "time input"]
    outcomes: Float[Array, "time output"]
    k: Int[Array, ""]
    key: PRNGKeyArray

    @property
    def before(self) -> Float[Array, "time output"]:
        """What was measured before each design."""
        return jnp.concatenate([self.first[None], self.outcomes[:-1]])


@eqx.filter_jit
def posterior_particles(
    prior: PriorPlants,
    designs: Float[Array, "time input"],
    outcomes: Float[Array, "time output"],
    num_particles: int,
    num_moves: int,
    key: PRNGKeyArray,
) -> Float[Array, "particle param"]:
    """Normal coordinates of parameters as probable as a static task's outcomes leave them."""
    chosen = Myopic(prior, num_particles=num_particles, num_moves=num_moves, num_outcomes=1)
    state = chosen.init(prior.plant, len(designs), key)
    state = eqx.tree_at(lambda known: known.designs, state, designs)

    def learn(state: Known, outcome: Array) -> tuple[Known, None]:
        made = eqx.tree_at(lambda known: known.k, state, state.k + 1)
        return chosen.learnt(made, outcome), None

    return jax.lax.scan(learn, state, outcomes)[0].particles


class Myopic(AbstractExcitation):
    """Each design where its outcome is expected to tell most.

    The designs are those of a static task, or the inputs of a plant whose state is observed.

        >>> import jax
        >>> import excite as ex
        >>> from excite.plant import AbstractStaticTask, static_description
        >>> class Beacon(AbstractStaticTask):
        ...     definition = static_description(
        ...         "beacon",
        ...         designs=(ex.Input("place", "m", -4.0, 4.0),),
        ...         outcomes=(ex.Output("level", "", scale=1.0, noise_sd=0.1),),
        ...         parameters=(ex.Parameter("at", "m", 0.0, scale=1.0, positive=False),),
        ...     )
        ...     def outcome(self, design, params):
        ...         return 1 / (1 + (design - params.at) ** 2)
        >>> chosen = ex.Myopic.of(Beacon, {"at": "normal:0:1"})
        >>> state = chosen.init(Beacon(), 10, jax.random.key(0))
        >>> state, first = chosen(state, jax.numpy.zeros(1))  # nothing is measured yet
        >>> state, second = chosen(state, jax.numpy.array([0.4]))  # the outcome of the first
        >>> second.shape
        (1,)

    Attributes:
        prior: of the parameters.
        pool: the only designs that are allowed [input units]; default all within the limits.
        num_particles: of what is known.
        num_moves: of each particle after an outcome.
        num_tried: designs of each round.
        num_rounds: of designs near earlier ones, after the first round.
        num_outcomes: of a design that is tried, each averaged over four times as many particles.
    """

    prior: PriorPlants
    pool: Float[Array, "design input"] | None = None
    num_particles: int = eqx.field(static=True, default=1000)
    num_moves: int = eqx.field(static=True, default=5)
    num_tried: int = eqx.field(static=True, default=64)
    num_rounds: int = eqx.field(static=True, default=3)
    num_outcomes: int = eqx.field(static=True, default=16)

    def __check_init__(self) -> None:
        """Raises ValueError for numbers that are too small."""
        require_whole("num_outcomes", self.num_outcomes, 1)
        require_whole("num_particles", self.num_particles, 4 * self.num_outcomes)
        require_whole("num_moves", self.num_moves, 0)
        require_whole("num_tried", self.num_tried, _BEST)
        require_whole("num_rounds", self.num_rounds, 0)

    @classmethod
    def of(
        cls,
        task: PlantLike,
        prior: PriorLike | Sequence[PriorLike] | None = None,
        spread: SpreadLike = 0.3,
        pool: ArrayLike | None = None,
    ) -> Myopic:
        """For a task and what is known of its parameters before.

        Args:
            task: as for `simulate`.
            prior: as for `information_gain`.
            spread: as for `information_gain`.
            pool: the only designs that are allowed, by row [input units].

        Raises:
            ValueError: for a plant that is neither a static task nor has a state that is
                observed, a sensor without noise, or a pool of another shape or outside the limits.
        """
        plant = plant_from(task)
        _require_one_step(plant)
        if not has_own_noise(plant):
            require_bound(plant)
        if pool is None:
            return cls(plants_of(plant, prior, spread))
        rows, width = np.asarray(pool, float), len(plant.definition.inputs)
        if rows.ndim != 2 or not len(rows) or rows.shape[1] != width:
            raise ValueError(f"a pool has a row of {width} for each design: got shape {rows.shape}")
        lower, upper = (np.asarray(limit) for limit in plant.input_limits)
        if not np.all((rows >= lower) & (rows <= upper)):
            raise ValueError(
                f"the designs of a pool lie from {lower.tolist()} to {upper.tolist()}: got "
                f"{rows[~np.all((rows >= lower) & (rows <= upper), axis=1)][0].tolist()}"
            )
        return cls(plants_of(plant, prior, spread), floats(rows))

    def init(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> Known:
        """The prior; for at most `num_steps` designs. ValueError for another plant."""
        d, own = plant.definition, self.prior.plant.definition
        if d.name != own.name:
            raise ValueError(f"these designs are for the plant {own.name!r}: got {d.name!r}")
        require_whole("num_steps", num_steps, 1)
        key, draw_key = jax.random.split(key)
        drawn = jax.random.normal(draw_key, (self.num_particles, len(d.parameters)), float)
        designs, outcomes = (jnp.zeros((num_steps, len(own))) for own in (d.inputs, d.outputs))
        return Known(drawn, outcomes[0], designs, outcomes, jnp.asarray(0), key)

    def __call__(
        self, state: Known, measurement: Float[Array, " output"]
    ) -> tuple[Known, Float[Array, " input"]]:
        """The next design, after the outcome of the last one.

        The first call has no outcome yet: the state of a plant, anything for a static task.

        Raises:
            ValueError: for more designs than the state was made for, and for an outcome of another
                size or that is not a number.
        """
        count = len(state.designs)
        if not isinstance(state.k, jax.core.Tracer):
            if int(state.k) >= count:
                raise ValueError(f"all {count} designs are chosen: make a state for more (init)")
            _require_numbers("an outcome", measurement, self.prior.plant.definition.outputs)
        return self._next(state, measurement)

    @eqx.filter_jit
    def _next(
        self, state: Known, measurement: Float[Array, " output"]
    ) -> tuple[Known, Float[Array, " input"]]:
        learnt = self.learnt(state, measurement)
        begun = dataclasses.replace(state, first=measurement)
        known = jax.tree.map(lambda new, old: jnp.where(state.k > 0, new, old), learnt, begun)
        key, own = jax.random.split(known.key)
        design = self._best(known, measurement, own)
        designs = known.designs.at[known.k].set(design)
        return dataclasses.replace(known, designs=designs, k=known.k + 1, key=key), design

    def applied(self, state: Known, input: Float[Array, " input"]) -> Known:
        """The state after another design than the proposed one.

        Raises:
            ValueError: for a design of another size, that is not a number, or outside the limits,
                and before the first design is chosen.
        """
        if not isinstance(state.k, jax.core.Tracer) and not isinstance(input, jax.core.Tracer):
            _require_begun(state)
            _require_numbers("a design", input, self.prior.plant.definition.inputs)
            lower, upper = (np.asarray(limit) for limit in self.prior.plant.input_limits)
            if not np.all((lower <= input) & (input <= upper)):
                raise ValueError(
                    f"a design lies from {lower.tolist()} to {upper.tolist()}: got "
                    f"{np.asarray(input).tolist()}"
                )
        return dataclasses.replace(state, designs=state.designs.at[state.k - 1].set(input))

    def posterior(self, state: Known) -> Params:
        """Parameters as probable as the outcomes so far leave them, an array of each."""
        return jax.vmap(self.prior.params)(state.particles)

    def learnt(self, state: Known, outcome: Float[Array, " output"]) -> Known:
        """What is known after the outcome of the last design.

        It is for the very last one: a call for the next design learns from its outcome itself.

        Raises:
            ValueError: for an outcome of another size or that is not a number, and before the
                first design is chosen.
        """
        if not isinstance(state.k, jax.core.Tracer) and not isinstance(outcome, jax.core.Tracer):
            _require_begun(state)
            _require_numbers("an outcome", outcome, self.prior.plant.definition.outputs)
        last = state.k - 1
        outcomes = state.outcomes.at[last].set(outcome)
        is_before = jnp.arange(len(outcomes)) < last
        key, own = jax.random.split(state.key)

        def log_before(z: Array) -> Array:
            made = outcomes, state.before, state.designs
            found = jax.vmap(partial(self._log_likelihoods, z))(*made)
            told = jnp.sum(jnp.where(is_before[:, None], found, 0.0), axis=0)
            return told - 0.5 * jnp.sum(z**2, axis=1)

        def log_now(z: Array) -> Array:
            return self._log_likelihoods(z, outcome, state.before[last], state.designs[last])

        particles = _weighted(state.particles, log_before, log_now, self.num_moves, own)
        return dataclasses.replace(state, particles=particles, outcomes=outcomes, key=key)

    def _log_likelihoods(
        self,
        z: Float[Array, "particle param"],
        measured: Float[Array, " output"],
        before: Float[Array, " output"],
        design: Float[Array, " input"],
    ) -> Float[Array, " particle"]:
        """Of what was measured of a design, by particle."""
        of = partial(log_likelihood, self.prior.plant, measured, before, design)
        found = jax.vmap(lambda own: of(self.prior.params(own)))(z)
        return jnp.where(jnp.isfinite(found), found, _IMPOSSIBLE)

    def _best(
        self, known: Known, measured: Float[Array, " output"], key: PRNGKeyArray
    ) -> Float[Array, " input"]:
        """The design whose outcome is expected to tell most, of those tried."""
        plant = self.prior.plant
        lower, upper = plant.input_limits
        any_key, noise_key, pick_key, *near_keys = jax.random.split(key, 3 + self.num_rounds)
        count, outputs = self.num_outcomes, len(plant.definition.outputs)
        noise = jax.random.normal(noise_key, (count, outputs), float)
        # Neighbours have the same ancestor: some of all of them.
        order = jax.random.permutation(pick_key, self.num_particles)
        particles = known.particles[order[: 4 * count]]

        def gain(design: Array) -> Array:
            """Expected gain: the mean over outcomes that are simulated from some particles."""
            params = jax.vmap(self.prior.params)(particles)
            some = jax.tree.map(lambda values: values[:count], params)
            seen = jax.vmap(partial(next_measurement, plant, measured, design))(some, noise)
            of_all = jax.vmap(
                lambda outcome: self._log_likelihoods(particles, outcome, measured, design)
            )(seen)
            own = of_all[np.arange(count), np.arange(count)]
            found = jnp.mean(own - jax.nn.logsumexp(of_all, axis=1))
            return jnp.where(jnp.isfinite(found), found, -jnp.inf)

        def near(designs: Array, key: PRNGKeyArray) -> Array:
            pick_key, size_key, way_key = jax.random.split(key, 3)
            shape = (self.num_tried, len(lower))
            picked = designs[jax.random.randint(pick_key, shape[:1], 0, len(designs))]
            least = math.log(_SMALLEST)
            size = jnp.exp(jax.random.uniform(size_key, (shape[0], 1), float, least, 0.0))
            way = size * jax.random.normal(way_key, shape, float)
            return jnp.clip(picked + way * (upper - lower)[None] / 2, lower[None], upper[None])

        if self.pool is not None:
            return self.pool[jnp.argmax(jax.lax.map(gain, self.pool, batch_size=self.num_tried))]
        shape = (max(self.num_tried, len(known.designs)), len(lower))
        tried = jax.random.uniform(any_key, shape, float, lower[None], upper[None])
        is_made = (jnp.arange(len(known.designs)) < known.k)[:, None]
        places = jnp.where(is_made, known.designs, tried[: len(known.designs)])
        gains = jax.vmap(gain)(tried)
        for own in near_keys:
            more = near(places, own)
            tried = jnp.concatenate([tried, more])
            gains = jnp.concatenate([gains, jax.vmap(gain)(more)])
            places = tried[jax.lax.top_k(gains, _BEST)[1]]
        return tried[jnp.argmax(gains)]


def _weighted(
    particles: Float[Array, "particle param"],
    log_before: Callable[[Float[Array, "particle param"]], Float[Array, " particle"]],
    log_now: Callable[[Float[Array, "particle param"]], Float[Array, " particle"]],
    num_moves: int,
    key: PRNGKeyArray,
) -> Float[Array, "particle param"]:
    """Particles of one distribution as those of the same times a likelihood.

    The likelihood is raised to powers that grow to 1, each so large that half of the particles
    remain effective (adaptive tempering; P. Del Moral, A. Doucet, A. Jasra, Sequential Monte Carlo
    samplers, 2006).
    """
    count = len(particles)

    def next_power(log_p: Array, power: Array) -> Array:
        def is_small(step: Array) -> Array:
            weights = jax.nn.softmax(step * log_p)
            return jnp.sum(weights**2) <= 2 / count

        def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
            middle = (ends[0] + ends[1]) / 2
            small = is_small(jnp.exp(middle))
            return jnp.where(small, middle, ends[0]), jnp.where(small, ends[1], middle)

        rest = 1 - power
        ends = jnp.full_like(rest, _LEAST), jnp.log(rest)
        step = jnp.exp(jax.lax.fori_loop(0, _HALVINGS, halve, ends)[0])
        return jnp.where(
            is_small(rest), 1.0, jnp.minimum(power + jnp.maximum(step, 0.01 * power), 1.0)
        )

    def stage(now: tuple[Array, Array, PRNGKeyArray]) -> tuple[Array, Array, PRNGKeyArray]:
        z, power, key = now
        key, draw_key, move_key = jax.random.split(key, 3)
        log_p = log_now(z)
        new = next_power(log_p, power)
        weights = jax.nn.softmax((new - power) * log_p)
        places = (jnp.arange(count) + jax.random.uniform(draw_key)) / count
        drawn = z[jnp.clip(jnp.searchsorted(jnp.cumsum(weights), places), 0, count - 1)]

        def target(z: Array) -> Array:
            return log_before(z) + new * log_now(z)

        return _moved(drawn, target, num_moves, move_key), new, key

    start = particles, jnp.zeros(()), key
    return jax.lax.while_loop(lambda now: now[1] < 1, stage, start)[0]


def _moved(
    drawn: Float[Array, "particle param"],
    log_target: Callable[[Float[Array, "particle param"]], Float[Array, " particle"]],
    num_moves: int,
    key: PRNGKeyArray,
) -> Float[Array, "particle param"]:
    """Particles after moves that leave their distribution as it is."""
    count, fine = len(drawn), _FINE * jnp.std(drawn, axis=0)

    def move(now: tuple[Array, Array], key: PRNGKeyArray) -> tuple[tuple, None]:
        z, log_p = now
        pair_key, size_key, jump_key, fine_key, take_key = jax.random.split(key, 5)
        one, other = jax.random.randint(pair_key, (2, count), 0, count)
        is_jump = jax.random.bernoulli(jump_key, _JUMP, (count,))
        part = jnp.where(is_jump, 1.0, jax.random.uniform(size_key, (count,)))
        moved = z + part[:, None] * (drawn[one] - drawn[other])
        moved = moved + fine[None] * jax.random.normal(fine_key, z.shape, float)
        log_moved = log_target(moved)
        is_taken = jnp.log(jax.random.uniform(take_key, (count,))) < log_moved - log_p
        taken = jnp.where(is_taken[:, None], moved, z)
        return (taken, jnp.where(is_taken, log_moved, log_p)), None

    keys = jax.random.split(key, num_moves)
    return jax.lax.scan(move, (drawn, log_target(drawn)), keys)[0][0]


def _require_numbers(what: str, given: ArrayLike, signals: Sequence[Input | Output]) -> None:
    """Raises ValueError for something else than one finite number for each signal."""
    values = np.asarray(given)
    is_number = values.dtype.kind in "fiu"
    if not is_number or values.shape != (len(signals),) or not np.isfinite(values).all():
        names = ", ".join(names_of(signals))
        raise ValueError(f"{what} has one finite number for each of {names}: got {values.tolist()}")


def _require_begun(state: Known) -> None:
    """Raises ValueError where no design is chosen yet."""
    if int(state.k) == 0:
        raise ValueError("no design is chosen yet: call with the state and a first measurement")


def _require_one_step(plant: AbstractPlant) -> None:
    require_inputs(plant)
    if not (isinstance(plant, AbstractStaticTask) or plant.definition.observes_state):
        raise ValueError(
            "myopic designs are for tasks without memory (AbstractStaticTask) and for plants whose "
            f"state is observed: the outputs of plant {plant.definition.name!r} are not its "
            "states, or not each state has a noise_sd; `excite next` chooses its next experiment"
        )
