"""Designs and policies from the command line, and a study measured by clairvoyant signals."""

import json
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import excite

from excite.environment import run_episodes
from excite.excitation import Replay
from excite.excitation.catalogue import excitation_named
from excite.plant import Aero2
from excite.plant.catalogue import plant_named
from excite.policy import read_policy, shipped_policies
from excite.record import read_record
from excite.simulation import run_episode
from excite.study.falsify import trained_in
from excite.study.table import study_table

STUDY = """
name = "tiny"
plant = "aero2"
episodes = 6
num_steps = 60
seeds = 1
lengths = [30, 60]
[clairvoyant]
plants = 2
starts = 2
[methods.chirp]
excitation = "chirp"
[methods.robust]
excitation = "robust.csv"
[methods.loop]
excitation = "loop-square"
amplitude = 0.2
frequency = 0.2
[agents.gradient]
method = "gradient"
[agents.gradient.decision]
reward = "information"
window = 5
[agents.gradient.training]
num_updates = 3
num_plants = 4
watch_episodes = 4
[estimators.arx-rls]
kind = "arx-rls"
[estimators.nls]
kind = "nls"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A designed signal, and a study that plays it."""
    place = tmp_path_factory.mktemp("frontier")
    done = excite(
        *("design", "aero2", "--out", place / "robust.csv", "--steps", 60, "--updates", 60),
        *("--starts", 2, "--plot", place / "robust.png", "--json"),
    )
    assert done.returncode == 0, done.stderr
    (place / "design.json").write_text(done.stdout)
    (place / "tiny.toml").write_text(STUDY)
    done = excite("study", "run", place / "tiny.toml", "--out", place / "run", "--workers", 1)
    assert done.returncode == 0, done.stderr
    return place


def test_a_designed_signal_is_what_its_summary_says(folder):
    said = json.loads((folder / "design.json").read_text())
    plant = Aero2()
    signal = excitation_named(str(folder / "robust.csv"), {}, plant)
    assert isinstance(signal, Replay)
    keys = jax.random.split(jax.random.key(1), 1000)
    episodes = run_episodes(plant, signal, 60, 0.3, keys)
    log_det = np.linalg.slogdet(np.asarray(episodes.information))[1].mean()
    assert said["log_det_information"] == pytest.approx(log_det, rel=1e-4)
    assert said["violations"] == int(episodes.is_violation.sum()) <= 3
    assert len(said["worth_by_start"]) == 2
    assert (folder / "robust.png").stat().st_size > 10_000


def test_a_tuned_loop_is_what_its_options_say(tmp_path):
    done = excite(
        *("design", "aero2", "--kind", "loop-square", "--out", tmp_path / "loop.csv"),
        *("--steps", 40, "--trials", 3, "--json"),
    )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    plant = plant_named("aero2")
    loop = excitation_named("loop-square", said["options"], plant)
    run = run_episode(plant, plant.nominal, loop, 40, jax.random.key(0))
    inputs = read_record(tmp_path / "loop.csv", plant.description).inputs[:-1]
    np.testing.assert_allclose(inputs, run.inputs, rtol=1e-9)
    # What is said of the file is said of the file: no loop is closed when it is played.
    played = Replay(jnp.asarray(inputs))
    episodes = run_episodes(plant, played, 40, 0.3, jax.random.split(jax.random.key(1), 1000))
    log_det = np.linalg.slogdet(np.asarray(episodes.information))[1].mean()
    assert said["log_det_information"] == pytest.approx(log_det, rel=1e-6)
    assert said["violations"] == int(np.sum(episodes.is_violation))
    assert said["as_excitation"]["evaluations"] == 1000


def test_efficiency_compares_with_the_clairvoyant_signals_on_their_plants(folder):
    rows = json.loads((folder / "run" / "table.json").read_text())["rows"]
    assert {row["method"] for row in rows} == {
        "chirp", "robust", "loop", "gradient", "clairvoyant"
    }  # fmt: skip
    best = next(row for row in rows if row["method"] == "clairvoyant")
    assert best["evaluations"] == 2
    assert best["violations"] == 0
    assert best["d_efficiency"] == 1
    for row in rows:
        gap = row["log_det_of_clairvoyant_plants"] - best["log_det_information"]
        assert row["d_efficiency"] == pytest.approx(math.exp(gap / 3))
        assert row["d_efficiency"] <= 1
    chirp = rows[0]
    keys = jax.random.split(jax.random.key(0), 6)
    episodes = run_episodes(Aero2(), excitation_named("chirp", {}, Aero2()), 60, 0.3, keys)
    own = np.linalg.slogdet(np.asarray(episodes.information))[1]
    assert chirp["log_det_information"] == pytest.approx(own.mean())
    assert chirp["log_det_of_clairvoyant_plants"] == pytest.approx(own[:2].mean())


