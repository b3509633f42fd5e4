import dataclasses
import re
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from excite.environment import InformationGain, OutputError, WeightedSum
from excite.estimation import ARX, NLS
from excite.estimation.catalogue import ESTIMATORS, estimator_named
from excite.excitation import PRBS, Chirp, Multisine, PolicyExcitation, Random
from excite.excitation.catalogue import EXCITATIONS, excitation_named
from excite.plant import AbstractPlant, Aero2, CartPole, DCMotor
from excite.plant.catalogue import PLANTS, plant_named, with_sensor
from excite.policy import Layout, Policy
from excite.study.catalogue import shipped_studies, study_path
from excite.study.objectives import rewards_of
from excite.study.spec import Study, plant_tables, read_study

STUDIES = Path(__file__).parent.parent / "studies"

MINIMAL = """
name = "minimal"
plant = "aero2"

[methods.chirp]
excitation = "chirp"

[estimators.nls]
kind = "nls"
"""

FULL = """
name = "full"
title = "Everything"
plant = "aero2"
episodes = 7
num_steps = 60
seed = 3
spread = 0.1
inferred = ["one", "two"]
source = "nowhere"

[sensor.pitch]
noise_sd = 0.001
resolution = 0.002

[methods.own]
excitation = "prbs"
amplitude = 5
clock = 4
register = 6

[methods.chirp]
excitation = "chirp"
logarithmic = true

[estimators.arx-rls]
kind = "arx-rls"
start_covariance = 10
forgetting_factor = 0.99

[estimators.fine]
kind = "nls"
max_steps = 50
tolerance = 1e-6

[reference.own]
relative_error_percent = { J_p = [1, 2], K_pu = [3, 4], D_p = [5, 6] }
max_abs_output = [7, 8]
violations = "0/10"
"""


def study_of(text: str, folder: Path) -> Study:
    (folder / "study.toml").write_text(text, encoding="utf-8")
    return read_study(folder / "study.toml")


# What is written is understood


PUBLISHED = sorted(STUDIES.glob("oed_*.toml"))
"""Studies of published tasks."""


@pytest.mark.parametrize(
    "path", sorted({*STUDIES.glob("*.toml")} - {*PUBLISHED}), ids=lambda p: p.stem
)
def test_every_shipped_study_loads(path):
    study = read_study(path)
    assert study.name == path.stem
    assert study.episodes >= (100 if study.agents else 1000)
    own = {"paper": [], "robust": ["chirp", "ideal plant"], "wide": ["chirp"]}
    assert list(study.methods)[:3] == own.get(path.stem, ["random", "prbs", "chirp"])
    assert set(study.reference) <= {*study.methods, *study.agents}


@pytest.mark.parametrize("path", PUBLISHED, ids=lambda p: p.stem)
def test_every_study_of_a_published_task_loads(path):
    """Its plant stands in a file beside it, which is that of the examples."""
    study = read_study(path)
    file = Path(study.plant.partition(":")[0])
    assert study.name == path.stem
    assert file.parent == STUDIES
    assert file.resolve().parent == (STUDIES.parent / "examples").resolve()
    assert next(iter(study.methods)) == "random"
    assert study.gain is not None


def test_what_is_left_out_has_the_papers_value(tmp_path):
    study = study_of(MINIMAL, tmp_path)
    assert (study.num_steps, study.spread, study.seed) == (500, 0.3, 0)
    plant = study.build_plant()
    np.testing.assert_array_equal(plant.sensor.noise_sd, Aero2().sensor.noise_sd)
    estimator = study.build_estimators(plant)["nls"]
    assert isinstance(estimator, NLS)
    assert estimator == NLS()


def test_every_setting_arrives(tmp_path):
    study = study_of(FULL, tmp_path)
    assert (study.episodes, study.num_steps, study.seed, study.spread) == (7, 60, 3, 0.1)
    assert study.inferred == ["one", "two"]
    plant = study.build_plant()
    assert isinstance(plant, Aero2)
    assert plant.description.outputs[0].noise_sd == 0.001
    assert plant.description.outputs[0].resolution == 0.002
    own, chirp = study.build_methods(plant).values()
    assert isinstance(own, PRBS)
    assert (float(own.amplitude), own.clock, own.register) == (5.0, 4, 6)  # pyright: ignore[reportArgumentType]
    assert isinstance(chirp, Chirp)
    assert chirp.logarithmic
    assert chirp.amplitude is None
    arx, nls = study.build_estimators(plant).values()
    assert isinstance(arx, ARX)
    assert (float(arx.start_covariance), float(arx.forgetting_factor)) == (10.0, 0.99)
    assert isinstance(nls, NLS)
    assert (nls.max_steps, nls.tolerance) == (50, 1e-6)
    assert study.reference["own"].relative_error_percent["K_pu"] == (3, 4)


def test_a_study_is_a_fixed_object(tmp_path):
    study = study_of(MINIMAL, tmp_path)
    with pytest.raises(ValueError, match="frozen"):
        study.episodes = 5  # pyright: ignore[reportAttributeAccessIssue]


