"""Rival plants: their evidence, the signal that tells them apart, and campaigns that use both."""

import dataclasses
import json
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import excite
from scipy.stats import norm

import excite as ex
from excite.environment.falsification import nearness
from excite.estimation import Experiments
from excite.estimation.evidence import Fit, Rival, fitted, nearest, probabilities, unplayed
from excite.plant import Aero2, Aero2Lag, DCMotor
from excite.plant.catalogue import plant_from, plant_in_file, with_sensor
from excite.plant.contract import with_nominal
from excite.plant.uncertainty import Uncertainty
from excite.simulation import response
from excite.study import campaign_on_rig
from excite.study.discrimination import rivals_from
from excite.training.discrimination import discriminating, error_bound, first_signals

LAG = "aero2_lag,tau=0.05:0.25"
RIVALS = ("aero2", LAG)
STEPS, COAST = 20, 20


# ------------------------------------------------------------------------------- evidence


def test_the_nearest_point_of_a_linear_problem_is_that_of_the_normal_equations():
    rng = np.random.default_rng(1)
    A, b, root = rng.normal(size=(7, 3)), rng.normal(size=7), rng.normal(size=(3, 3))
    known = Fit(jnp.asarray(rng.normal(size=3)), jnp.asarray(root.T @ root), *jnp.zeros(2))
    z, least = nearest(lambda z: jnp.asarray(A) @ z - b, known, jnp.zeros(3), 60)
    expected = np.linalg.solve(A.T @ A + root.T @ root, A.T @ b + root.T @ root @ known.z)
    np.testing.assert_allclose(z, expected, rtol=1e-6)
    off = np.asarray(expected - known.z)
    cost = np.sum((A @ expected - b) ** 2) + off @ root.T @ root @ off
    assert float(least) == pytest.approx(cost)


def one_unknown(name: str, ranges: dict, sd: float) -> Rival:
    """A rival whose other parameters are known."""
    plant = with_sensor(plant_from(name), {"pitch": sd})
    return Rival(name, Uncertainty.of(plant, 0.0, ranges))


@pytest.mark.slow
def test_the_evidence_is_the_likelihood_averaged_over_the_box():
    sd = 0.01
    rivals = [
        one_unknown("aero2", {"K_pu": "factor:1.5"}, sd),
        one_unknown("aero2_lag", {"tau": (0.05, 0.25)}, sd),
    ]
    rng, inputs = np.random.default_rng(2), jnp.full((1, 30, 1), 5.0)
    truth = response(Aero2Lag(), Aero2Lag().nominal._replace(tau=jnp.asarray(0.12)), inputs[0])
    measured = (np.asarray(truth) + sd * rng.normal(size=truth.shape))[None]
    found, expected = [], []
    for rival in rivals:
        start = rival.box.plant.initial_state[None]
        data = Experiments(inputs, jnp.asarray(measured), jnp.ones(measured.shape, bool), start,
                           initial_state_known=True)  # fmt: skip
        found.append(fitted(rival, data))
        points = np.linspace(-1, 1, 2001)
        at = rival.box.names.index("K_pu" if rival.name == "aero2" else "tau")
        z = jnp.zeros((len(points), len(rival.box.names)))
        z = z.at[:, at].set(jax.scipy.special.ndtri((1 + points) / 2))
        outputs = np.asarray(jax.vmap(lambda z, own=rival: own.response(z, inputs[0]))(z))
        log_likelihood = -0.5 * np.sum(((outputs - measured) / sd) ** 2, axis=(1, 2))
        expected.append(np.log(np.mean(np.exp(log_likelihood - log_likelihood.max())))
                        + log_likelihood.max())  # fmt: skip
    own = [float(fit.log_evidence) for fit in found]
    np.testing.assert_allclose(own, expected, atol=0.1)
    np.testing.assert_allclose(probabilities(found), np.exp(own) / np.sum(np.exp(own)))


