"""Studies, trainings and evaluations of plants drawn from a prior, with their gain in nats."""

# pyright: reportOptionalMemberAccess=false

import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import excite

import excite as ex
from excite.environment import run_episodes
from excite.estimation.prior_knowledge import plants_of
from excite.excitation import PRBS
from excite.plant import Aero2
from excite.plant.catalogue import plant_named
from excite.report.rows import ExpectedGain, Nats
from excite.report.study_table import footnotes
from excite.study.folder import fingerprint
from excite.study.methods import evaluate_method
from excite.study.spec import study_from
from excite.study.table import _mean_of_seeds, study_table
from excite.training.gradient import started
from excite.training.settings import GradientSettings

SOURCES = f"{Path(__file__).parent.parent / 'examples' / 'location_finding.py'}:TwoSources"
PENDULUM = f"{Path(__file__).parent.parent / 'examples' / 'smc_pendulums.py'}:LinearPendulum"
PRIOR = {"J_p": "lognormal:0.02:10%", "D_p": "normal:0.007:5%"}
SMALL = {"num_updates": 2, "num_plants": 4, "hidden": [4], "watch_every": 1, "watch_episodes": 4}


def study(**changes):
    """Of two methods, and of an agent that is hardly trained."""
    settings = {
        "name": "small",
        "plant": "aero2",
        "episodes": 4,
        "num_steps": 30,
        "seeds": 1,
        "prior": PRIOR,
        "gain": {"plants": 8, "samples": 20},
        "methods": {"prbs": {"excitation": "prbs", "clock": 5}},
        "estimators": {"nls": {"kind": "nls"}},
        "agents": {
            "gradient": {
                "method": "gradient",
                "decision": {"window": 2, "reward": "information"},
                "training": {**SMALL, "last_gain": 1.0},
            }
        },
    }
    return study_from({**settings, **changes}, "small").checked("small")


@pytest.mark.slow
def test_plants_of_a_study_are_drawn_from_its_prior():
    plant, keys = Aero2(), jax.random.split(jax.random.key(0), 2000)
    uniform = plants_of(plant, {"K_pu": "uniform:0.01:0.02"}, 0.3)
    values = np.asarray(run_episodes(plant, PRBS(), 2, 0.3, keys, prior=uniform).params.K_pu)
    assert 0.01 < values.min() < 0.0101 < 0.0199 < values.max() < 0.02
    assert abs(values.std() / (0.01 / math.sqrt(12)) - 1) < 0.03
    assert str(uniform) == "uniform in K_pu, others 0.3"
    prior = plants_of(plant, PRIOR, 0.3)
    assert str(prior) == "lognormal in J_p, normal in D_p, others 0.3"
    drawn = run_episodes(plant, PRBS(), 2, 0.3, keys, prior=prior).params
    assert abs(np.log(drawn.J_p / 0.02).std() - 0.1) < 0.006
    assert abs(drawn.D_p.mean() / 0.007 - 1) < 0.005
    assert abs(drawn.D_p.std() / (0.05 * 0.007) - 1) < 0.06
    beside = np.asarray(drawn.K_pu) / float(plant.nominal.K_pu)  # has the spread
    assert 0.69 < beside.min() < 0.72
    assert 1.28 < beside.max() < 1.31


@pytest.mark.slow
def test_an_agent_is_rewarded_in_nats_on_plants_of_the_prior():
    chosen = study()
    env = chosen.env("gradient", chosen.build_plant())
    assert float(env.objective.weight) == 0.5
    assert jax.tree.all(jax.tree.map(jnp.array_equal, env.prior, env.objective.prior))
    params = [env.reset(key)[0].params.J_p for key in jax.random.split(jax.random.key(1), 200)]
    assert abs(np.log(np.array(params) / 0.02).std() - 0.1) < 0.02
    usual = study(prior={}, gain=None)
    assert float(usual.env("gradient", usual.build_plant()).objective.weight) == 1.0


def test_the_prior_is_part_of_what_identifies_a_training():
    marks = [
        fingerprint(own, own.build_plant(), "gradient")
        for own in (study(), study(gain=None), study(prior={**PRIOR, "D_p": "normal:0.007:4%"}))
    ]
    assert marks[0] == marks[1] != marks[2]


@pytest.mark.science
def test_trainings_of_earlier_versions_keep_what_identifies_them():
    """The fingerprint of several rewards, as it was before information had a price of changes."""
    terms = [{"reward": "information"}, {"reward": "log", "weight": 0.5}]
    agents = {"a": {"method": "gradient", "decision": {"terms": terms}}}
    old = study(prior={}, gain=None, agents=agents)
    mark = "541fbdfe34d5b5344d56731e16031d914917632a787c369b12ee43b9a1db2248"
    assert fingerprint(old, old.build_plant(), "a") == mark