def test_a_study_survives_being_written_as_plain_data(tmp_path):
    study = study_of(FULL, tmp_path)
    assert Study.model_validate(study.model_dump(mode="json")) == study


def test_every_name_leads_to_its_object():
    for name, kind in PLANTS.items():
        plant = plant_named(name)
        assert type(plant) is kind
        assert plant.description.name == name
    for name, kind in EXCITATIONS.items():
        assert type(excitation_named(name, {}, Aero2())) is kind
    for name, estimator in ESTIMATORS.items():
        assert estimator_named(name) is estimator


# Overrides


def test_changed_leaves_everything_else_as_it_is(tmp_path):
    study = study_of(FULL, tmp_path)
    assert study.changed() == study
    assert study.changed(episodes=None, seed=None) == study
    other = study.changed(episodes=9, seed=11)
    assert (other.episodes, other.seed) == (9, 11)
    assert other.model_dump(exclude={"episodes", "seed"}) == study.model_dump(
        exclude={"episodes", "seed"}
    )


def test_changed_chooses_the_studys_own_estimators_before_any_other(tmp_path):
    study = study_of(FULL, tmp_path)
    plant = study.build_plant()
    chosen = study.changed(estimators="fine, arx-rls,arx-rls-wide").build_estimators(plant)
    assert list(chosen) == ["fine", "arx-rls", "arx-rls-wide"]
    covariances = [float(e.start_covariance) for e in chosen.values() if isinstance(e, ARX)]
    assert covariances == [10.0, 1e8]


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"estimators": "nlss"}, "unknown estimator 'nlss'; did you mean 'nls'"),
        ({"estimators": ""}, "unknown estimator ''"),
        ({"estimators": "nls,"}, "unknown estimator ''"),
        ({"episodes": 0}, "episodes must be greater than 0, got 0"),
        ({"episodes": -3}, "episodes must be greater than 0, got -3"),
        ({"seed": -1}, "seed must be greater than or equal to 0, got -1"),
        ({"episods": 5}, "unknown key 'episods'; did you mean 'episodes'"),
    ],
)
def test_changed_checks_as_the_file_is_checked(values, words, tmp_path):
    study = study_of(FULL, tmp_path)
    with pytest.raises(ValueError, match=words):
        study.changed(**values)


# Bad studies


def inserted(line: str, after: str = "", text: str = MINIMAL) -> str:
    """A study with one more line: after the one given, else at the top."""
    return text.replace(after, f"{after}\n{line}", 1) if after else f"{line}\n{text}"