def test_bounds_of_shorter_experiments_are_larger(folder):
    for row in study_table(folder / "run").data()["rows"]:
        if row["method"] != "clairvoyant":
            bound = row["bound_by_length"]
            assert bound["num_steps"] == [30, 60]
            for name, (short, long) in bound["cramer_rao_percent"].items():
                assert long < short
                assert long == pytest.approx(row["cramer_rao_percent"][name], rel=1e-6)


def test_the_table_shows_information_and_figures_are_drawn(folder):
    shown = excite("study", "table", folder / "run", "--json")
    row = json.loads(shown.stdout)["rows"][0]
    assert row["log_det_information"] > 0
    assert 0 < row["d_efficiency"] < 1
    for name in ("frontier.png", "lengths.png"):
        assert (folder / "run" / name).stat().st_size > 10_000
    assert "D-efficiency" in (folder / "run" / "table.md").read_text()
    assert "d_efficiency" in (folder / "run" / "table.csv").read_text()


def test_a_finished_study_designs_nothing_again(folder):
    before = (folder / "run" / "clairvoyant.json").stat().st_mtime_ns
    done = excite("study", "run", folder / "tiny.toml", "--out", folder / "run", "--workers", 1)
    assert done.returncode == 0
    assert (folder / "run" / "clairvoyant.json").stat().st_mtime_ns == before


def test_a_benchmark_of_clairvoyant_signals_points_to_the_study(folder):
    text = STUDY[: STUDY.index("[agents")] + STUDY[STUDY.index("[estimators.arx-rls]") :]
    (folder / "designs.toml").write_text(text)
    done = excite("benchmark", folder / "designs.toml")
    assert done.returncode == 2
    assert "has signals to design: excite study run" in done.stderr


def test_a_policy_file_is_scored_with_the_row_of_a_study(folder):
    policy = next((folder / "run" / "seeds").rglob("policy.safetensors"))
    done = excite("evaluate", policy, "--episodes", 5, "--seed", 3, "--json")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    rows = said["rows"]
    assert said["policy_hash"] == read_policy(policy).hash
    assert (said["study"]["episodes"], said["study"]["seed"]) == (5, 3)
    assert [row["estimator"] for row in rows] == ["arx-rls", "nls"]
    assert rows[0]["evaluations"] == 5
    assert rows[0]["log_det_information"] == rows[1]["log_det_information"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("evaluate", "chrip"), "unknown policy 'chrip'"),
        (("evaluate", "nowhere.safetensors"), "nowhere.safetensors: cannot be read"),
        (("evaluate", "aero2", "--plant", "emps"), "trained for the input 'voltage'"),
        (("evaluate", "aero2", "--episodes", 0), "0 is not in the range"),
        (("evaluate", "aero2", "--spread", 1.5), "spread"),
        (("design", "aero3", "--out", "x.csv"), "unknown plant 'aero3'; did you mean 'aero2'"),
        (("design", "aero2", "--out", "x.txt"), "x.txt"),
        (("design", "aero2", "--kind", "chrip", "--out", "x.csv"), "did you mean 'chirp'"),
        (
            ("design", "aero2", "--spread", 1, "--out", "x.csv"),
            "'1' is not allowed: it must lie in [0, 1), or be a factor",
        ),
    ],
)
def test_what_is_not_allowed_is_a_sentence(arguments, words, tmp_path):
    done = excite(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert words in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


def test_shipped_policies_are_listed_sound_and_safe():
    listed = json.loads(excite("policies", "--json").stdout)["policies"]
    assert [p["name"] for p in listed] == list(shipped_policies())
    for name, path in shipped_policies().items():
        policy = read_policy(path)
        plant = plant_named(policy.plant.name)
        assert policy.plant.hash == plant.description.hash, name
        spread, _, coast = trained_in(policy, plant)
        episodes = run_episodes(
            plant, excitation_named(name, {}, plant), policy.layout.num_steps, spread,
            jax.random.split(jax.random.key(77), 100), None, coast,
        )  # fmt: skip
        assert not jnp.any(episodes.is_violation), name


def test_a_signal_of_another_sampling_time_is_refused(folder):
    with pytest.raises(ValueError, match=r"its sampling time is 0\.1 s; 'emps' has 0\.02 s|force"):
        excitation_named(str(folder / "robust.csv"), {}, plant_named("emps"))