@pytest.mark.science
def test_before_an_experiment_all_rivals_are_as_probable():
    found = ex.discriminate(RIVALS, steps=STEPS, coast=COAST)
    assert [r.probability for r in found.rivals] == [0.5, 0.5]
    assert found.bounds[0] == pytest.approx(0.5)  # of two: the root of 0.5 * 0.5
    assert float(error_bound(jnp.asarray([0.5, 0.4, 0.1]))) == pytest.approx(0.5)
    assert float(error_bound(jnp.asarray([0.999, 0.001]))) == pytest.approx(0.001)
    assert float(error_bound(jnp.asarray([1.0, 0.0]))) == 0.0


# --------------------------------------------------------------------------------- signal


@pytest.fixture(scope="module")
def designed():
    """Two rivals, and the signal that tells them apart."""
    rivals = rivals_from(RIVALS, 0.3)
    starts = first_signals(Aero2(), STEPS)
    return rivals, discriminating(rivals, [unplayed(r) for r in rivals], starts, COAST)


@pytest.mark.slow
def test_the_signal_is_safe_on_plants_of_both_rivals_coast_included(designed):
    rivals, made = designed
    whole = jnp.concatenate([made.inputs, jnp.zeros((COAST, 1))])
    for rival in rivals:
        points = jax.random.uniform(jax.random.key(3), (200, len(rival.box.names)), float, -1, 1)
        z = jax.scipy.special.ndtri((1 + points) / 2)
        sizes = jax.vmap(lambda z, own=rival: nearness(Aero2(), own.response(z, whole)))(z)
        assert float(jnp.max(sizes)) < 1
    assert float(made.nearness) < 0.97
    assert np.abs(made.inputs).max() <= 24


def test_a_search_begins_with_loud_and_soft_signals_within_the_limits():
    starts = np.asarray(first_signals(Aero2(), STEPS))
    peaks = np.abs(starts).max(axis=(1, 2))
    assert peaks.max() == pytest.approx(0.5 * Aero2().definition.inputs[0].amplitude)
    assert peaks.min() == pytest.approx(0.1 * peaks.max())
    assert len(np.unique(starts.round(6), axis=0)) == len(starts) == 8


@pytest.mark.slow
def test_the_least_distance_of_two_rivals_rises_with_every_sample(designed):
    (first, other), made = designed
    inputs, sd = made.inputs, first.box.plant.sensor.sd[None]
    before = unplayed(first)

    @jax.jit
    def least(z, seen):
        target = other.response(z, inputs)

        def residual(own):
            return (seen[:, None] * (first.response(own, inputs) - target) / sd).ravel()

        return nearest(residual, before, before.z, 60)[1]

    for z in np.random.default_rng(0).normal(size=(3, len(other.box.names))):
        distances = [float(least(jnp.asarray(z), jnp.arange(STEPS + 1) <= n)) for n in range(21)]
        assert np.all(np.diff(distances) > -1e-6 * distances[-1])
        assert distances[-1] > 10


@pytest.mark.slow
def test_the_bound_of_two_known_plants_is_that_of_kailath_and_holds():
    sd = 0.02
    rivals = [one_unknown("aero2", {}, sd), one_unknown("aero2_lag", {"tau": (0.1, 0.1)}, sd)]
    starts = first_signals(Aero2(), STEPS)
    made = discriminating(rivals, [unplayed(r) for r in rivals], starts, COAST)
    ideal, lagging = (np.asarray(r.response(jnp.zeros(len(r.box.names)), made.inputs))
                      for r in rivals)  # fmt: skip
    D = float(np.sum((ideal - lagging) ** 2)) / sd**2
    assert D > 0
    bound = float(jnp.exp(jnp.min(made.log_bounds)))
    assert bound == pytest.approx(0.5 * math.exp(-D / 8), rel=1e-6)
    assert norm.cdf(-math.sqrt(D) / 2) <= bound  # the error of the likelihood ratio
    rest = jnp.zeros((COAST, 1))
    for i, start in enumerate(starts):  # as loud as the input may be; a wave or a step, and safe
        loud = start * 24 / jnp.max(jnp.abs(start))
        while i > 4 and max(
            float(nearness(Aero2(), r.response(jnp.zeros(len(r.box.names)), whole)))
            for r in rivals
            for whole in [jnp.concatenate([loud, rest])]
        ) > 0.97:  # fmt: skip
            loud = 0.95 * loud
        one, other = (np.asarray(r.response(jnp.zeros(len(r.box.names)), loud)) for r in rivals)
        assert float(np.sum((one - other) ** 2)) / sd**2 < D