BAD_STUDIES: dict[str, tuple[str, tuple[str, ...]]] = {
    "unknown key": (inserted("episode = 5"), ("unknown key 'episode'", "'episodes'?", "spread")),
    "unknown key far from any": (inserted("zzz = 5"), ("unknown key 'zzz'", "(there is name")),
    "unknown section": (
        inserted("[sensors.pitch]\nnoise_sd = 1", 'kind = "nls"'),
        ("unknown key 'sensors'", "'sensor'?"),
    ),
    "unknown key of a sensor": (
        inserted("[sensor.pitch]\nnoise = 1", 'kind = "nls"'),
        ("unknown key 'noise'", "'noise_sd'?"),
    ),
    "unknown key of a reference": (
        FULL.replace('violations = "0/10"', 'violation = "0/10"'),
        ("unknown key 'violation'", "'violations'?"),
    ),
    "unknown option of a method": (
        inserted("amplitud = 5", 'excitation = "chirp"'), ("'amplitud'", "'amplitude'?"),
    ),
    "option of another method": (
        inserted("clock = 5", 'excitation = "chirp"'), ("'clock'", "(there is amplitude"),
    ),
    "unknown option of an estimator": (
        inserted("max_step = 5", 'kind = "nls"'), ("'max_step'", "'max_steps'?"),
    ),
    "unknown plant": (
        MINIMAL.replace("aero2", "aero"), ("unknown plant 'aero'", "'aero2'?", "file.py:ClassName"),
    ),
    "unknown excitation": (
        MINIMAL.replace('excitation = "chirp"', 'excitation = "chrip"'),
        ("unknown excitation 'chrip'", "'chirp'?", "multisine"),
    ),
    "unknown estimator": (
        MINIMAL.replace('kind = "nls"', 'kind = "arx"'),
        ("unknown estimator 'arx'", "'arx-rls'?"),
    ),
    "unknown output": (
        inserted("[sensor.pich]\nnoise_sd = 1", 'kind = "nls"'), ("'pich'", "'pitch'?"),
    ),
    "negative noise": (FULL.replace("0.001", "-0.001"), ("sensor.pitch.noise_sd", "got -0.001")),
    "infinite noise": (
        FULL.replace("0.001", "inf"), ("sensor.pitch.noise_sd", "finite", "got inf"),
    ),
    "noise as text": (FULL.replace("0.001", '"0.001"'), ("sensor.pitch.noise_sd",)),
    "noise as truth": (FULL.replace("0.001", "true"), ("sensor.pitch.noise_sd",)),
    "zero episodes": (inserted("episodes = 0"), ("episodes", "greater than 0", "got 0")),
    "negative steps": (inserted("num_steps = -5"), ("num_steps", "greater than 0", "got -5")),
    "half an episode": (inserted("episodes = 1.5"), ("episodes must be a whole number, got 1.5",)),
    "episodes as text": (
        inserted('episodes = "10"'), ('episodes must be a whole number, got "10"',),
    ),
    "negative seed": (inserted("seed = -1"), ("seed", "got -1")),
    "seed beyond what a key can hold": (inserted(f"seed = {10**20}"), ("seed", f"{10**20}")),
    "spread of an agent of one": (
        inserted("spread = 1.0"), ("spread must lie in [0, 1), or be a factor", "got 1.0"),
    ),
    "spread as text": (inserted('spread = "0.3"'), ("spread must lie", "got '0.3'")),
    "spread that is no number": (inserted("spread = nan"), ("spread", "got nan")),
    "date for a seed": (inserted("seed = 2026-01-01"), ("seed must be a whole number",)),
    "coast of ppo": (
        inserted("coast = 5") + '[agents.a]\n', ("ppo does not train on the coast",),
    ),
    "coast on a rig": (
        inserted("coast = 5") + "[rig]\n", ("on a rig end with the last sample",),
    ),
    "negative coast": (inserted("coast = -1"), ("coast", "got -1")),
    "plant as number": (MINIMAL.replace('"aero2"', "2"), ("plant must be a string, got 2",)),
    "method as number": (
        MINIMAL.replace('[methods.chirp]\nexcitation = "chirp"', "[methods]\nchirp = 3"),
        ("methods.chirp must be a table, got 3",),
    ),
    "no plant": (MINIMAL.replace('plant = "aero2"', ""), ("key 'plant' is missing",)),
    "no excitation": (
        MINIMAL.replace('excitation = "chirp"', ""), ("'methods.chirp.excitation' is missing",),
    ),
    "no methods": (
        MINIMAL.replace('[methods.chirp]\nexcitation = "chirp"', ""), ("no methods",),
    ),
    "unknown agent setting": (MINIMAL + '[agents.a]\nkind = "ppo"\n', ("unknown key 'kind'",)),
    "unknown trainer": (MINIMAL + '[agents.a]\nmethod = "sac"\n', ("agents.a.method", "sac")),
    "unknown target": (MINIMAL + '[agents.a]\ntargets = ["K"]\n', ("no parameter 'K'", "J_p")),
    "no target": (MINIMAL + "[agents.a]\ntargets = []\n", ("at least one parameter",)),
    "unknown training setting": (
        MINIMAL + "[agents.a]\n[training]\nlr = 1\n", ("training setting 'lr'", "learning_rate"),
    ),
    "negative training steps": (
        MINIMAL + "[agents.a]\n[training]\ntotal_steps = -5\n", ("total_steps", "-5"),
    ),
    "text for a number": (
        MINIMAL + '[agents.a]\n[training]\ngamma = "big"\n',
        ('training: gamma must be a number, got "big"',),
    ),
    "unknown decision setting": (
        MINIMAL + "[agents.a]\n[decision]\nwindows = 3\n", ("did you mean 'window'",),
    ),
    "unknown reward": (
        MINIMAL + '[agents.a]\n[decision]\nreward = "nice"\n',
        ("reward must be 'relative', 'log', 'goals', 'information', 'contrast',", "nice"),
    ),
    "window beyond any memory": (
        MINIMAL + "[agents.a]\n[decision]\nwindow = 100000000000\n",
        ("decision: window must be less than or equal to 10000, got 100000000000",),
    ),
    "goals of the information": (
        MINIMAL + "[agents.a]\n[decision]\nreward = 'information'\ngoals = { J_p = 1 }\n",
        ("agents.a: decision: the reward 'information' has no 'goals'",),
    ),
    "goals of the information, unsaid": (
        MINIMAL.replace("aero2", "dc_motor") + "[agents.a]\n[decision]\ngoals = { R = 1 }\n",
        ("agents.a: decision: the reward 'information' has no 'goals'",),
    ),
    "a criterion of errors": (
        MINIMAL + '[agents.a.decision]\nreward = "relative"\ncriterion = "A"\n',
        ("decision: the reward 'errors of an ARX estimator' has no 'criterion'",),
    ),
    "a criterion of errors, unsaid": (
        MINIMAL + '[agents.a.decision]\ncriterion = "A"\n',
        ("decision: the reward 'errors of an ARX estimator' has no 'criterion'",),
    ),
    "a start covariance of nls": (
        MINIMAL + '[agents.a.decision]\nreward = "log"\nestimator = "nls"\nstart_covariance = 5\n',
        ("decision: the reward 'errors of nls' has no 'start_covariance'",),
    ),
    "a term that is not that of its reward": (
        MINIMAL + '[agents.a.decision]\nterms = [{ reward = "log", max_sensitivity = 3 }]\n',
        ("decision: the reward 'errors of an ARX estimator' has no 'max_sensitivity'",),
    ),
    "no terms": (MINIMAL + "[agents.a.decision]\nterms = []\n", ("terms", "at least 1")),
    "a reward beside terms": (
        MINIMAL + "[agents.a]\n[agents.a.decision]\nreward = 'log'\nterms = [{ weight = 2.0 }]\n",
        ("agents.a: decision: with terms, set 'reward' in one of them",),
    ),
    "an unknown key in a term": (
        MINIMAL + "[agents.a]\n[decision]\nterms = [{ wight = 2.0 }]\n", ("wight", "weight"),
    ),
    "goals of a term of information": (
        MINIMAL + "[agents.a]\n[decision]\n"
        "terms = [{ reward = 'information', goals = { J_p = 1 } }]\n",
        ("agents.a: decision: the reward 'information' has no 'goals'",),
    ),
    "negative phases": (
        MINIMAL.replace('excitation = "chirp"', 'excitation = "multisine"\nphases = -1'),
        ("phases is 0 or the seed of random ones: got -1",),
    ),
    "a target twice": (
        MINIMAL + '[agents.a]\ntargets = ["J_p", "J_p"]\n', ("targets must differ", "J_p, J_p"),
    ),
    "agents and one step": (
        inserted("num_steps = 1") + "[agents.a]\n", ("num_steps must be at least 2",),
    ),
    "training beyond its range": (
        MINIMAL + "[agents.a]\n[training]\naverage_last = 1\n",
        ("study.toml: training: average_last must lie in [0, 1): got 1",),
    ),
    "date for a hyper-parameter": (
        MINIMAL + "[agents.a]\n[training]\ngamma = 2026-01-01\n",
        ("training: gamma must be a number",),
    ),
    "widths as one number": (
        MINIMAL + "[agents.a]\n[training]\nhidden = 5\n",
        ("training: hidden must be a list such as [5], got 5",),
    ),
    "no term of a reward": (
        MINIMAL + "[agents.a]\n[decision]\nterms = []\n",
        ("decision: terms needs at least 1 in its list, got []",),
    ),
    "a term of a reward twice": (
        MINIMAL + '[agents.a]\n[decision]\nterms = [{ reward = "log" }, { reward = "log" }]\n',
        ("decision: terms must differ: got 'log' twice",),
    ),
    "truth as a word": (
        MINIMAL + '[agents.a]\n[decision]\nnormalise_penalty = "yes"\n',
        ("decision: normalise_penalty must be true or false",),
    ),
    "policy that is nowhere": (
        MINIMAL + '[methods.p]\nexcitation = "policy.safetensors"\n',
        ("policy.safetensors: cannot be read",),
    ),
    "amplitude of an agent beyond the limits": (
        MINIMAL + "[agents.a]\n[decision]\ninput_amplitude = { voltage = 25.0 }\n",
        ("agents.a: input_amplitude of 'voltage' is at most 24: got 25",),
    ),
    "amplitude of an unknown input": (
        MINIMAL + "[agents.a]\n[decision]\ninput_amplitude = { voltag = 5.0 }\n",
        ("unknown input in input_amplitude 'voltag'", "voltage"),
    ),
    "spread of one": (
        MINIMAL + "[agents.a]\n[decision]\nspread = 1.0\n", ("decision: spread", "1"),
    ),
    "negative goal": (
        MINIMAL + "[agents.a]\n[decision]\ngoals = { J_p = -1 }\n", ("goals.J_p", "-1"),
    ),
    "unknown goal": (
        MINIMAL + "[agents.a]\n[decision]\ngoals = { J = 1 }\n", ("no parameter 'J'",),
    ),
    "unknown output scale": (
        MINIMAL + "[agents.a]\n[decision]\noutput_scale = { p = 1 }\n", ("output_scale 'p'",),
    ),
    "negative seeds": (MINIMAL.replace("aero2", 'aero2"\nseeds = -1 #'), ("seeds", "-1")),
    "agent named like a method": (MINIMAL + "[agents.chirp]\n", ("both a method and an agent",)),
    "reward from the decrement": (
        MINIMAL + '[agents.a]\n[decision]\nestimator = "decrement"\n',
        ("needs an ARX estimator",),
    ),
    "length of no experiment": (
        MINIMAL.replace("aero2", 'aero2"\nlengths = [50, 501] #'),
        ("lengths must lie between 2 and num_steps: got 501",),
    ),
    "reward from ARX without a mapping": (
        MINIMAL.replace("aero2", "dc_motor") + '[agents.a]\n[decision]\nreward = "log"\n',
        ("mapping from ARX", "'information'"),
    ),
    "empty methods": (
        MINIMAL.replace('[methods.chirp]\nexcitation = "chirp"', "[methods]"), ("no methods",),
    ),
    "amplitude beyond the limits": (
        inserted("amplitude = 25", 'excitation = "chirp"'),
        ("amplitude 25 V", "'voltage'", "from 0 to 24 V"),
    ),
    "negative amplitude": (
        inserted("amplitude = -1", 'excitation = "chirp"'), ("-1 V", "from 0 to 24 V"),
    ),
    "two amplitudes for one input": (
        inserted("amplitude = [1, 2]", 'excitation = "chirp"'), ("2 amplitudes", "1 inputs"),
    ),
    "amplitude as text": (
        inserted('amplitude = "7.2"', 'excitation = "chirp"'), ("amplitude", "a number", "'7.2'"),
    ),
    "amplitude as code": (
        inserted('amplitude = "3 + 4"', 'excitation = "chirp"'), ("a number", "'3 + 4'"),
    ),
    "amplitude as truth": (
        inserted("amplitude = true", 'excitation = "chirp"'), ("amplitude", "a number", "True"),
    ),
    "truth as number": (
        inserted("logarithmic = 1", 'excitation = "chirp"'), ("true or false", "got 1"),
    ),
    "frequency beyond half the sampling rate": (
        inserted("stop_frequency = 6.0", 'excitation = "chirp"'),
        ("stop_frequency 6 Hz", "at most 5 Hz"),
    ),
    "frequency of zero": (
        inserted("start_frequency = 0", 'excitation = "chirp"'),
        ("start_frequency 0 Hz", "above 0"),
    ),
    "two frequencies": (
        inserted("start_frequency = [0.1, 0.2]", 'excitation = "chirp"'), ("start_frequency",),
    ),
    "half a clock": (FULL.replace("clock = 4", "clock = 1.5"), ("clock", "whole number", "1.5")),
    "clock of zero": (FULL.replace("clock = 4", "clock = 0"), ("clock", "at least 1")),
    "register without taps": (FULL.replace("register = 6", "register = 40"), ("2 to 16", "40")),
    "negative option of an estimator": (
        FULL.replace("start_covariance = 10", "start_covariance = -10"),
        ("start_covariance", "positive", "-10"),
    ),
    "forgetting factor above one": (
        FULL.replace("forgetting_factor = 0.99", "forgetting_factor = 1.5"),
        ("forgetting_factor", "1.5"),
    ),
    "several start covariances": (
        FULL.replace("start_covariance = 10", "start_covariance = [10, 20]"),
        ("start_covariance", "[10, 20]"),
    ),
    "no steps of a search": (inserted("max_steps = 0", 'kind = "nls"'), ("max_steps", "0")),
    "negative tolerance": (inserted("tolerance = -1", 'kind = "nls"'), ("tolerance", "-1")),
    "an option of earlier versions": (
        inserted("horizons = [0.1, 1.0]", 'kind = "nls"'), ("horizons", "segment_length"),
    ),
    "segments of no length": (
        inserted("segment_length = 0", 'kind = "nls"'), ("segment_length", "0"),
    ),
    "segments of half a sample": (
        inserted("segment_length = 20.5", 'kind = "nls"'), ("segment_length", "a whole number"),
    ),
    "reference of an unknown parameter": (
        FULL.replace("J_p = [1, 2]", "J_q = [1, 2]"), ("J_q", "J_p"),
    ),
    "reference of an unknown method": (
        FULL.replace("[reference.own]", "[reference.owm]"), ("'owm'", "'own'?"),
    ),
    "ARX for a plant without mapping": (
        MINIMAL.replace("aero2", "dc_motor").replace('kind = "nls"', 'kind = "arx-rls"'),
        ("needs a plant with a mapping", "'dc_motor' has none", "'nls'"),
    ),
    "no TOML": ("methods = [", ("not valid TOML",)),
    "a key twice": (inserted("seed = 1\nseed = 2"), ("not valid TOML", "seed")),
    "nothing": ("", ("'name' is missing",)),
}  # fmt: skip


