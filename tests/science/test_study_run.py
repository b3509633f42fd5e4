"""A tiny study, trained from end to end: interrupted, repeated, refused, shown."""

import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest
import scipy.stats
from cluster import Cluster, wait_for
from commands import PATIENCE, excite

from excite.environment import run_episodes
from excite.excitation import PolicyExcitation
from excite.files import write_json
from excite.policy import read_policy
from excite.report.rows import SeedMetrics
from excite.study import table
from excite.study.engine import local_engine
from excite.study.folder import seed_folder, study_of
from excite.study.run import _live, _require_trainer, opened, run_study, run_tasks
from excite.study.spec import read_study, study_from
from excite.study.table import (
    across_seeds,
    best_seeds,
    finished_table,
    learning_curves,
    study_table,
)
from excite.training.checkpoint import Checkpoint

TINY = """
name = "tiny"
plant = "aero2"
episodes = 5
num_steps = 60
seeds = 2
[decision]
window = 10
output_scale = { pitch = 0.1 }
[training]
total_steps = 1920
num_envs = 8
n_steps = 60
batch_size = 120
n_epochs = 2
noise_sd = 0.5
noise_sd_end = 0.2
watch_every = 2
watch_episodes = 4
[agents."RL(all)"]
[agents."RL(K_pu)"]
targets = ["K_pu"]
decision = { reward = "log", goals = { K_pu = 0.004 } }
training = { learning_rate = 1e-3 }
[methods.chirp]
excitation = "chirp"
[estimators.arx-rls]
kind = "arx-rls"
[estimators.arx-rls-wide]
kind = "arx-rls-wide"
"""
EXCITE = [sys.executable, "-m", "excite"]
CLOCKS = ("train_seconds",)