@pytest.mark.parametrize("objective", ["log", ["relative", "goals"]])
def test_a_price_of_changes_needs_information(objective):
    with pytest.raises(ValueError, match="it needs the objective D, A, E, sPCE, ACE or InfoNCE,"):
        ex.train("aero2", objective=objective, change_price=0.1)


@pytest.mark.slow
def test_a_study_has_the_gain_that_information_gain_computes(tmp_path):
    table = ex.run_study(study(), tmp_path / "run", workers=1)
    of_prbs, of_agent = (row.expected_gain for row in table.rows)
    known = {"steps": 30, "prior": PRIOR, "plants": 8, "samples": 20}
    alone = ex.information_gain("aero2", "prbs", options={"clock": 5}, **known)
    assert of_prbs.lower.mean == pytest.approx(alone.lower.value, rel=1e-12)
    assert of_prbs.upper.std_error == pytest.approx(alone.upper.std_error, rel=1e-12)
    policy = tmp_path / "run/seeds/gradient/0/policy.safetensors"
    found = ex.information_gain("aero2", policy, **known)
    assert of_agent.lower.mean == pytest.approx(found.lower.value, rel=1e-6)
    text = table.text(200)
    assert f"{of_prbs.lower.mean:.2f} ± {of_prbs.lower.std_error:.2f}" in text
    assert "J_p lognormal:0.02:10%, D_p normal:0.007:5%, any others within ± 30 %" in " ".join(
        text.split()
    )
    assert "its evidence from 20 samples near the posterior" in " ".join(text.split())
    assert table.columns()["gain_upper_nats"][0] == of_prbs.upper.mean
    assert study_table(tmp_path / "run").rows == table.rows  # from the files alone


def test_the_error_of_a_mean_over_seeds_is_that_of_plants_and_of_seeds():
    alone = [Nats(mean=2.0, std_error=0.3)]
    assert _mean_of_seeds(alone) == alone[0]
    several = [Nats(mean=m, std_error=0.3) for m in (1.0, 2.0, 3.0)]
    found = _mean_of_seeds(several)
    assert found.mean == 2.0
    assert found.std_error == pytest.approx(math.sqrt(0.3**2 + 1.0 / 3))


@pytest.mark.science
def test_a_static_task_with_a_prior_is_trained_and_compared_in_one_study(tmp_path):
    prior = dict.fromkeys(("x_1", "y_1", "x_2", "y_2"), "normal:0:1")
    settings = {
        "plant": SOURCES,
        "prior": prior,
        "gain": {"plants": 4, "samples": 1000, "from_prior": True},
        "methods": {"random": {"excitation": "random", "hold": 1}},
        "agents": {
            "gradient": {
                "method": "gradient",
                "decision": {"window": 1, "memory": 4},
                "training": {**SMALL, "through_measurements": False},
            }
        },
        "seeds": 1,
    }
    table = ex.run_study(study(**settings), tmp_path / "run", workers=1)
    for row in table.rows:
        assert 0 < row.expected_gain.lower.mean <= row.expected_gain.upper.mean
        assert row.expected_gain.lower.mean < math.log(1001)
        assert row.expected_gain.from_prior
    notes = " ".join(footnotes(table.study, table.rows))
    assert "1,000 samples of the prior: figures of other numbers cannot be compared" in notes
    assert "of 4 records has fewer than 10 effective samples" in notes


@pytest.mark.slow
def test_a_disturbed_plant_is_compared_by_the_likelihood_of_its_steps(tmp_path):
    prior = {"a": "normal:14.7:0.316228", "b": "normal:0:0.1", "c": "normal:3:0.316228"}
    own = study(plant=PENDULUM, prior=prior, agents={}, episodes=100, gain=None)
    (row,) = ex.run_study(own).rows
    assert row.failed == 0
    for name in ("a", "c"):  # efficient, and honest
        assert 0.7 < row.rms_over_cramer_rao[name] < 1.35
        assert row.coverage95_percent[name] > 85
    assert row.log_det_information > 0


def test_a_training_begins_with_given_weights():
    chosen = study()
    env, settings = (
        chosen.env("gradient", chosen.build_plant()),
        GradientSettings(num_updates=2, num_plants=4, hidden=(4,), watch_every=1),
    )
    own, _ = started(env, settings, [0])
    weights = jax.tree.map(lambda x: 2 * x[0], own.now.player.weights)
    course, _ = started(env, settings, [1, 2], weights)
    for seed in range(2):
        begun = jax.tree.map(lambda x, seed=seed: x[seed], course.now.player.weights)
        assert jax.tree.all(jax.tree.map(jnp.array_equal, begun, weights))