@pytest.mark.parametrize(("text", "fragments"), BAD_STUDIES.values(), ids=list(BAD_STUDIES))
def test_a_study_that_cannot_be_run_is_one_sentence(text, fragments, tmp_path):
    with pytest.raises(ValueError, match=r"study\.toml: ") as error:
        study_of(text, tmp_path)
    sentence = str(error.value)
    assert "\n" not in sentence
    assert [f for f in fragments if f not in sentence] == []
    assert not re.search("Input should|Value error|Settings", sentence)


def test_an_agent_need_not_use_what_all_have_in_common(tmp_path):
    text = MINIMAL + (
        "[decision]\ngoals = { J_p = 1 }\n"
        '[agents.a]\n[agents.b]\ndecision = { reward = "information" }\n'
    )
    assert list(study_of(text, tmp_path).agents) == ["a", "b"]


# A trained policy


def write_policy(path: Path, plant: AbstractPlant, num_steps: int) -> None:
    layout = Layout.of(plant.description, 5, num_steps)
    path.write_bytes(
        Policy(plant.description, layout, ((np.ones((1, 11)), np.zeros(1)),)).to_bytes()
    )


POLICY = '[methods.p]\nexcitation = "mine/policy.safetensors"\n'


def test_a_policy_is_found_beside_its_study(tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "mine").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    write_policy(tmp_path / "mine/policy.safetensors", Aero2(), 500)
    study = study_of(MINIMAL + POLICY, tmp_path)
    assert isinstance(study.build_methods(study.build_plant())["p"], PolicyExcitation)
    assert study.warnings() == []
    write_policy(tmp_path / "mine/policy.safetensors", Aero2(m=1.0), 500)
    (warning,) = study.warnings()
    assert "mine/policy.safetensors: the policy was trained on another 'aero2'" in warning