@pytest.mark.science
@pytest.mark.parametrize(
    ("plant", "own", "chosen"),
    [("aero2", {"J_p": 0.02}, "aero2"), ("aero2_lag", {"tau": 0.07}, LAG)],
)
def test_the_true_plant_is_chosen(designed, plant, own, chosen):
    signal = np.asarray(designed[1].inputs)
    record = ex.simulate(plant, ex.discriminate(RIVALS, steps=STEPS, coast=COAST).excitation,
                         steps=STEPS, params=own, seed=4)  # fmt: skip
    np.testing.assert_allclose(record.inputs[:-1], signal, rtol=1e-6)
    found = ex.discriminate(RIVALS, record)
    assert found.chosen is not None
    assert found.chosen.name == chosen
    assert found.inputs is None
    swapped = ex.discriminate(RIVALS[::-1], record)
    own_p, other_p = ([r.probability for r in f.rivals] for f in (found, swapped))
    assert other_p[::-1] == pytest.approx(own_p)
    for name, value in own.items():
        estimate, half = found.chosen.estimate[name]
        assert abs(estimate - value) < 2 * half


@pytest.mark.science
def test_where_no_plant_explains_the_records_none_is_chosen():
    record = ex.simulate("aero2+drag", "prbs", params={"drag_pitch_rate": 3.0}, steps=60, seed=1)
    found = ex.discriminate(RIVALS, record)
    assert found.chosen is None
    assert found.decision.startswith("no rival explains the records: the residual of ")
    with pytest.raises(ValueError, match="there is no experiment to play: no rival explains"):
        _ = found.excitation