@pytest.mark.science
def test_train_and_evaluate_take_a_prior(tmp_path):
    small = {"num_plants": 2, "hidden": [4], "watch_episodes": 4}
    told = {"prior": PRIOR, "steps": 30, "window": 2, "episodes": 2}
    policy = ex.train(
        "aero2", tmp_path / "run", **told, updates=1, training=small, change_price=0.01
    )
    made = policy.provenance
    assert made["prior"] == PRIOR
    assert made["decision"]["change_price"] == 0.01
    table = ex.evaluate(policy, prior=PRIOR, episodes=2)
    assert isinstance(table.rows[0].expected_gain, ExpectedGain)
    saved = tmp_path / "policy.safetensors"
    policy.save(saved)
    words = ["--prior", "J_p=lognormal:0.02:10%", "--prior", "D_p=normal:0.007:5%"]
    shown = excite("evaluate", saved, "--episodes", 2, *words)
    assert shown.returncode == 0
    assert "gain nats" in shown.stdout


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rig": {}}, "rig is for plants of the spread: leave it or the prior out"),
        ({"prior": {}, "gain": {}, "rig": {}, "agents": {}}, "leave it or rig out"),
        ({"uncertainty": {"d_S": "10%"}}, "uncertainty is for plants of the spread"),
        ({"clairvoyant": {}, "agents": {}}, "clairvoyant is for plants of the spread"),
        ({"prior": {"J_q": "normal:1:1"}}, "did you mean 'J_p'"),
        ({"prior": {"J_p": "uniform:-1:0.03"}}, "'J_p' is -1 to 0.03, and it must lie between 0"),
        ({"prior": {"J_p": "normal:0.02:30%"}}, "'J_p' reaches below 0"),
        ({"prior": {"J_p": "normal:0.02:-1"}}, "needs finite numbers, SD and"),
        ({"prior": {"J_p": "normal:0.02"}}, "prior of 'J_p' must be normal:MEAN:SD"),
        ({"prior": {}, "uncertainty": {"d_S": "10%"}}, "leave it or uncertainty out"),
        (
            {"agents": {"a": {"method": "gradient", "decision": {"uncertainty": {"d_S": "10%"}}}}},
            "uncertainty is for plants of the spread",
        ),
        (
            {"agents": {"a": {"decision": {"reward": "relative", "estimator": "nls"}}}},
            "the reward 'relative' of nls is for plants of the spread",
        ),
        ({"gain": {"plants": 1}}, "gain.plants"),
        ({"gain": {"sample": 9}}, "did you mean 'samples'"),
        (
            {"agents": {"a": {"method": "gradient", "decision": {"spread": 0.1}}}},
            "an agent of a study with a prior has that prior",
        ),
        (
            {"agents": {"a": {"decision": {"reward": "relative", "change_price": 0.1}}}},
            "has no 'change_price'",
        ),
    ],
)
def test_what_is_not_allowed_is_one_sentence(changes, words):
    with pytest.raises(ValueError, match=words) as refusal:
        study(**changes)
    assert "\n" not in str(refusal.value)


def test_a_prior_that_is_none_is_refused_at_the_command_line(tmp_path):
    for words in (["train", "aero2", "--out", tmp_path / "run"], ["evaluate", "aero2"]):
        refused = excite(*words, "--prior", "J_p=beta:1:2")
        assert refused.returncode == 2
        assert "prior of 'J_p' must be normal:MEAN:SD" in refused.stderr
        assert "got 'beta:1:2'" in refused.stderr
    assert not (tmp_path / "run").exists()


def test_a_plant_without_a_prior_is_drawn_as_before():
    plant, keys = plant_named("aero2"), jax.random.split(jax.random.key(3), 4)
    with_none = run_episodes(plant, PRBS(), 5, 0.3, keys, prior=None).params
    usual = run_episodes(plant, PRBS(), 5, 0.3, keys).params
    assert jax.tree.all(jax.tree.map(jnp.array_equal, with_none, usual))


@pytest.mark.slow
def test_a_study_of_a_task_compares_designs_that_are_chosen_for_its_prior():
    task = {
        "plant": SOURCES,
        "prior": dict.fromkeys(("x_1", "y_1", "x_2", "y_2"), "normal:0:1"),
        "num_steps": 4,
        "agents": {},
    }
    own = study(
        **task,
        methods={"random": {"excitation": "random", "hold": 1}, "near": {"excitation": "myopic"}},
    )
    plant = own.build_plant()
    methods = own.build_methods(plant)
    assert isinstance(methods["near"], ex.Myopic)
    assert own.origins(plant) == {}
    rows = {name: evaluate_method(own, plant, name, made)[0][0] for name, made in methods.items()}
    gains = {name: row.expected_gain.lower.mean for name, row in rows.items()}
    assert gains["near"] > gains["random"] + 1
    with pytest.raises(ValueError, match="excitation 'myopic' has no option 'pool'"):
        study(**task, methods={"near": {"excitation": "myopic", "pool": 5}})
    with pytest.raises(ValueError, match="the outputs of plant 'aero2' are not its states"):
        study(agents={}, methods={"near": {"excitation": "myopic"}})