def test_a_policy_for_shorter_experiments_is_refused_with_the_study(tmp_path):
    (tmp_path / "mine").mkdir()
    write_policy(tmp_path / "mine/policy.safetensors", Aero2(), 40)
    words = r"mine/policy\.safetensors: the policy was made for 40 steps; .* has 500"
    with pytest.raises(ValueError, match=words):
        study_of(MINIMAL + POLICY, tmp_path)


@pytest.mark.parametrize("kind", ["missing", "folder", "binary"])
def test_a_file_that_is_no_text_is_said(kind, tmp_path):
    path = tmp_path / "study.toml"
    if kind == "folder":
        path.mkdir()
    elif kind == "binary":
        path.write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(ValueError, match=r"study\.toml: cannot be read"):
        read_study(path)


def test_the_sensor_of_an_output_is_changed_alone():
    plant = CartPole()
    changed = with_sensor(plant, {"angle": 0.5}, {"position": 0.25})
    np.testing.assert_array_equal(changed.sensor.noise_sd, [plant.sensor.noise_sd[0], 0.5])
    np.testing.assert_array_equal(changed.sensor.resolution, [0.25, plant.sensor.resolution[1]])
    with pytest.raises(ValueError, match="noise of 'angle' must be zero or positive: got -1"):
        with_sensor(plant, {"angle": -1.0}, {})
    with pytest.raises(ValueError, match=r"'angel'; did you mean 'angle'"):
        with_sensor(plant, {}, {"angel": 1.0})


