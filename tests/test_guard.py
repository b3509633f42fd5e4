"""The guard of a rig: its filter, its brake, its programs for NumPy, and experiments behind it."""

import dataclasses
import functools
import json
import pickle
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from catalogue import LONG
from commands import excite

import excite as ex
from excite.excitation import Chirp
from excite.plant import Aero2, DCMotor
from excite.plant.catalogue import plant_named
from excite.plant.uncertainty import Uncertainty
from excite.policy import Layout
from excite.rig import guard, guard_design
from excite.rig.faults import Faults
from excite.rig.filter import linear_model
from excite.rig.guard import Guard, GuardedPlayer
from excite.rig.guard_design import GuardFilter, GuardModel, guard_for, rules_of
from excite.rig.player import SignalPlayer
from excite.rig.program import Program
from excite.rig.simulated import drawn_hardware, run_batch
from excite.rig.tracing import program_of
from excite.safety import Supervision, Trip

SHIPPED = [
    "aero2", "cart_pole", *map(LONG, ["aero2_detailed", "aero2_lag", "dc_motor", "emps"])
]  # fmt: skip
STEPS, READINGS = 60, 5


@functools.cache
def model_of(name: str) -> tuple[GuardModel, guard.GuardRules]:
    plant = plant_named(name)
    first, dt = plant.definition.inputs[0].name, float(plant.dt)
    ranges = {f"delay_{first}": (0, dt), f"lag_{first}": (0, 2 * dt), "initial_state": "2%"}
    model = GuardModel.of(Uncertainty.of(plant, 0.3, ranges))
    return model, rules_of(model)


@pytest.mark.parametrize("name", SHIPPED)
def test_a_program_computes_what_the_plant_computes(name):
    model, rules = model_of(name)
    rng, n = np.random.default_rng(0), len(rules.mean)
    spread = 0.3 * np.concatenate([rules.state_scale, np.ones(n - rules.num_states)])
    points = rules.mean + rng.normal(size=(2 * n + 1, n)) * spread
    past = rng.normal(size=(2 * n + 1, model.depth, len(rules.rest)))
    functions = model.functions()
    for function, arrays in ((functions.advance, (points, past)), (functions.output, (points,))):
        program = program_of(function, *arrays)
        again = Program.from_text(json.loads(json.dumps(program.to_text())))
        expected = np.asarray(jax.jit(function)(*arrays))
        np.testing.assert_allclose(again(*arrays), expected, rtol=1e-9, atol=1e-12)


def test_a_program_writes_out_loops_products_and_conditions():
    def function(x, y):
        def add(total, row):
            return total + jnp.where(row > 0, row, 2 * row), jnp.tanh(total)

        total, seen = jax.lax.scan(add, x[0], x)
        backwards, _ = jax.lax.scan(lambda c, r: (0.5 * c + r, None), x[0], x, reverse=True)
        return jnp.stack([total, seen[2], x.T @ y[:, 0], backwards, jnp.sum(x, axis=0) ** 3])

    x, y = np.random.default_rng(1).normal(size=(4, 3)), np.ones((4, 2))
    program = program_of(function, x, y)
    np.testing.assert_allclose(program(2 * x, y), function(2 * x, y), rtol=1e-12)


def test_a_function_that_numpy_cannot_have_is_refused():
    with pytest.raises(ValueError, match=r"the plant.s equations use .*without JAX"):
        program_of(lambda x: jnp.linalg.inv(x), np.eye(2))


def test_a_program_from_a_file_can_only_do_arithmetic():
    whole = program_of(lambda x: jnp.sin(x) + 1.0, np.ones(2)).to_dict()
    foreign = json.loads(json.dumps(whole).replace('"sin"', '"__import__"'))
    with pytest.raises(ValueError, match="unknown operation '__import__'"):
        Program.from_dict(foreign)
    with pytest.raises(ValueError, match="damaged"):
        Program.from_dict({"num_inputs": 1})
    for text in ("what", "eJw="):
        with pytest.raises(ValueError, match="damaged"):
            Program.from_text(text)
    with pytest.raises(ValueError, match="unknown type 'object'"):
        Program.from_dict(json.loads(json.dumps(whole).replace('"float64"', '"object"')))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_inputs", 10**9),
        ("operations", [["add", [0, 0, 0], 1, {}]]),  # the third would be written to
        ("operations", [["add", [0, 7], 1, {}]]),
        ("operations", [["transpose", [0], 1, {"order": [0]}]]),
        ("operations", [["convert_element_type", [0], 1, {"new_dtype": "object"}]]),
    ],
)
def test_a_damaged_program_is_refused(name, value):
    whole = program_of(lambda x: jnp.sin(x) + 1.0, np.ones(2)).to_dict()
    with pytest.raises(ValueError, match="a plant's program"):
        Program.from_dict({**whole, name: value, "result": 0})