@pytest.mark.parametrize(
    ("plants", "options", "words"),
    [
        (["aero2"], {}, "at least two plants are needed: got 1"),
        (["aero2", "aero2"], {}, "aero2 is given twice"),
        (
            ["aero2", "dc_motor"],
            {},
            "the same outputs: name of dc_motor is speed, current; of aero2 ",
        ),
        (["aero2", "aero2_lag,tau"], {}, "'tau' is no range: a rival is PLANT,NAME=LOW:HIGH"),
        (["aero2", "aero2_lag,tua=1:2"], {}, "rival 'aero2_lag,tua=1:2': unknown quantity"),
        (["aero2", "aero2_lag,tau=2:1"], {}, "range of tau contains no plant"),
        (["aero2", "aero2+lag"], {}, "rival 'aero2+lag': range of lag_voltage needs two numbers"),
        (["aero2", f"{LAG},noise=1:2"], {}, "the noise is that of the first plant's sensor"),
        (["aero2", f"{LAG},tau=1:2"], {}, "the range of tau is given twice"),
        (["aero2", ("aero2_lag", {"tau": [1]})], {}, "range of tau must be two numbers"),
        (RIVALS, {"spread": 2.0}, "spread must lie in"),
        (RIVALS, {"steps": 1}, "steps must be a whole number"),
        (RIVALS, {"initial_state": "free"}, "initial_state must be auto or known: got 'free'"),
        (RIVALS, {"out": "signal.xyz"}, "signal.xyz"),
    ],
)
def test_rivals_that_cannot_be_compared_are_one_sentence(plants, options, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        ex.discriminate(plants, **options)


class Weaker(Aero2Lag):
    """Of which less is allowed."""

    definition = dataclasses.replace(
        Aero2Lag.definition,
        name="weaker",
        outputs=(dataclasses.replace(Aero2Lag.definition.outputs[0], critical_level=0.6),),
    )


def test_a_rival_with_another_level_is_refused():
    with pytest.raises(ValueError, match=r"same outputs: critical level of weaker is 0\.6; of aer"):
        ex.discriminate(["aero2", Weaker])
    with pytest.raises(ValueError, match=r"critical level of aero2 is 0\.69"):
        ex.discriminate([Weaker, "aero2"])


@pytest.mark.science
def test_of_a_record_with_a_gap_the_part_before_it_counts():
    record = ex.simulate("aero2_lag", "prbs", steps=60, params={"tau": 0.1}, seed=1)
    rows = np.r_[:30, 36:61]
    gap = dataclasses.replace(
        record, time=record.time[rows], inputs=record.inputs[rows], outputs=record.outputs[rows]
    )
    found = ex.discriminate(RIVALS, gap)
    assert found.chosen is not None
    assert found.chosen.name == LAG
    cut = dataclasses.replace(
        record, time=record.time[:30], inputs=record.inputs[:30], outputs=record.outputs[:30]
    )
    same = ex.discriminate(RIVALS, cut)
    misfits, expected = ([r.misfit_factor for r in f.rivals] for f in (found, same))
    assert misfits == pytest.approx(expected)


def test_ranges_are_part_of_a_rivals_name():
    rivals = rivals_from(["aero2", ("aero2_lag", {"tau": (0.05, 0.1)}), LAG], 0.3)
    assert [rival.name for rival in rivals] == ["aero2", "aero2_lag,tau=0.05:0.1", LAG]


def test_a_record_from_elsewhere_is_refused():
    moving = dataclasses.replace(ex.simulate("aero2", "chirp", steps=40), metadata={})
    with pytest.raises(ValueError, match="does not say that it starts at rest"):
        ex.discriminate(RIVALS, moving)
    with pytest.raises(ValueError, match="has 1 input and 2 outputs; plant 'aero2' has 1 and 1"):
        ex.discriminate(RIVALS, ex.simulate(DCMotor(), "chirp", steps=40))
    with pytest.raises(TypeError, match="plants must be a list of at least two plants"):
        ex.discriminate("aero2")


# --------------------------------------------------------------------------------- command


@pytest.mark.slow
def test_the_command_writes_the_signal_and_says_what_python_says(tmp_path):
    out, plot = tmp_path / "next.csv", tmp_path / "next.png"
    arguments = ["discriminate", *RIVALS, "--steps", STEPS, "--coast", COAST]
    done = excite(*arguments, "--out", out, "--plot", plot, "--json")
    told, found = json.loads(done.stdout), ex.discriminate(RIVALS, steps=STEPS, coast=COAST)
    assert told == json.loads(json.dumps(found.to_dict()))
    assert done.returncode == 0
    written = ex.read_record(out)
    np.testing.assert_allclose(written.inputs[:-1], found.excitation.inputs, rtol=1e-6)
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert max(map(len, repr(found).splitlines())) <= 80
    record = tmp_path / "record.csv"
    ex.simulate("aero2", found.excitation, steps=STEPS, seed=4).save(record)
    known = excite(*arguments, "--record", record, "--out", tmp_path / "none.csv")
    assert known.returncode == 0
    assert "aero2 is chosen (probability 1.0000)" in known.stdout
    assert "no signal was designed" in known.stderr
    assert not (tmp_path / "none.csv").exists()
    again = excite(*arguments, "--out", out)
    assert again.returncode == 2
    assert "exists" in again.stderr


# -------------------------------------------------------------------------------- campaign


@pytest.mark.science
def test_a_campaign_tells_rivals_apart_before_it_identifies():
    campaign = ex.Campaign("aero2", {"J_p": "2%"}, rivals=[LAG], spread=0.3, coast=COAST)
    truth = {"J_p": 0.025, "tau": 0.15}
    asked = campaign.ask()
    assert campaign.is_undecided
    told = campaign.tell(ex.simulate("aero2_lag", asked, steps=STEPS, params=truth, seed=5))
    assert told.played == "signal for rivals"
    assert told.decision.startswith(f"{LAG} is chosen (probability 1.0000); ")
    assert campaign.plant.description.name == "aero2_lag"
    assert campaign.declared.description.name == "aero2"
    assert "tau" in told.known
    estimate, half = told.known["tau"]
    assert abs(estimate - 0.15) < 2 * half
    assert json.loads(json.dumps(campaign.to_dict()))["structure"]["chosen"] == LAG


@pytest.mark.science
def test_a_campaign_ends_where_no_rival_explains_the_records():
    campaign = ex.Campaign("aero2", {"J_p": "2%"}, rivals=[LAG], spread=0.3, coast=COAST)
    record = ex.simulate("aero2+offset", campaign.ask(), steps=STEPS,
                         params={"offset_voltage": 8.0}, seed=5)  # fmt: skip
    told = campaign.tell(record)
    assert campaign.reason.startswith("no rival explains the records")
    assert told.known == {}
    assert campaign.ask() is None
    last = ex.Campaign("aero2", {"J_p": "2%"}, rivals=[LAG], spread=0.3, coast=COAST, rounds=1)
    last.tell(record)
    assert last.reason.startswith("no rival explains the records")  # and not the end of the budget


@pytest.mark.science
def test_a_choice_that_a_later_record_contradicts_is_made_again():
    campaign = ex.Campaign("aero2", {"D_p": "0.001%"}, rivals=[LAG], spread=0.3, coast=COAST)
    asked = campaign.ask()
    campaign.tell(ex.simulate("aero2", asked, steps=STEPS, seed=5))
    assert campaign.plant.description.name == "aero2"
    other = ex.simulate("aero2+offset", asked, steps=STEPS, params={"offset_voltage": 8.0}, seed=6)
    campaign.tell(other)
    assert campaign.reason.startswith("no rival explains the records")


@pytest.mark.science
def test_a_campaign_ends_where_no_signal_is_safe():
    given = f"{LAG},initial_pitch=-0.69:0.69"  # beyond the level in the free motion
    campaign = ex.Campaign("aero2", {"J_p": "2%"}, rivals=[given], spread=0.3, coast=COAST)
    assert campaign.ask() is None
    assert campaign.reason == "undecided; no safe signal was found"


@pytest.mark.science
def test_the_constants_of_the_chosen_rival_are_those_of_its_fit():
    true = Aero2().changed(d_S=1.1 * 0.0019435)
    rivals = [("aero2", {"d_S": "20%"})]
    campaign = ex.Campaign("aero2_lag", {"J_p": "1%"}, policy="none", rivals=rivals)
    records = [ex.simulate(true, "prbs", steps=60, seed=seed) for seed in (1, 2)]
    for record in records:
        campaign.tell(record)
    assert campaign.discrimination is not None
    assert campaign.discrimination.chosen is not None
    assert campaign.discrimination.chosen.name == "aero2,d_S=20%"
    found = campaign.plant.constants.d_S
    sd = campaign.discrimination.fitted_beside[0]["d_S"]
    assert abs(float(found) - true.constants.d_S) < 4 * sd
    # The parameters have the intervals of a fit in which the constant is uncertain.
    result = ex.identify(records, campaign.plant, uncertain={"d_S": sd}, initial_state="known")
    sure = ex.identify(records, campaign.plant, initial_state="known")
    half = campaign.known["J_p"].ci95_half
    assert half == pytest.approx(np.ptp(result.ci95("J_p")) / 2, rel=1e-3)
    assert half > 1.5 * np.ptp(sure.ci95("J_p")) / 2
    assert abs(campaign.known["J_p"].estimate - true.nominal.J_p) < 2 * half


def test_targets_are_parameters_of_every_rival():
    with pytest.raises(ValueError, match="rival aero2 has no parameter 'tau', a target"):
        ex.Campaign("aero2_lag", {"tau": "2%"}, rivals=["aero2"], policy="aero2_lag")


@pytest.mark.science
def test_a_campaign_on_a_rig_is_resumed_with_the_same_decisions(tmp_path):
    truth = with_nominal(plant_from("aero2_lag"), {"tau": 0.2, "J_p": 0.03, "K_pu": 0.01})
    (tmp_path / "truth.json").write_text(json.dumps(plant_in_file(truth)))

    def played(folder: str) -> ex.Campaign:
        return ex.campaign(
            "aero2", {"J_p": "1%"}, str(tmp_path / "truth.json"), rivals=[LAG], coast=COAST,
            rounds=4, fast=True, out=tmp_path / folder,
        )  # fmt: skip

    first = played("first")
    assert first.reason == "every target is reached"
    assert first.rounds[0].played == "signal for rivals"
    assert first.plant.description.name == "aero2_lag"
    for name, value in (("tau", 0.2), ("J_p", 0.03)):
        estimate, half = first.rounds[-1].known[name]
        assert abs(estimate - value) < 2 * half
    (tmp_path / "again").mkdir()
    for name in ("campaign.json", "round-01.csv", "round-01.json"):
        (tmp_path / "again" / name).write_bytes((tmp_path / "first" / name).read_bytes())
    again = played("again")
    assert again.to_dict() == first.to_dict()
    with pytest.raises(ValueError, match=r"is another campaign, with rivals \{'aero2': "):
        ex.campaign(
            "aero2", {"J_p": "1%"}, str(tmp_path / "truth.json"), coast=COAST, rounds=4,
            fast=True, out=tmp_path / "again",
        )  # fmt: skip


@pytest.mark.parametrize("is_decided", [False, True])
def test_rounds_that_tell_rivals_apart_are_played_without_guard_and_filter(
    monkeypatch, tmp_path, is_decided
):
    asked = []

    def played(rig, policy=None, **options):
        asked.append(options)
        raise InterruptedError

    monkeypatch.setattr(campaign_on_rig, "run", played)
    monkeypatch.setattr(ex.Campaign, "require_reachable", lambda *_, **__: None)
    monkeypatch.setattr(ex.Campaign, "is_undecided", not is_decided)
    monkeypatch.setattr(ex.Campaign, "ask", lambda self: self.opening)
    monkeypatch.setattr(ex.Campaign, "monitor", lambda self, waits: None)
    told = []
    with pytest.raises(InterruptedError):
        ex.campaign(
            "aero2", {"J_p": "1%"}, rivals=[LAG], policy="aero2", guard=True, filter=True,
            fast=True, out=tmp_path / "out", on_warning=told.append,
        )  # fmt: skip
    assert told[0] == "rounds that tell rivals apart are played without guard and filter"
    (options,) = asked
    assert options["guard"] == options["filter"] == is_decided


def test_where_no_signal_is_redesigned_a_policy_is_not_played_on_another_plant():
    campaign = ex.Campaign("aero2", {"J_p": "1%"}, rivals=[LAG], policy="aero2", redesign=False)
    chosen = plant_from(LAG.partition(",")[0])
    campaign.discrimination, campaign.plant = None, chosen
    assert campaign.ask() is None
    assert campaign.reason == "the policy is for aero2, not for aero2_lag"


@pytest.mark.parametrize(("policy", "sentence"), [
    ("aero2_lag", "the policy has no guard ('excite falsify --guard --certify FILE' makes one)"),
    ("aero2", "the policy's guard is not for this 'aero2_lag'"),
])  # fmt: skip
def test_a_guard_that_the_policy_does_not_have_is_refused_before_the_first_round(
    tmp_path, policy, sentence
):
    with pytest.raises(ValueError, match=f"^{re.escape(sentence)}$"):
        ex.campaign("aero2_lag", {"J_p": "1%"}, policy=policy, guard=True, out=tmp_path / "none")
    assert not (tmp_path / "none").exists()