def test_each_input_may_have_an_amplitude_of_its_own():
    excitation = excitation_named("random", {"amplitude": [3]}, DCMotor())
    assert isinstance(excitation, Random)
    np.testing.assert_array_equal(excitation.amplitude, [3.0])  # pyright: ignore[reportArgumentType]
    assert isinstance(excitation_named("multisine", {"start_frequency": 1}, Aero2()), Multisine)


# A user's own plant


PLANT_FILE = """
import math

import jax.numpy as jnp
from excite.description import Constant, Input, Output, Parameter, PlantDescription, State
from excite.plant import AbstractPlant


class Tank(AbstractPlant):
    definition = PlantDescription(
        name="tank",
        states=(State("level", "m"),),
        constants=(Constant("g", "m/s²", 9.81),),
        inputs=(Input("flow", "m³/s", 0.0, 1.0),),
        outputs=(Output("level_m", "m", 1.0, noise_sd=0.01),),
        parameters=(Parameter("area", "m²", 2.0), Parameter("leak", "m²/s", 0.3)),
        dt=0.5,
        band=(0.01, 0.5),
    )

    def derivative(self, state, input, params):
        return (input - params.leak * state) / params.area

    def output(self, state, params):
        return state


class Half(AbstractPlant):
    definition = Tank.definition

    def output(self, state, params):
        return state


class Nameless(AbstractPlant):
    def derivative(self, state, input, params):
        return state

    def output(self, state, params):
        return state


class Wide(Tank):
    def output(self, state, params):
        return jnp.concatenate([state, state])


class Typo(Tank):
    def derivative(self, state, input, params):
        return params.aera * state


class Leaving(Tank):
    def derivative(self, state, input, params):
        raise SystemExit(3)


class Refusing(Tank):
    def __init__(self):
        raise RuntimeError("no")


class Complex(Tank):
    def output(self, state, params):
        return 1j * state


class Listed(Tank):
    def derivative(self, state, input, params):
        return [-state[0]]


class Paired(Tank):
    def output(self, state, params):
        return state, state


class Silent(Tank):
    def output(self, state, params):
        pass


class Math(Tank):
    def derivative(self, state, input, params):
        return jnp.stack([-math.sin(state[0])])


class MathOfConstant(Tank):
    def derivative(self, state, input, params):
        return -math.sqrt(self.constants.g) * state


class Branching(Tank):
    def derivative(self, state, input, params):
        return -state if self.constants.g > 0 else state


class OtherConstant(Tank):
    def derivative(self, state, input, params):
        return -self.constants.gg * state


class OfPlant(Tank):
    def derivative(self, state, input, params):
        return -self.g * state


class Late(Tank):
    def delay(self, params):
        return [params.leak]


number = 3
"""


@pytest.fixture
def plant_file(tmp_path: Path) -> Path:
    (tmp_path / "tank.py").write_text(PLANT_FILE)
    return tmp_path / "tank.py"


@pytest.fixture(autouse=True)
def _forget_user_modules():
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        if name.startswith("excite_file_"):
            del sys.modules[name]