def test_a_program_may_have_other_numbers_and_can_be_pickled():
    def function(x):
        return (x > 0).astype(jnp.int8).astype(float) + jnp.arange(3, dtype=jnp.uint32)

    x = np.array([-1.0, 0.5, 2.0])
    program = program_of(function, x)
    np.testing.assert_array_equal(program(x), function(x))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(program))(x), function(x))


@pytest.mark.slow
def test_for_a_linear_plant_the_filter_is_kalmans():
    plant = DCMotor()
    model = GuardModel.of(Uncertainty.of(plant, 0.0, {"initial_state": "5%"}))
    rules, functions = rules_of(model), model.functions()
    A, B, C = linear_model(plant)
    n, rng = rules.num_states, np.random.default_rng(3)
    mean, P = rules.mean[:n], (rules.root @ rules.root.T)[:n, :n]
    Q, R = np.diag(rules.walk[:n] ** 2), np.diag(rules.noise**2)
    belief = guard.start(jnp, rules)
    observed = jax.jit(lambda b, y: guard.observed(jnp, rules, functions, b, y))
    moved = jax.jit(lambda b, u: guard.moved(jnp, rules, functions, b, u))
    for _ in range(15):
        y, u = C @ mean + rng.normal(size=len(C)) * 0.1, rng.normal(size=1)
        belief = observed(belief, jnp.asarray(y))
        S = C @ P @ C.T + R
        gain, error = P @ C.T @ np.linalg.inv(S), y - C @ mean
        np.testing.assert_allclose(belief.score[0], error @ np.linalg.solve(S, error), rtol=1e-6)
        mean, P = mean + gain @ error, P - gain @ S @ gain.T
        np.testing.assert_allclose(belief.mean[:n], mean, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose((belief.root @ belief.root.T)[:n, :n], P, rtol=1e-5, atol=1e-12)
        belief = moved(belief, jnp.asarray(u))
        mean, P = A @ mean + B @ u, A @ P @ A.T + Q


@pytest.mark.parametrize("name", SHIPPED)
def test_the_brake_brings_the_slowest_plant_to_rest(name):
    model, rules = model_of(name)
    functions, n = model.functions(), rules.num_states
    names = [model.uncertainty.names[i] for i in model.estimated]
    slowest = np.array([float(name.startswith(("delay_", "lag_"))) for name in names])
    away = 0.2 * rules.state_scale * (np.arange(n) < len(plant_named(name).definition.states))
    belief = guard.start(jnp, rules)
    belief = belief._replace(num_braked=jnp.asarray(1))

    def sample(carry, _):
        state, inputs = carry
        known = belief._replace(mean=jnp.concatenate([state, slowest]), inputs=inputs)
        input = guard.decided(jnp, rules, functions, known, jnp.zeros(len(rules.rest)))
        inputs = jnp.concatenate([inputs[1:], input[None]])
        point = jnp.concatenate([state, slowest])[None]
        state = functions.advance(point, inputs[None, -rules.depth :])[0]
        return (state, inputs), functions.output(jnp.concatenate([state, slowest])[None])[0]

    start = jnp.asarray(rules.mean[:n] + away), belief.inputs
    _, outputs = jax.jit(lambda: jax.lax.scan(sample, start, None, length=4000))()
    sizes = np.abs(np.asarray(outputs)[:, rules.watched]) / rules.critical
    assert sizes[-100:].max() < 0.1 * sizes.max()


PLANT = Aero2()
CHIRP = Chirp(amplitude=8.0)
RULES = Supervision.of(PLANT.description)


@pytest.fixture(scope="module")
def guarding() -> GuardFilter:
    ranges = {"delay_voltage": (0, 0.05), "initial_state": "2%"}
    return guard_for(PLANT, CHIRP, 0.3, ranges, num_steps=STEPS, num_runs=100)


@pytest.mark.slow
def test_a_brake_that_lets_declared_plants_pass_a_level_is_told(monkeypatch):
    monkeypatch.setattr(guard_design, "_stopped", lambda play, cases, stops: 1 + stops / 100)
    with pytest.warns(UserWarning, match=r"of 3 that it stopped .* reached 1\.\d\d of its level$"):
        guard_for(PLANT, CHIRP, 0.3, {}, num_steps=5, num_runs=3)


def of_guard(facts: Mapping[str, object]) -> dict:
    """What the guard did, of the facts of a player."""
    found = facts["guard"]
    assert isinstance(found, dict)
    return found


def played(guarding: GuardFilter, faults=None, **effects):
    """Eight runs behind the guard."""
    keys = jax.random.split(jax.random.key(8), 8)
    hardware = drawn_hardware(
        PLANT, READINGS, 0.3, keys, effects=effects, **({"faults": faults} if faults else {})
    )
    rules = guarding.supervision(RULES)
    return run_batch(hardware, CHIRP, rules, STEPS, READINGS, guarding)


@pytest.mark.science
def test_declared_plants_do_not_trip(guarding):
    runs = played(guarding)
    np.testing.assert_array_equal(runs.trip, Trip.NONE)
    assert (np.asarray(runs.memory.largest) < guarding.rules.thresholds).all()


@pytest.mark.science
def test_a_whole_experiment_ends_with_the_brake(guarding):
    """Zero volts in mid-swing would let the plant swing on."""
    left, braked = (
        run_batch(
            drawn_hardware(PLANT, READINGS, 0.3, jax.random.split(jax.random.key(8), 8)),
            CHIRP, guarding.supervision(RULES), STEPS, READINGS, *filter_,
        )
        for filter_ in ((), (guarding,))
    )  # fmt: skip
    np.testing.assert_array_equal(braked.inputs[:, :STEPS], left.inputs)
    assert len(braked.measured[0]) == len(left.measured[0]) + guarding.num_more
    assert np.abs(left.measured[:, -1]).max() > 0.1
    assert np.abs(braked.measured[:, -1]).max() < 0.25 * RULES.critical[0]


@pytest.mark.science
def test_a_wrong_sign_is_found_at_once_and_ends_the_experiment_at_rest(guarding):
    runs = played(guarding, gain_voltage=-1.0)
    np.testing.assert_array_equal(runs.trip, Trip.UNEXPLAINED)
    assert (np.asarray(runs.memory.tripped_at) <= 6).all()
    assert not np.asarray(runs.is_violation).any()


@pytest.mark.science
def test_after_a_flip_the_brake_turns_its_sign_too(guarding):
    runs = played(guarding, Faults(actuator_sign=3.0))
    assert (np.asarray(runs.memory.tripped_at) >= 30).all()
    assert (np.asarray(runs.memory.sign) < 1).all()
    assert np.abs(np.asarray(runs.measured)[:, -1]).max() < 0.2


@pytest.mark.science
@pytest.mark.parametrize("what", ["late", "strong", "biased"])
def test_other_faults_are_not_taken_for_a_turned_sign(guarding, what):
    guard_ = guarding.guard()
    rules, model, rng = guard_.rules, guard_.model, np.random.default_rng(4)
    found = []
    for begin in range(15, 27):
        point, belief = rules.mean.copy(), guard.start(np, rules)
        past = np.zeros((rules.depth + 3, 1))
        for k in range(begin + 20):
            is_wrong = k >= begin
            measured = model.output(point[None])[0] + rules.noise * rng.normal(size=1)
            jump = 80 * rules.noise if what == "biased" and is_wrong else 0.0
            belief = guard.observed(np, rules, model, belief, measured + jump)
            input = guard.decided(np, rules, model, belief, np.array([12.0 * (-1) ** (k // 4)]))
            belief = guard.moved(np, rules, model, belief, input)
            past = np.concatenate([past[1:], input[None]])
            late, gain = 3 * (what == "late" and is_wrong), 3.0 if what == "strong" else 1.0
            acting = past[3 - late : 3 - late + rules.depth] * (gain if is_wrong else 1.0)
            point[: rules.num_states] = model.advance(point[None], acting[None])[0]
        assert belief.num_braked > 0
        found.append(float(belief.sign))
    assert -1.0 not in found


@pytest.mark.science
def test_the_estimate_starts_again_where_the_sign_turns(guarding):
    """A state that the wrong sign explained would mislead the brake for many samples."""
    guard_ = guarding.guard()
    rules, model = guard_.rules, guard_.model
    n, point = rules.num_states, rules.mean.copy()
    belief, past = guard.start(np, rules), np.zeros((rules.depth, 1))
    sign, errors = 1.0, []
    for k in range(30):
        measured = model.output(point[None])[0]
        belief = guard.observed(np, rules, model, belief, measured)
        if belief.sign < 0:
            errors.append(np.abs(belief.mean[:n] - point[:n]) / rules.state_scale)
        sign = -1.0 if k >= 15 else 1.0
        input = guard.decided(np, rules, model, belief, np.array([12.0 * (-1) ** (k // 4)]))
        belief = guard.moved(np, rules, model, belief, input)
        past = np.concatenate([past[1:], sign * input[None]])
        point[:n] = model.advance(point[None], past[None])[0]
    assert 15 < belief.tripped_at <= 18
    assert len(errors) >= 10
    assert np.max(errors) < 0.05


@pytest.mark.science
def test_what_seems_dead_is_braked_all_the_same(guarding):
    rules, model = guarding.rules, guarding.guard().model
    belief = guard.start(np, rules)
    belief = belief._replace(mean=belief.mean + 0.3, num_braked=np.asarray(1))
    acting = guard.decided(np, rules, model, belief, np.zeros(1))
    belief = belief._replace(sign=np.asarray(0.0))
    dead = guard.decided(np, rules, model, belief, np.zeros(1))
    np.testing.assert_array_equal(acting, dead)
    assert abs(acting[0]) > 1


@pytest.mark.science
def test_the_guard_knows_what_the_supervisor_let_through(guarding):
    """Without it, inputs that a slew limit or a trip changed would look like another plant."""
    keys = jax.random.split(jax.random.key(3), 2)
    hardware = drawn_hardware(PLANT, READINGS, 0.3, keys)
    rules = guarding.supervision(Supervision.of(PLANT.description, slew=20.0))
    runs = run_batch(hardware, CHIRP, rules, STEPS, READINGS, guarding)
    count = np.asarray(runs.memory.inputs).shape[1]
    np.testing.assert_array_equal(runs.memory.inputs, np.asarray(runs.inputs)[:, -count:])
    np.testing.assert_array_equal(runs.memory.tripped_at, STEPS)  # the brake after the last sample


@pytest.mark.science
def test_at_its_level_a_plant_is_braked_not_let_go(guarding):
    rules, model = guarding.rules, guarding.model.functions()
    free = dataclasses.replace(rules, thresholds=np.full(3, np.inf))
    belief = guard.start(jnp, free)
    for share in (0.80, 0.88, 0.96, 1.01):
        assert int(belief.num_braked) == 0
        belief = guard.observed(jnp, free, model, belief, jnp.array([share * rules.critical[0]]))
    assert int(belief.num_braked) == 1


@pytest.mark.science
def test_a_sensor_that_stands_still_is_not_believed(guarding):
    runs = played(guarding, Faults(sensor_frozen=3.0))
    assert np.asarray(runs.memory.is_blind).all()
    np.testing.assert_array_equal(runs.memory.sign, 1.0)
    last = np.asarray(runs.max_abs_output)
    assert (last < RULES.critical).all()


@pytest.mark.science
def test_numpy_and_jax_come_to_the_same_belief(guarding):
    own = Guard.from_dict(json.loads(json.dumps(guarding.guard().to_dict())))
    record = ex.simulate(PLANT, CHIRP, steps=STEPS, params={"J_p": 0.025}, seed=2)
    player = GuardedPlayer(SignalPlayer(record.inputs), own)
    belief, functions = guard.start(jnp, guarding.rules), guarding.model.functions()
    observed = jax.jit(lambda b, y: guard.observed(jnp, guarding.rules, functions, b, y))
    moved = jax.jit(lambda b, u: guard.moved(jnp, guarding.rules, functions, b, u))
    for k in range(20):
        # The input that is told is another from sample 12 on, so that both trip and brake.
        measured = record.outputs[k]
        input = player(k, measured)
        belief = observed(belief, jnp.asarray(measured))
        proposed = jnp.asarray(record.inputs[k])
        expected = guard.decided(jnp, guarding.rules, functions, belief, proposed)
        np.testing.assert_allclose(input, expected, rtol=1e-6, atol=1e-6)
        told = input if k < 12 else -3 - input
        player.applied(told)
        belief = moved(belief, jnp.asarray(told))
    assert int(belief.num_braked) > 0
    facts = of_guard(player.facts())
    assert facts["tripped_at"] == int(belief.tripped_at)


def lively_policy(steps: int = 30) -> ex.Policy:
    """A policy whose input follows two clocks."""
    layout = Layout.of(Aero2().description, 2, steps)
    layout = Layout(**{**vars(layout), "clocks": (0.07,)})
    weights = np.zeros((1, layout.size))
    weights[0, -2:] = 0.4
    return ex.Policy(Aero2().description, layout, ((weights, np.zeros(1)),), {"spread": 0.2})


@pytest.fixture(scope="module")
def guarded_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("guard") / "guarded.safetensors"
    with pytest.MonkeyPatch.context() as patch:  # calibrated in a fifth of the time
        patch.setattr(
            "excite.study.falsify.guard_for",
            lambda *given, num_runs, **options: guard_for(*given, num_runs=100, **options),
        )
        ex.falsify(lively_policy(), budget=100, guard=True).certified().save(path)
    return path


@pytest.mark.science
def test_the_guard_travels_in_the_policys_file_and_leaves_its_hash(guarded_file):
    policy = ex.read_policy(guarded_file)
    assert policy.guard is not None
    assert policy.hash == lively_policy().hash
    assert "with a guard" in repr(policy)


@pytest.mark.science
def test_run_plays_behind_the_guard_and_records_what_it_did(guarded_file, tmp_path):
    good = ex.run(policy=guarded_file, plant="aero2", guard=True, fast=True, spread=0.2,
                  out=tmp_path / "good.csv")  # fmt: skip
    assert good.outcome.is_complete
    assert "did not trip" in str(good)
    played, num_more = good.record.inputs[:30], good.outcome.num_samples - 30
    assert np.abs(played[-1]) > 1
    assert 5 <= num_more <= guard.LONGEST_BRAKE
    assert of_guard(good.outcome.player)["num_braked"] == num_more
    assert np.abs(good.record.outputs[-1]) < 0.25 * RULES.critical
    bad = ex.run(policy=guarded_file, plant="aero2", guard=True, fast=True, spread=0.2,
                 fault={"gain_voltage": -1.0}, out=tmp_path / "bad.csv")  # fmt: skip
    assert bad.outcome.trip == Trip.UNEXPLAINED
    assert "no plant of the declared uncertainty" in bad.outcome.reason
    facts = of_guard(bad.outcome.player)
    assert facts["tripped_at"] < 10
    assert np.abs(bad.record.outputs).max() < np.deg2rad(40)


def test_a_plant_that_does_not_come_to_rest_after_the_experiment_is_told():
    player = GuardedPlayer(SignalPlayer(np.zeros((3, 1))), uncalibrated())
    for k in range(3 + guard.LONGEST_BRAKE):
        assert not player.is_over
        player.applied(player(k, np.array([0.4])))
    assert player.is_over
    assert not player.is_at_rest
    assert of_guard(player.facts())["tripped_at"] == 3


@pytest.mark.science
def test_a_sign_that_flips_while_the_experiment_ends_is_told(guarded_file, tmp_path):
    run = ex.run(policy=guarded_file, plant="aero2", guard=True, fast=True, spread=0.2,
                 fault={"actuator_sign": 3.05}, out=tmp_path / "ends.csv")  # fmt: skip
    assert run.outcome.num_samples > 30
    assert run.outcome.trip == Trip.UNEXPLAINED
    assert of_guard(run.outcome.player)["tripped_at"] == 30
    assert "tripped at sample 30" in str(run)


def test_equal_readings_do_not_end_a_whole_experiment_blind():
    """As of an encoder near rest."""
    player = GuardedPlayer(SignalPlayer(np.zeros((3, 1))), uncalibrated())
    for k in range(12):
        player.applied(player(k, np.array([1e-3])))
    assert player.is_at_rest
    assert not player.is_over
    assert not of_guard(player.facts())["sensor_frozen"]


@pytest.mark.science
def test_a_guard_is_refused_where_there_is_none(tmp_path, guarded_file):
    bare = tmp_path / "bare.safetensors"
    lively_policy().save(bare)
    out = ["--out", str(tmp_path / "r.csv")]
    refused = excite("run", "--plant", "aero2", "--policy", str(bare), "--guard", *out)
    assert refused.returncode == 2
    assert "the policy has no guard" in refused.stderr
    refused = excite("run", "--plant", "aero2", "--excitation", "chirp", "--guard", *out)
    assert refused.returncode == 2
    assert "only policies have a guard" in refused.stderr
    refused = excite("falsify", "aero2", "--guard")
    assert refused.returncode == 2
    assert "--certify" in refused.stderr
    with pytest.raises(ValueError, match="only a policy has a guard"):
        ex.falsify("chirp", "aero2", guard=True, budget=100)


@pytest.mark.science
def test_a_damaged_guard_is_one_sentence(guarded_file, tmp_path):
    policy = ex.read_policy(guarded_file)
    broken = policy.certified(policy.certificate, {"rules": {}})
    with pytest.raises(ValueError, match="the guard is damaged"):
        ex.run(policy=broken, plant="aero2", guard=True, fast=True, out=tmp_path / "r.csv")


@functools.cache
def uncalibrated() -> Guard:
    """A guard without thresholds, which needs no experiments."""
    model, rules = model_of("aero2")
    return GuardFilter(model, rules, STEPS).guard()


def test_a_guard_is_read_as_it_was_written():
    whole = uncalibrated()
    again = Guard.from_dict(json.loads(json.dumps(whole.to_dict())))
    assert again.to_dict() == whole.to_dict()


@pytest.mark.parametrize(
    ("name", "value"), [("mean", 3.0), ("depth", -1), ("rest", [1.0, 2.0, 3.0]), ("noise", "loud")]
)
def test_rules_of_another_form_are_damaged(name, value):
    whole = uncalibrated().to_dict()
    with pytest.raises(ValueError, match="the guard is damaged"):
        Guard.from_dict({**whole, "rules": {**whole["rules"], name: value}})


@pytest.mark.parametrize("size", [np.nan, np.inf, 1e12])
def test_a_replay_that_cannot_be_computed_keeps_the_inferred_sign(size):
    """A simulation may diverge for one of the plants beside the estimate, or for all."""
    _, rules = model_of("aero2")
    belief = guard.start(np, rules)._replace(sign=np.float64(-1.0), num_since=np.int64(9))

    def output(points: np.ndarray) -> np.ndarray:
        """Constant, but for the plants beside the estimate."""
        values = np.zeros((len(points), len(rules.noise)))
        values[-len(rules.mean) :] = size
        return values

    model = guard.Model(lambda points, _: points[:, : rules.num_states], output)
    far = guard.Model(model.advance, lambda points: output(points) + np.nan)
    for each in (model, far):
        with np.errstate(all="ignore"):
            state, sign = guard._replayed(np, rules, each, belief, np.zeros(len(rules.noise)))
        assert sign == -1.0
        assert np.isfinite(state).all()


def test_a_guard_of_another_version_is_refused():
    whole, functions = uncalibrated(), model_of("aero2")[0].functions()
    rules = whole.rules
    few = np.tile(rules.mean, (guard.num_points(rules) - 3, 1))
    past = np.zeros((len(few), rules.depth, len(rules.rest)))
    advance, output = program_of(functions.advance, few, past), program_of(functions.output, few)
    with pytest.raises(ValueError, match="made by another version of excite: make it again"):
        Guard.from_dict(Guard(rules, advance, output).to_dict())