def write_study(folder: Path, text: str = TINY) -> Path:
    path = folder / "tiny.toml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """The run folder of the whole tiny study."""
    folder = tmp_path_factory.mktemp("study")
    done = excite("study", "run", write_study(folder), "--out", folder / "run", "--workers", 1)
    assert done.returncode == 0, done.stderr
    assert "RL(K_pu)" in done.stdout
    assert "finished: RL(all) seed 1" in done.stderr
    return folder / "run"


def without_clocks(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: without_clocks(v) for k, v in value.items() if k not in CLOCKS}
    return [without_clocks(v) for v in value] if isinstance(value, list) else value


def table_of(folder: Path) -> Any:
    return without_clocks(json.loads((folder / "table.json").read_text()))


# The whole study


def test_a_study_leaves_tables_figures_policies_and_curves(run):
    for name in ("table.md", "table.csv", "table.tex", "table.json", "curves.png", "episodes.png"):
        assert (run / name).stat().st_size > 100, name
    for agent in ("RL(all)", "RL(K_pu)"):
        for seed in range(2):
            place = seed_folder(run, agent, seed)
            policy = read_policy(place / "policy.safetensors")
            assert policy.provenance["agent"] == agent
            assert policy.provenance["seed"] == seed
            assert policy.layout.size == 21
            curve = (place / "curve.csv").read_text().splitlines()
            assert curve[0].startswith("steps,return,")
            assert curve[-1].startswith("1920.0,")
            assert not list(place.glob("checkpoint*"))
            assert list(place.glob("tensorboard/**/events*"))


def test_a_report_needs_nothing_but_the_run_folder(run, tmp_path):
    episodes = json.loads((run / "episodes.json").read_text())
    assert list(episodes) == ["chirp", "RL(all)", "RL(K_pu)"]
    seeds = {name: own["seed"] for name, own in episodes.items() if "seed" in own}
    assert seeds == finished_table(run).best_seeds
    for own in episodes.values():
        assert len(own["inputs"]["voltage"]) == len(own["estimate_over_true"]["J_p"]) == 61
    about = json.loads((run / "run.json").read_text())
    assert about["command"].endswith(f"--out {run} --workers 1")
    assert finished_table(run).bound_curves == ()
    out = tmp_path / "report.html"
    done = excite("report", run, "--out", out)
    assert done.returncode == 0, done.stderr
    page = out.read_text()
    assert "<img" not in page
    for name, seed in seeds.items():
        assert f">{name}, seed {seed}<" in page
    assert about["command"] in page


def test_rows_are_methods_then_agents_with_what_a_benchmark_row_has(run):
    content = finished_table(run).data()
    assert [(r["method"], r["estimator"]) for r in content["rows"]] == [
        (m, e) for m in ("chirp", "RL(all)", "RL(K_pu)") for e in ("arx-rls", "arx-rls-wide")
    ]
    methods, agents = content["rows"][:2], content["rows"][2:]
    for row in agents:
        assert row.keys() - {"by_seed"} == methods[0].keys()
        assert len(row["by_seed"]["violations"]) == 2
        assert row["seeds"] == 2
        assert row["evaluations"] == 10
        assert row["train_seconds"] > 0
    assert methods[0]["seeds"] is None
    assert methods[0]["evaluations"] == 5


def test_policies_of_different_seeds_and_agents_differ(run):
    policies = {
        (a, s): read_policy(seed_folder(run, a, s) / "policy.safetensors").weights[0][0]
        for a in ("RL(all)", "RL(K_pu)") for s in range(2)
    }  # fmt: skip
    keys = list(policies)
    for i, a in enumerate(keys):
        for b in keys[:i]:
            assert not np.array_equal(policies[a], policies[b])


def test_differences_are_paired_over_seeds(run):
    content = finished_table(run).data()
    pair = next(
        d for d in content["differences"]
        if (d["method"], d["minus"], d["estimator"]) == ("RL(K_pu)", "RL(all)", "arx-rls-wide")
    )  # fmt: skip

    def means(agent: str, name: str) -> np.ndarray:
        rows = [
            json.loads((seed_folder(run, agent, s) / "metrics.json").read_text())["rows"][1]
            for s in range(2)
        ]
        return np.array([r["relative_error_percent"][name]["mean"] for r in rows], float)

    for name, shown in pair["relative_error_percent"].items():
        gaps = means("RL(K_pu)", name) - means("RL(all)", name)
        if not np.all(np.isfinite(gaps)):
            assert shown["mean"] is None
            continue
        low, high = scipy.stats.ttest_1samp(gaps, 0).confidence_interval()
        assert shown["mean"] == pytest.approx(gaps.mean())
        assert shown["ci95"] == pytest.approx([low, high])


def test_the_table_command_prints_what_was_written(run):
    shown = excite("study", "table", run, "--json")
    assert shown.returncode == 0, shown.stderr
    assert json.loads(shown.stdout)["rows"] == finished_table(run).data()["rows"]
    assert "viable" in excite("study", "table", run).stdout


def test_a_finished_study_is_not_computed_again(run):
    before = {p: p.stat().st_mtime_ns for p in run.rglob("policy.safetensors")}
    done = excite("study", "run", run.parent / "tiny.toml", "--out", run)
    assert done.returncode == 0, done.stderr
    assert "finished:" not in done.stderr
    assert {p: p.stat().st_mtime_ns for p in run.rglob("policy.safetensors")} == before


def test_the_best_seed_is_chosen_on_validation_episodes(run):
    study = read_study(run.parent / "tiny.toml")
    for agent, best in best_seeds(study, run).items():
        returns = [
            json.loads((seed_folder(run, agent, s) / "metrics.json").read_text())["validation"]
            for s in range(2)
        ]
        assert returns[best]["return"] == max(r["return"] for r in returns)


def test_a_gradient_seed_that_is_worth_more_but_unsafe_is_not_the_best(tmp_path, monkeypatch):
    looks = [
        {"steps": 9.0, "return": -1.0, "worth": 20.0, "violation_rate": 0.0},
        {"steps": 9.0, "return": 5.0, "worth": 22.0, "violation_rate": 0.3},
    ]
    study = study_from(
        {
            "name": "x", "plant": "aero2", "seeds": 2, "estimators": {"nls": {"kind": "nls"}},
            "agents": {"A": {"method": "gradient"}},
        },
        "x",
    )  # fmt: skip
    monkeypatch.setattr(table, "_metrics", lambda *key: SimpleNamespace(validation=looks[key[-1]]))
    assert best_seeds(study, tmp_path) == {"A": 0}


# Interruption


def steps_kept(seed: Path) -> int:
    """Steps in the checkpoint of a seed that is still trained."""
    path = seed / "checkpoint.safetensors"
    try:
        steps = Checkpoint.from_bytes(path.read_bytes(), str(path)).state["num_steps"]
    except OSError:
        return 0
    return 0 if (seed / "metrics.json").exists() else steps


def killed_in_the_middle(study: Path, folder: Path) -> None:
    """Starts a study and kills it, without warning, when a seed is half trained."""
    environment = {**os.environ, "EXCITE_CHECKPOINT_SECONDS": "0"}
    command = [*EXCITE, "study", "run", str(study), "--out", str(folder), "--workers", "1"]
    process = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        finished = list(folder.glob("seeds/*/*/metrics.json"))
        if finished and any(steps_kept(seed) >= 960 for seed in folder.glob("seeds/*/*")):
            break
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()


def test_a_study_killed_in_the_middle_goes_on_and_gives_the_same_table(run, tmp_path):
    study, folder = write_study(tmp_path), tmp_path / "run"
    killed_in_the_middle(study, folder)
    finished = {p: p.stat().st_mtime_ns for p in folder.glob("seeds/*/*/metrics.json")}
    assert finished
    assert len(finished) < 4
    with pytest.raises(ValueError, match=r"not finished, . of 4 trainings are missing"):
        study_table(folder)
    shown = excite("study", "table", folder)
    assert shown.returncode == 2
    assert "rerun 'excite study run' to resume" in shown.stderr
    done = excite("study", "run", study, "--out", folder, "--workers", 2)
    assert done.returncode == 0, done.stderr
    assert {p: p.stat().st_mtime_ns for p in finished} == finished
    assert table_of(folder) == table_of(run)
    metrics = [json.loads(p.read_text()) for p in folder.glob("seeds/*/*/metrics.json")]
    assert any((m["resumed_at_steps"] or 0) >= 960 for m in metrics)


def test_an_agent_that_comes_back_with_other_settings_is_refused(run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    start, end = TINY.index('[agents."RL(K_pu)"]'), TINY.index("[methods.chirp]")
    without = TINY[:start] + TINY[end:]
    assert excite("study", "run", write_study(tmp_path, without), "--out", folder).returncode == 0
    other = TINY.replace("learning_rate = 1e-3", "learning_rate = 2e-3")
    before = (folder / "study.json").read_bytes()
    done = excite("study", "run", write_study(tmp_path, other), "--out", folder)
    assert done.returncode == 2
    assert "other settings of 'RL(K_pu)'" in done.stderr
    assert (folder / "study.json").read_bytes() == before
    done = excite("study", "run", write_study(tmp_path), "--out", folder)
    assert done.returncode == 0
    assert table_of(folder) == table_of(run)


FILES = ["methods.json", "table.json", "run.json", "study.json"]
FILES += ["seeds/RL_all/1/metrics.json", "seeds/RL_all/1/curve.csv"]
ROWS = '{"rows": [{"relative_error_percent": 3}], "viable": true, "fingerprint": 1}'


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("content", ["{}", "[]", '{"agents": null}', "\x00", ROWS, "[" * 10**5])
def test_a_damaged_file_is_one_sentence(run, tmp_path, name, content):
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    (folder / name).write_text(content)
    study = read_study(run.parent / "tiny.toml")
    with pytest.raises(ValueError, match=r"damaged; .*'excite study run'|other settings") as error:
        read_all(study, folder)
    assert type(error.value) is ValueError
    assert str(folder / name) in str(error.value)
    (folder / name).unlink()
    with opened(study, folder):  # what the sentence says is a way out
        assert (folder / "study.json").is_file()
        assert (folder / "run.json").is_file()


def test_a_curve_that_ends_early_is_damaged(run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    path = seed_folder(folder, "RL(all)", 1) / "curve.csv"
    path.write_text("".join(path.read_text().splitlines(True)[:-1]))
    with pytest.raises(ValueError, match=rf"{path} is damaged"):
        read_all(read_study(run.parent / "tiny.toml"), folder)


def read_all(study: Any, folder: Path) -> None:
    """Whatever is read of a run folder."""
    with opened(study, folder):
        study_table(folder)
        finished_table(folder)
        learning_curves(study, folder)


def test_a_file_in_the_way_of_a_folder_is_said_and_nothing_is_written(run, tmp_path):
    (tmp_path / "run.json").write_bytes((run / "run.json").read_bytes())
    (tmp_path / "seeds").write_text("mine")
    study = read_study(run.parent / "tiny.toml")
    with pytest.raises(ValueError, match=r"/seeds is a file where a folder is needed"):
        run_tasks(study, tmp_path, local_engine(1))
    assert not (tmp_path / "study.json").exists()


@pytest.mark.parametrize("text", ["abc", "-1", "nan", ""])
def test_a_time_between_checkpoints_that_is_none_is_said(run, tmp_path, monkeypatch, text):
    monkeypatch.setenv("EXCITE_CHECKPOINT_SECONDS", text)
    study = read_study(run.parent / "tiny.toml")
    with pytest.raises(ValueError, match=f"EXCITE_CHECKPOINT_SECONDS must be .* got '{text}'"):
        run_tasks(study, tmp_path / "run", local_engine(1))
    assert not (tmp_path / "run").exists()


def test_only_what_is_left_to_train_needs_the_trainer(run, tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    study = read_study(run.parent / "tiny.toml")
    _require_trainer(study, run)
    with pytest.raises(ValueError, match="training needs stable_baselines3, torch"):
        _require_trainer(study, tmp_path)


def test_rows_of_another_policy_are_not_taken_over(run, tmp_path):
    policies = [seed_folder(run, "RL(all)", seed) / "policy.safetensors" for seed in range(2)]
    shutil.copy(policies[0], tmp_path / "mine.safetensors")
    text = TINY[: TINY.index("[decision]")] + TINY[TINY.index("[methods.chirp]") :]
    text += '[methods.mine]\nexcitation = "mine.safetensors"\n'
    study = read_study(write_study(tmp_path, text.replace("seeds = 2", "")))
    with opened(study, tmp_path / "run") as tasks:
        assert list(tasks) == ["methods"]
        (tmp_path / "run" / "methods.json").write_text("{}")
    shutil.copy(policies[1], tmp_path / "mine.safetensors")
    with (
        pytest.raises(ValueError, match="holds a study of another policy"),
        opened(study, tmp_path / "run"),
    ):
        pass


def test_progress_may_be_anything(run, tmp_path):
    study, folder = read_study(run.parent / "tiny.toml"), tmp_path / "run"
    place = seed_folder(folder, "RL(all)", 0)
    place.mkdir(parents=True)
    for content in ("", "{}", "[]", "null", '{"return": 1}', "\udcff"):
        (place / "progress.json").write_bytes(content.encode("utf-8", "surrogateescape"))
        assert _live(study, ("seed", "RL(all)", 0), folder) == (0.0, "")


def test_a_cluster_that_loses_a_worker_gives_the_same_table(run, tmp_path):
    pytest.importorskip("distributed")
    (tmp_path / "cluster").mkdir()
    cluster, folder = Cluster(tmp_path / "cluster"), tmp_path / "run"
    try:
        command = [
            *EXCITE, "study", "run", str(write_study(tmp_path)), "--out", str(folder),
            "--engine", "dask", "--address", cluster.address,
        ]  # fmt: skip
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        assert wait_for(lambda: list(folder.glob("seeds/*/*/progress.json")), PATIENCE)
        cluster.kill(1)
        _, errors = process.communicate(timeout=PATIENCE)
    finally:
        cluster.close()
    assert process.returncode == 0, errors
    assert table_of(folder) == table_of(run)
    policies = sorted(p.relative_to(run) for p in run.rglob("policy.safetensors"))
    assert len(policies) == 4
    for path in policies:
        assert (folder / path).read_bytes() == (run / path).read_bytes()


def test_a_broken_checkpoint_is_a_sentence_and_loses_nothing(run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    place = seed_folder(folder, "RL(all)", 1)
    (place / "metrics.json").unlink()
    (place / "checkpoint.safetensors").write_bytes(b"not a checkpoint")
    done = excite("study", "run", run.parent / "tiny.toml", "--out", folder)
    assert done.returncode == 2
    assert "1 task failed (RL(all) seed 1: /" in done.stderr
    assert "ValueError" not in done.stderr
    assert "checkpoint.safetensors" in done.stderr
    assert "Traceback" not in done.stderr
    assert len(list(folder.glob("seeds/*/*/metrics.json"))) == 3


def test_a_full_disk_is_a_sentence_and_loses_nothing(run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    shutil.rmtree(seed_folder(folder, "RL(all)", 0))

    # No file can grow beyond 60 kB; everything but a checkpoint is smaller.
    nearly_full = ["sh", "-c", 'ulimit -f 117; exec "$@"', "sh"]
    done = subprocess.run(
        [*nearly_full, *EXCITE, "study", "run", run.parent / "tiny.toml", "--out", folder],
        env={**os.environ, "EXCITE_CHECKPOINT_SECONDS": "0"},
        capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "checkpoint.safetensors: cannot be written (File too large)" in done.stderr
    assert "Traceback" not in done.stderr
    assert len(list(folder.glob("seeds/*/*/metrics.json"))) == 3


# Refusals


TRAIN = (
    *("train", "aero2", "--steps", 40, "--window", 5, "--episodes", 4),
    *("--output-scale", "pitch=0.3"),
    *("--set", "num_updates=4,num_plants=2,watch_every=2,watch_episodes=2"),
)


@pytest.mark.parametrize(
    ("name", "choice"),
    [
        ("gradient(D)", ()),
        ("gradient(log)",
         ("--objective", "log", "--goal", "J_p=0.01", "--target", "J_p", "--clock", 0.5)),
        ("gradient(D, log)",
         ("--objective", "D", "--objective", "log=2", "--goal", "J_p=0.01", "--target", "J_p",
          "--clock", 0.5)),
    ],
)  # fmt: skip
def test_one_command_trains_a_policy_by_gradient(name, choice, tmp_path):
    done = excite(*TRAIN, *choice, "--out", tmp_path / "mine", "--json")
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)["rows"]
    assert [(r["method"], r["estimator"]) for r in rows] == [
        (m, e) for m in ("chirp", name) for e in ("nls", "arx-rls")
    ]
    policy = read_policy(seed_folder(tmp_path / "mine", name, 0) / "policy.safetensors")
    assert policy.layout.clocks == ((0.05,) if choice else ())
    assert policy.provenance["method"] == "gradient"
    assert policy.provenance["training"]["num_updates"] == 4
    assert policy.provenance["targets"] == (["J_p"] if choice else ["J_p", "K_pu", "D_p"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ("--objective", "X"),
            "'X' (there is D, A, E, sPCE, ACE, InfoNCE, goals, relative, log, nls)",
        ),
        (("--objective", "D", "--objective", "log=x"), "the weight of 'log' must be a number"),
        (("--objective", "D", "--objective", "log=-1"), "weight must be greater than 0"),
        (("--objective", "D", "--objective", "D=2"), "objectives must differ from each other"),
        (("--target", "J_q"), "no parameter 'J_q'"),
        (("--goal", "J_p=-1", "--objective", "log"), "goals.J_p"),
        (("--goal", "J_p=1"), "the reward 'information' has no 'goals'"),
        (("--clock", 6), "at most 5 Hz"),
        (("--set", "num_update=3"), "num_updates"),
        (("--set", "margin=1"), "margin must lie in [0, 1)"),
        (("--output-scale", "yaw=1"), "yaw"),
        (("--method", "ppo", "--set", "batch_size=7"), "batch_size 7 does not divide"),
    ],
)
def test_an_option_of_training_that_is_not_allowed_is_a_sentence(arguments, words, tmp_path):
    done = excite("train", "aero2", *arguments, "--out", tmp_path / "mine")
    assert done.returncode == 2
    assert words in done.stderr
    assert done.stderr.count("\n") <= 4  # click adds its usage
    assert not (tmp_path / "mine").exists()


def test_another_study_in_the_folder_is_refused(run, tmp_path):
    other = write_study(tmp_path, TINY.replace("total_steps = 1920", "total_steps = 2400"))
    done = excite("study", "run", other, "--out", run)
    assert done.returncode == 2
    assert "holds another study" in done.stderr
    assert "other settings of 'RL(all)' (total_steps)" in done.stderr
    other = write_study(tmp_path, TINY.replace("episodes = 5", "episodes = 6"))
    done = excite("study", "run", other, "--out", run)
    assert "holds another study: its 'episodes' differs" in done.stderr
    benchmark = tmp_path / "benchmark"
    benchmark.mkdir()
    (benchmark / "notes.txt").write_text("mine")
    done = excite("study", "run", run.parent / "tiny.toml", "--out", benchmark)
    assert done.returncode == 2
    assert "no run folder" in done.stderr
    assert (benchmark / "notes.txt").read_text() == "mine"


def test_words_of_a_study_may_change(run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    other = write_study(tmp_path, TINY.replace('"tiny"\nplant', '"tiny"\ntitle = "T"\nplant'))
    done = excite("study", "run", other, "--out", folder)
    assert done.returncode == 0, done.stderr
    assert study_of(folder).title == "T"


def test_a_folder_in_use_is_refused(run):
    study = read_study(run.parent / "tiny.toml")
    with opened(study, run), pytest.raises(ValueError, match="another process"):
        run_tasks(study, run, local_engine(1))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--engine", "dask"], ["'dask'", "address"]),
        (["--address", "tcp://127.0.0.1:1"], ["engine 'dask'"]),
        (["--engine", "dask", "--address", "nowhere"], ["'nowhere'", "tcp://"]),
        (["--engine", "dask", "--address", "tcp://127.0.0.1:9"], ["no Dask scheduler"]),
        (["--workers", "0"], ["--workers"]),
        (["--workers", "abc"], ["'abc' is not a valid whole number"]),
    ],
)
def test_an_engine_that_cannot_be_is_one_sentence(arguments, words, tmp_path):
    done = excite("study", "run", write_study(tmp_path), "--out", tmp_path / "run", *arguments)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert [w for w in words if w not in done.stderr] == []


def test_a_benchmark_of_agents_points_to_the_command_that_trains(tmp_path):
    done = excite("benchmark", write_study(tmp_path))
    assert done.returncode == 2
    assert "excite study run" in done.stderr


def test_no_study_is_one_sentence(tmp_path):
    done = excite("study", "table", tmp_path)
    assert done.returncode == 2
    assert "holds no study" in done.stderr
    done = excite("study", "table", tmp_path / "nowhere")
    assert done.returncode == 2
    assert "nowhere: no such folder" in done.stderr


def test_violations_of_trained_policies_are_counted_on_plants_of_each_seed(run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    study = study_from({**study_of(run).model_dump(), "safety_episodes": 6}, "settings")
    write_json(folder / "study.json", study.model_dump())
    with pytest.raises(ValueError, match="not finished, its violations by seed"):
        study_table(folder)
    done = []
    table = run_study(study, folder, workers=1, on_done=done.append)
    names = [f"{agent} seed {seed}" for seed in range(2) for agent in ("RL(all)", "RL(K_pu)")]
    assert sorted(done) == sorted(f"{name}, violations" for name in names)  # nothing is trained
    plants = []
    for seed in range(2):
        policy = read_policy(seed_folder(folder, "RL(all)", seed) / "policy.safetensors")
        keys = jax.random.split(jax.random.fold_in(jax.random.key(study.seed), seed + 1), 6)
        episodes = run_episodes(study.build_plant(), PolicyExcitation.of(policy), 60, 0.3, keys)
        plants.append(np.asarray(episodes.params.J_p))
        (row,) = (r for r in table.rows if (r.method, r.estimator) == ("RL(all)", "arx-rls"))
        assert row.by_seed is not None
        assert row.by_seed.violations[seed] == int(episodes.is_violation.sum())
        assert (row.by_seed.evaluations, row.by_seed.own_plants) == (6, True)
    assert not np.isin(*plants).any()
    assert "each seed on 6 plants of its own" in table.markdown()


# Rows across seeds


def metrics(viable: bool, error: float, violations: int) -> SeedMetrics:
    row = {
        "method": "a", "estimator": "e", "evaluations": 10, "failed": 1, "failures": {"x": 1},
        "violations": violations, "violation_rate": {"estimate": 0.1, "ci95": (0.0, 0.2)},
        "log_det_information": 40.0, "log_det_information_sd": 1.0, "beyond_6_std_errors": 2,
        "max_abs_output": {"output": "y", "mean": 2 * error, "sd": 1.0, "unit": "m"},
        "relative_error_percent": {
            "p": {"mean": error, "sd": 1.0, "median": error, "rms": 2 * error}
        },
        "cramer_rao_percent": {"p": 0.5}, "rms_over_cramer_rao": {"p": 3.0},
        "coverage95_percent": {"p": 90.0},
    }  # fmt: skip
    return SeedMetrics.model_validate(
        {"viable": viable, "rows": [row], "train_seconds": 60.0, "validation": {"return": 1.0}}
    )


def test_means_are_over_viable_seeds_and_counts_over_all():
    row = across_seeds(
        [metrics(True, 1.0, 0), metrics(False, 50.0, 4), metrics(True, 3.0, 1)], 0
    ).data()
    error = row["relative_error_percent"]["p"]
    assert (error["mean"], error["sd"]) == (2.0, pytest.approx(2**0.5))
    assert error["all_seeds"]["mean"] == 18.0
    assert error["rms"] == pytest.approx((((2.0) ** 2 + 6.0**2) / 2) ** 0.5)
    assert row["max_abs_output"]["mean"] == 4.0
    assert (row["viable_seeds"], row["seeds"]) == (2, 3)
    assert (row["violations"], row["evaluations"]) == (5, 30)
    assert row["by_seed"] == {"evaluations": 10, "violations": [0, 4, 1], "own_plants": False}
    assert (row["failed"], row["failures"]) == (3, {"x": 3})
    assert row["train_seconds"] == 180.0


def test_a_seed_without_estimates_does_not_hide_the_others():
    row = across_seeds([metrics(True, 1.0, 0), metrics(True, math.nan, 0)], 0).data()
    assert row["relative_error_percent"]["p"]["mean"] == 1.0
    assert row["viable_seeds"] == 2


def test_no_viable_seed_leaves_counts_and_no_means():
    row = across_seeds([metrics(False, 1.0, 2)], 0).data()
    assert row["relative_error_percent"]["p"]["mean"] is None
    assert row["violations"] == 2
    assert row["viable_seeds"] == 0