def test_a_users_plant_is_named_by_file_and_class(plant_file, tmp_path, monkeypatch):
    plant = plant_named(f"{plant_file}:Tank")
    assert plant.description.name == "tank"
    rate = plant.derivative(jnp.array([1.0]), jnp.array([0.5]), plant.nominal)
    np.testing.assert_allclose(rate, [0.1])
    monkeypatch.chdir(tmp_path)
    assert plant_named("tank.py:Tank").description == plant.description


def test_a_study_takes_a_users_plant(plant_file, tmp_path):
    text = MINIMAL.replace("aero2", f"{plant_file}:Tank")
    assert study_of(text, tmp_path).build_plant().description.name == "tank"


def test_a_users_plant_is_found_beside_its_study(plant_file, tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    text = MINIMAL.replace("aero2", f"{plant_file.name}:Tank")
    assert study_of(text, tmp_path).build_plant().description.name == "tank"


@pytest.mark.parametrize(
    ("class_name", "words"),
    [
        ("Tanc", "has no plant class 'Tanc'; it has Tank, Half, Nameless, Wide"),
        ("number", "has no plant class 'number'"),
        ("State", "State in .* is no plant: it is not derived from AbstractPlant"),
        ("", "is a file: name the plant in it as .*tank.py:Tank or .*tank.py:Half"),
        ("Half", "Half in .* is not a complete plant: .*derivative"),
        ("Wide", r"output of Wide in .* returns shape \(2,\); .*\(1,\) is needed"),
        ("Typo", "derivative of Typo in .*: unknown parameter 'aera'; did you mean 'area'?"),
        ("OtherConstant", r"unknown constant 'gg'; did you mean 'g'\? \(there is g\)"),
        ("OfPlant", r"the constant self\.g is self\.constants\.g"),
        ("Listed", r"returns a list; one array of shape \(1,\) is needed, such as jnp\.stack"),
        ("Paired", r"output of Paired in .* returns a tuple; .*jnp\.stack"),
        ("Silent", r"output of Silent in .* returns None; .*jnp\.stack"),
        ("Late", r"delay of Late in .* returns a list; .*jnp\.stack"),
        ("Math", "Math in .* function of math, which take no JAX values: .* jnp.sin for math.sin"),
        ("MathOfConstant", "a constant to .* a function of math, .* jnp.sin for math.sin"),
        ("Branching", r"branches on the value of .* or a constant .*: use jnp\.where"),
        ("Nameless", "Nameless in .* is not a complete plant: .*definition"),
        ("Leaving", "derivative of Leaving in .* fails: SystemExit: 3"),
        ("Refusing", "Refusing in .* cannot be made: RuntimeError: no"),
        ("Complex", "output of Complex in .* returns complex numbers; real ones are needed"),
    ],
)
def test_what_is_no_plant_class_is_said(class_name, words, plant_file):
    with pytest.raises(ValueError, match=words) as error:
        plant_named(f"{plant_file}:{class_name}")
    assert str(plant_file) in str(error.value)


def test_a_file_without_a_class_names_its_classes(plant_file):
    with pytest.raises(ValueError, match=f"{plant_file} is a file: .* as {plant_file}:Tank or "):
        plant_named(str(plant_file))
    plant_file.write_text("from excite.plant import Aero2\nclass Own(Aero2):\n    pass")
    with pytest.raises(ValueError, match=f"name the plant in it as {plant_file}:Own$"):
        plant_named(f"{plant_file}+delay")
    plant_file.write_text("from excite.plant import Aero2")
    with pytest.raises(ValueError, match=r"name the plant in it as .*:ClassName$"):
        plant_named(str(plant_file))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("class Tank(:\n    pass", "SyntaxError"),
        ("import a_module_that_is_nowhere", "ModuleNotFoundError.*a_module_that_is_nowhere"),
        ("1 / 0", "ZeroDivisionError"),
        (PLANT_FILE.replace("dt=0.5", "dt=-0.5"), "dt must be positive: got -0.5"),
        ("import sys\nsys.exit(3)", "SystemExit"),
        ("raise GeneratorExit", "GeneratorExit$"),
        ("class B(BaseException):\n    pass\nraise B('x')", "B: x$"),
        ("class E(Exception):\n    def __str__(self):\n        1 / 0\nraise E", "imported: E$"),
        ("raise ValueError('x' * 10**5)", "ValueError: .{,500}$"),
    ],
)
def test_a_plant_file_that_cannot_be_imported_is_said(content, words, plant_file):
    plant_file.write_text(content)
    with pytest.raises(ValueError, match=words) as error:
        plant_named(f"{plant_file}:Tank")
    assert str(plant_file) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["nowhere.py:Tank", "folder.py:Tank"])
def test_a_plant_file_that_is_not_there_is_said(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.py").mkdir()
    with pytest.raises(ValueError, match="no such file"):
        plant_named(name)


@pytest.mark.parametrize("name", ["Aero2", "aero3", "tank.py", "tank.txt:Tank", ""])
def test_a_name_that_is_no_plant_is_said(name):
    with pytest.raises(
        ValueError, match=r"unknown plant .* \(there is aero2, .*ClassName, .*json\)"
    ):
        plant_named(name)


@pytest.mark.parametrize(
    "name", ["__import__('pathlib').Path('trace').touch()", "open('trace', 'w').py:Tank"]
)
def test_no_name_is_evaluated(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"unknown plant|no such file"):
        plant_named(name)
    for lookup in (estimator_named, lambda n: excitation_named(n, {}, Aero2())):
        with pytest.raises(ValueError, match=r"unknown|no such file"):
            lookup(name)
    assert list(tmp_path.iterdir()) == []


def test_option_names_are_those_of_the_excitations():
    """No option of an excitation is out of a study's reach."""
    values = {
        "amplitude": 1.0, "hold": 2, "clock": 2, "register": 5, "start_frequency": 0.2,
        "stop_frequency": 1.0, "frequency": 0.5, "logarithmic": True,
        "pump": 0.25, "phases": 3,
    }  # fmt: skip
    for name, kind in EXCITATIONS.items():
        options = {f.name: values[f.name] for f in dataclasses.fields(kind)}
        built = excitation_named(name, options, Aero2())
        for option, value in options.items():
            assert float(getattr(built, option)) == value


def test_terms_are_added_and_replace_what_agents_share(tmp_path):
    text = """
[decision]
reward = "information"
[agents.a]
[agents.b.decision]
terms = [{ reward = "information", weight = 0.5 }, { reward = "goals", estimator = "nls" }]
"""
    study = study_of(MINIMAL + text, tmp_path)

    def objective(name):
        env = study.agent(name).env(study.build_plant(), study.spread, study.num_steps)
        return env.objective

    assert isinstance(objective("a"), InformationGain)
    both = objective("b")
    assert isinstance(both, WeightedSum)
    first, second = both.terms
    assert isinstance(first, InformationGain)
    assert isinstance(second, OutputError)
    assert (float(first.weight), second.form) == (0.5, "goals")
    assert "terms" not in study.agent("a").settings(study.build_plant())["decision"]
    assert len(study.agent("b").settings(study.build_plant())["decision"]["terms"]) == 2


def test_an_agent_has_a_range_and_plants_of_its_own(tmp_path):
    text = "[agents.a]\n[decision]\ninput_amplitude = { voltage = 7.2 }\nspread = 0.1\n"
    study = study_of(MINIMAL + text, tmp_path)
    env = study.agent("a").env(study.build_plant(), study.spread, study.num_steps)
    assert env.layout.input_half == (7.2,)
    assert float(env.spread.reach) == 0.1


# Shipped studies


def test_shipped_studies_are_found_by_name_and_an_unknown_one_names_the_nearest():
    assert set(shipped_studies()) == {path.stem for path in STUDIES.glob("*.toml")}
    assert study_path("table1") == shipped_studies()["table1"]
    assert study_path("no/such.toml") == Path("no/such.toml")  # refused where it is read
    with pytest.raises(ValueError, match=r"unknown study 'tabel1'; did you mean 'table1'\?"):
        study_path("tabel1")


def test_the_files_of_a_shipped_study_are_found_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    named = read_study(study_path("frontier")).methods["robust"].excitation
    assert Path(named) == shipped_studies()["frontier"].with_name("frontier_robust.csv")


# --------------------------------------------------- studies composed from names and objects


def test_objectives_are_rewards_by_name_with_weights():
    assert rewards_of("D", {}) == {"D": {"reward": "information", "criterion": "D"}}
    both = rewards_of(["D", "log=2"], {"J_p": 0.01})
    assert both["log"] == {"reward": "log", "goals": {"J_p": 0.01}, "weight": 2.0}
    assert "goals" not in both["D"]
    assert rewards_of({"D": 1, "nls": 0.5}, {})["nls"]["estimator"] == "nls"
    for wrong, sentence in (
        ("X", "unknown objective 'X'"),
        (["D", "D=2"], "must differ from each other"),
        ("log=x", "the weight of 'log' must be a number"),
    ):
        with pytest.raises(ValueError, match=sentence):
            rewards_of(wrong, {})


class Local(Aero2):
    """A plant class of this file."""


def test_a_study_names_a_plant_that_is_given_as_an_object():
    noisy = with_sensor(Aero2(), {"pitch": 0.02}, {"pitch": 0.001})
    tables, built = plant_tables(noisy)
    assert tables == {
        "plant": "aero2", "sensor": {"pitch": {"noise_sd": 0.02, "resolution": 0.001}}
    }  # fmt: skip
    assert built.description == noisy.description
    assert plant_tables(Aero2, {"pitch": 0.5})[0]["sensor"] == {"pitch": {"noise_sd": 0.5}}
    assert plant_tables(Local)[0]["plant"] == f"{__file__}:Local"
    with pytest.raises(ValueError, match="differs from its class"):
        plant_tables(Aero2(dt=0.05))
    with pytest.raises(ValueError, match=r"save it in a file .*'plant.py:Typed'"):
        plant_tables(type("Typed", (Aero2,), {"__module__": "nowhere"}))
