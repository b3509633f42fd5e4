import contextlib
import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from documented import documented

from excite.environment.episodes import Episodes, run_episodes
from excite.estimation import Status
from excite.excitation import PRBS, Chirp, Random
from excite.files import json_ready, locked_folder
from excite.information import best_possible
from excite.plant import EMPS, Aero2, draw_params
from excite.report.study_table import footnotes
from excite.study import methods as benchmark
from excite.study.progress import write_phase, write_progress
from excite.study.run import _live, opened, run_study
from excite.study.spec import Study, study_from
from excite.study.statistics import wilson
from excite.study.table import finished_table

ROOT = Path(__file__).parent.parent
PARAMETERS = ("J_p", "K_pu", "D_p")
PLANT = Aero2()


def tiny(**settings: Any) -> Study:
    """Two methods, a handful of short episodes, the paper's estimator with a wide start."""
    study: dict[str, Any] = {
        "name": "tiny",
        "plant": "aero2",
        "episodes": 8,
        "num_steps": 60,
        "seed": 5,
        "methods": {"random": {"excitation": "random"}, "prbs": {"excitation": "prbs", "clock": 5}},
        "estimators": {"arx-rls-wide": {"kind": "arx-rls", "start_covariance": 1e8}},
    }
    return Study.model_validate({**study, **settings})


def run_benchmark(study: Study, *progress: Any) -> list[dict[str, Any]]:
    """The study's rows as the command line prints them."""
    return [row.data() for row in benchmark.method_rows(study, *progress)]


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    return run_benchmark(tiny())


# On a simulated rig


@pytest.fixture(scope="module")
def on_rig() -> list[dict[str, Any]]:
    methods = {
        "gentle": {"excitation": "chirp", "amplitude": 5.0},
        "strong": {"excitation": "chirp", "amplitude": 14.0},
    }
    return run_benchmark(
        tiny(
            plant="aero2_detailed", num_steps=200, methods=methods,
            estimators={"nls": {"kind": "nls"}}, rig={"filter": True},
        )
    )  # fmt: skip


@pytest.mark.science
def test_what_a_supervisor_ended_has_no_estimate_and_a_filter_prevents_it(on_rig):
    gentle, strong = on_rig
    quiet = {"trips": 0, "filtered_violations": 0, "filtered_trips": 0, "interventions": 0}
    assert gentle["on_rig"] == quiet
    assert gentle["failed"] == 0
    assert strong["on_rig"]["trips"] > 0
    assert strong["failures"]["tripped"] == strong["on_rig"]["trips"]
    assert strong["failed"] >= strong["on_rig"]["trips"]
    assert strong["on_rig"]["filtered_violations"] == 0
    assert strong["on_rig"]["interventions"] > 0


@pytest.mark.science
def test_latency_that_a_record_knows_costs_no_accuracy(on_rig):
    for name in PARAMETERS:  # 10 ms that are not known cost half of D_p
        assert on_rig[0]["rms_over_cramer_rao"][name] < 3


def test_only_the_plant_itself_shows_no_rig(rows):
    assert all("on_rig" not in row for row in rows)


# Rows


def test_rows_are_methods_in_order_each_with_all_estimators(rows):
    assert [(r["method"], r["estimator"]) for r in rows] == [
        ("random", "arx-rls-wide"), ("prbs", "arx-rls-wide"),
    ]  # fmt: skip


def test_a_row_has_the_keys_that_are_documented(rows):
    for row in rows:
        asked_for = {"bound_by_length", "on_rig", "expected_gain"}
        assert set(row) | asked_for == documented("evaluate")
        assert set(row) >= {
            "method", "estimator", "evaluations", "failed", "violations", "max_abs_output",
            "relative_error_percent", "cramer_rao_percent",
        }  # fmt: skip
        assert set(row["max_abs_output"]) == {"output", "mean", "sd", "unit"}
        assert row["max_abs_output"]["unit"] == "deg"
        for key in (
            "relative_error_percent", "cramer_rao_percent", "rms_over_cramer_rao",
            "coverage95_percent",
        ):  # fmt: skip
            assert tuple(row[key]) == PARAMETERS
        for error in row["relative_error_percent"].values():
            assert set(error) == {"mean", "sd", "median", "rms"}


def test_a_row_is_plain_json(rows):
    assert json.loads(json.dumps(json_ready(rows), allow_nan=False)) == json_ready(rows)


def test_counts_add_up(rows):
    for row in rows:
        assert row["evaluations"] == 8
        assert row["failed"] == sum(row["failures"].values())
        assert row["violation_rate"]["estimate"] == row["violations"] / 8


@pytest.mark.slow
def test_a_run_in_chunks_is_the_run_in_one(rows, monkeypatch):
    monkeypatch.setattr(benchmark, "CHUNK", 4)
    reports = []
    study = tiny(methods={"random": {"excitation": "random"}})
    chunked = run_benchmark(study, lambda *report: reports.append(report))
    assert reports == [("random", 0, 2), ("random", 1, 2), ("done", 2, 2)]

    def assert_equal(a: Any, b: Any) -> None:
        if isinstance(a, dict):
            assert a.keys() == b.keys()
            for key in a:
                assert_equal(a[key], b[key])
        elif isinstance(a, float):
            assert a == pytest.approx(float(b), rel=1e-6, nan_ok=True)
        else:
            assert a == b

    (row,) = chunked
    assert_equal(json_ready(rows[0]), json_ready(row))


def test_a_study_runs_twice_to_the_same_rows_and_its_seed_changes_them(rows):
    assert json_ready(run_benchmark(tiny())) == json_ready(rows)
    other = run_benchmark(tiny(seed=6))
    assert other[0]["max_abs_output"]["mean"] != rows[0]["max_abs_output"]["mean"]


def test_a_sensor_without_noise_is_refused_because_nothing_bounds_it():
    with pytest.raises(ValueError, match="without noise has no Cramér-Rao bound"):
        run_benchmark(tiny(sensor={"pitch": {"noise_sd": 0.0}}))


# Identical conditions


@pytest.fixture(scope="module")
def episodes() -> dict[str, Episodes]:
    """The same keys under three excitations."""
    keys = jax.random.split(jax.random.key(5), 8)
    methods = {"random": Random(), "prbs": PRBS(clock=5), "chirp": Chirp()}
    return {name: run_episodes(PLANT, m, 60, 0.3, keys) for name, m in methods.items()}


@pytest.mark.parametrize("other", ["prbs", "chirp"])
def test_every_method_sees_the_same_plants_and_noise(other, episodes):
    a, b = episodes["random"], episodes[other]
    np.testing.assert_array_equal(a.params, b.params)
    noise = [np.asarray(e.trajectory.measured - e.trajectory.outputs) for e in (a, b)]
    np.testing.assert_allclose(noise[0], noise[1], atol=1e-12)
    assert np.std(noise[0]) == pytest.approx(2e-4, rel=0.1)
    assert np.max(np.abs(a.trajectory.inputs - b.trajectory.inputs)) > 1


def test_every_episode_has_a_plant_and_noise_of_its_own(episodes):
    e = episodes["random"]
    noise = np.asarray(e.trajectory.measured - e.trajectory.outputs)[..., 0]
    assert np.max(np.abs(np.corrcoef(noise) - np.eye(8))) < 0.5
    assert all(len(set(np.asarray(p).tolist())) == 8 for p in e.params)
    inputs = np.asarray(e.trajectory.inputs)[..., 0]
    assert np.max(np.abs(np.corrcoef(inputs) - np.eye(8))) < 0.5


def test_the_bound_of_an_episode_is_that_of_its_own_input_and_plant(episodes):
    e = episodes["prbs"]
    params = PLANT.Params(*(p[3] for p in e.params))
    inputs = e.trajectory.inputs[3]
    bound = best_possible(PLANT, params, inputs, initial_state_known=True)
    expected = [(p.cramer_rao_percent or np.nan) / 100 for p in bound.params.values()]
    np.testing.assert_allclose(e.bound[3], expected, rtol=1e-8)


def test_violations_are_judged_by_true_outputs(episodes):
    level = math.radians(40)
    for e in episodes.values():
        largest = np.abs(np.asarray(e.trajectory.outputs)).max(axis=1)
        np.testing.assert_array_equal(e.max_abs_output, largest)
        np.testing.assert_array_equal(e.is_violation, largest[:, 0] >= level)


@pytest.mark.parametrize("plant", [Aero2(), EMPS()], ids=lambda p: p.definition.name)
@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_parameters_are_uniform_within_the_spread(plant, spread):
    draw = jax.vmap(lambda key: jnp.stack(draw_params(plant, key, spread)))
    drawn = np.asarray(draw(jax.random.split(jax.random.key(0), 2000)))
    nominal = np.array([p.nominal for p in plant.definition.parameters])
    unit = (drawn - nominal) / np.abs(nominal)
    if spread == 0:
        np.testing.assert_allclose(unit, 0, atol=1e-15)
        return
    for column in unit.T:
        assert scipy.stats.kstest(column, "uniform", (-spread, 2 * spread)).pvalue > 0.01
    assert np.max(np.abs(np.corrcoef(unit.T) - np.eye(len(nominal)))) < 0.08


# Statistics


@pytest.mark.parametrize(
    ("successes", "count"), [(0, 100), (2, 100), (20, 1000), (500, 1000), (7, 7), (0, 1), (1, 3)]
)
def test_the_interval_of_a_rate_is_wilsons(successes, count):
    expected = scipy.stats.binomtest(successes, count).proportion_ci(method="wilson")
    low, high = wilson(successes, count)
    assert low == pytest.approx(expected.low, abs=1e-6)
    assert high == pytest.approx(expected.high, abs=1e-6)
    assert 0 <= low <= successes / count <= high <= 1


def scores(status: list[Status], estimated: list[list[float]]) -> Any:
    """Episodes of a plant whose parameters are 2, 4 and 5, with standard errors of 10 %."""
    true = np.tile([2.0, 4.0, 5.0], (len(status), 1))
    return benchmark.Scores(
        true=true,
        estimated=np.array(estimated),
        std_error=0.1 * true,
        status=np.array([int(s) for s in status]),
        is_violation=np.arange(len(status)) == 0,
        max_abs_output=np.full((len(status), 1), math.radians(10)),
        bound=np.full((len(status), 3), 0.05),
        log_det=np.full(len(status), 50.0),
        on_rig={},
    )


STUDY = study_from(
    {"name": "s", "plant": "aero2", "methods": {"m": {"excitation": "chirp"}},
     "estimators": {"e": {"kind": "nls"}}},
    "study",
)  # fmt: skip
GOOD, BAD = [2.2, 3.6, 5.0], [math.nan, math.inf, -1e9]


def test_means_are_over_the_estimates_that_did_not_fail():
    status = [Status.SUCCESSFUL, Status.UNPHYSICAL, Status.SUCCESSFUL, Status.NOT_FINITE]
    mixed = scores(status, [GOOD, BAD, [1.4, 4.0, 5.5], BAD])
    row = benchmark.table_row(STUDY, PLANT.description, ("m", "e"), mixed).data()
    assert (row["evaluations"], row["failed"]) == (4, 2)
    assert row["failures"] == {"not_finite": 1, "unphysical": 1}
    errors = {"J_p": [10, 30], "K_pu": [10, 0], "D_p": [0, 10]}
    for name, (a, b) in errors.items():
        error = row["relative_error_percent"][name]
        assert error["mean"] == pytest.approx((a + b) / 2)
        assert error["sd"] == pytest.approx(abs(a - b) / math.sqrt(2))
        assert error["median"] == pytest.approx((a + b) / 2)
        assert error["rms"] == pytest.approx(math.hypot(a, b) / math.sqrt(2))
        assert row["rms_over_cramer_rao"][name] == pytest.approx(error["rms"] / 5)
    assert row["coverage95_percent"] == {"J_p": 50, "K_pu": 100, "D_p": 100}
    assert row["beyond_6_std_errors"] == 0


def test_violations_and_outputs_are_those_of_all_episodes():
    status = [Status.UNPHYSICAL, Status.SUCCESSFUL]
    row = benchmark.table_row(
        STUDY, PLANT.description, ("m", "e"), scores(status, [BAD, GOOD])
    ).data()
    assert row["violations"] == 1
    assert row["violation_rate"] == {"estimate": 0.5, "ci95": list(wilson(1, 2))}
    assert row["max_abs_output"]["mean"] == pytest.approx(10)
    assert row["max_abs_output"]["sd"] == pytest.approx(0, abs=1e-12)


def test_an_estimate_far_outside_its_own_interval_is_counted():
    status = [Status.SUCCESSFUL] * 3
    wrong = scores(status, [GOOD, [2.0, 4.0, 8.1], [4.0, 0.1, 5.0]])
    row = benchmark.table_row(STUDY, PLANT.description, ("m", "e"), wrong).data()
    assert row["beyond_6_std_errors"] == 2


def test_where_every_estimate_failed_there_is_no_mean():
    row = benchmark.table_row(
        STUDY, PLANT.description, ("m", "e"), scores([Status.UNPHYSICAL] * 2, [BAD, BAD])
    ).data()
    assert (row["evaluations"], row["failed"]) == (2, 2)
    plain = json_ready(row)
    for name in PARAMETERS:
        assert set(plain["relative_error_percent"][name].values()) == {None}
        assert plain["rms_over_cramer_rao"][name] is None
        assert plain["coverage95_percent"][name] is None
        assert plain["cramer_rao_percent"][name] == pytest.approx(5)
    assert row["violations"] == 1


# The run folder


def test_a_study_without_agents_needs_no_folder_and_leaves_one_where_asked(tmp_path):
    study, folder = tiny(), tmp_path / "run"
    table = run_study(study)
    assert run_study(study, folder) == table
    assert {f.name for f in folder.iterdir()} - {".lock"} == {
        "methods.json", "table.json", "table.md", "table.csv", "table.tex", "errors.png",
        "episodes.json", "study.json", "run.json",
    }  # fmt: skip
    content = json.loads((folder / "table.json").read_text())
    assert content == {"rows": [row.data() for row in table.rows]}
    assert (folder / "table.md").read_text() == table.markdown()
    assert Study.model_validate(json.loads((folder / "study.json").read_text())) == study


def test_a_run_folder_is_resumed_by_its_study_and_replaced_where_asked(tmp_path):
    folder = tmp_path / "run"
    run_study(tiny(), folder)
    made = (folder / "methods.json").stat().st_mtime_ns
    run_study(tiny(), folder)
    assert (folder / "methods.json").stat().st_mtime_ns == made
    with pytest.raises(ValueError, match="another study: its 'seed' differs"):
        run_study(tiny(), folder, seed=6)
    table = run_study(tiny(), folder, seed=6, overwrite=True)
    assert finished_table(folder) == table
    assert table.study.seed == 6


def trained(folder: Path) -> tuple[Study, Path]:
    """A study with an agent, and a file of its run."""
    folder.mkdir()
    (folder / "run.json").write_text('{"kind": "excite study"}')
    (folder / "study.json").write_text("{}")
    kept = folder / "seeds" / "A" / "0" / "metrics.json"
    kept.parent.mkdir(parents=True)
    kept.write_text("{}")
    return tiny(agents={"A": {"method": "ppo"}}, seeds=1), kept


def test_nothing_is_removed_where_a_study_cannot_be_trained(tmp_path, monkeypatch):
    study, kept = trained(tmp_path / "run")
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(ValueError, match="training needs stable_baselines3"):
        run_study(study, tmp_path / "run", overwrite=True)
    assert kept.exists()


def test_nothing_is_removed_where_another_process_works_on_the_study(tmp_path):
    study, kept = trained(tmp_path / "run")
    with (
        locked_folder(tmp_path / "run", "this study"),
        pytest.raises(ValueError, match="another process"),
    ):
        run_study(study, tmp_path / "run", overwrite=True, workers=1)
    assert kept.exists()


def test_nothing_is_removed_where_no_scheduler_answers(tmp_path):
    study, kept = trained(tmp_path / "run")
    with pytest.raises(ValueError, match="no Dask scheduler"):
        run_study(
            study, tmp_path / "run", overwrite=True, engine="dask", address="tcp://127.0.0.1:9"
        )
    assert kept.exists()


def test_an_overwritten_run_begins_anew(tmp_path):
    study, kept = trained(tmp_path / "run")
    with opened(study, tmp_path / "run", overwrite=True) as tasks:
        assert not kept.exists()
        assert len(tasks) == 2


@pytest.mark.slow
def test_what_was_evaluated_is_told_with_and_without_a_run_folder(tmp_path):
    for out in (None, tmp_path / "run"):
        told: list[str] = []
        run_study(tiny(episodes=2), out, on_done=told.append)
        assert told == ["methods"]
    run_study(tiny(episodes=2), tmp_path / "run", on_done=told.append)
    assert told == ["methods"]  # nothing was missing


def test_workers_and_clusters_that_would_be_unused_are_refused(tmp_path):
    with pytest.raises(ValueError, match="'tiny' has nothing to train or design"):
        run_study(tiny(), tmp_path / "run", workers=2)
    with pytest.raises(ValueError, match="the engine 'dask' needs a run folder"):
        run_study(tiny(), engine="dask", address="tcp://127.0.0.1:9")
    assert not (tmp_path / "run").exists()


def test_a_study_with_signals_to_design_needs_a_run_folder():
    with pytest.raises(ValueError, match="'tiny' has signals to design: it needs a run folder"):
        run_study(tiny(clairvoyant={"plants": 2}))


@pytest.mark.slow
def test_a_table_shows_itself_and_is_filtered_and_sorted(rows):
    table = run_study(tiny(), estimators=["arx-rls-wide", "nls"])
    assert repr(table).startswith("tiny\nmethod")
    assert max(map(len, repr(table).splitlines())) <= 80
    assert "<td>prbs</td>" in table._repr_html_()
    assert [row.data() for row in table.only("arx-rls-wide").rows] == rows
    order = table.only("nls").sorted_by("D_p").rows
    assert (
        order[0].relative_error_percent["D_p"].mean <= order[1].relative_error_percent["D_p"].mean
    )
    with pytest.raises(ValueError, match=r"unknown estimator 'nsl'.*'nls'"):
        table.only("nsl")
    with pytest.raises(ValueError, match=r"unknown column 'D_q'.*'D_p'"):
        table.sorted_by("D_q")


# In a declared uncertainty


@pytest.mark.science
def test_bounds_of_shorter_experiments_are_of_plants_of_the_declared_uncertainty():
    box = {"parameters": "50%", "initial_pitch": [-0.1, 0.1]}
    study = tiny(uncertainty=box, num_steps=20, lengths=[20])
    for row in benchmark.method_rows(study):
        assert row.bound_by_length is not None
        for name, (bound,) in row.bound_by_length.cramer_rao_percent.items():
            np.testing.assert_allclose(bound, row.cramer_rao_percent[name], rtol=1e-6)


def test_a_table_says_what_its_plants_differ_in():
    box = {"d_S": "10%", "initial_pitch": [-0.1, 0.1]}
    study = tiny(uncertainty=box, clairvoyant={"plants": 2, "starts": 1})
    notes = " ".join(footnotes(benchmark.facts(study), ()))
    assert "in addition d_S ± 10 %, initial_pitch -0.1 to 0.1" in notes
    assert "clairvoyant signals are for plants of the spread alone" in notes
    assert "in addition" not in " ".join(footnotes(benchmark.facts(tiny()), ()))


def test_a_start_that_fails_leaves_no_folder(tmp_path):
    """But what was there before, and what was finished, stays."""
    folder, markers = tmp_path / "new" / "run", ["run.json"]

    def fail(*files: str) -> bool:
        with contextlib.suppress(KeyError), locked_folder(folder, "this study", markers):
            for file in files:
                (folder / file).write_text("{}")
            raise KeyError
        return folder.exists()

    assert not fail()
    assert not fail("run.json")
    assert fail("run.json", "methods.json")
    (folder / "methods.json").unlink()
    assert fail("run.json")


def test_a_study_whose_tasks_all_fail_leaves_no_folder(tmp_path, monkeypatch):
    study = tiny(agents={"a": {"method": "gradient"}})
    error = ValueError("no memory")

    def failing(stages, *_: object, **__: object) -> dict[str, ValueError]:
        return {name: error for _, tasks in stages for name in tasks}

    monkeypatch.setattr("excite.study.run.run", failing)
    with pytest.raises(ValueError, match=r"no memory\); nothing is finished$"):
        run_study(study, tmp_path / "run", workers=1)
    assert not (tmp_path / "run").exists()


def test_the_phase_of_a_training_is_told(tmp_path):
    study, place = tiny(agents={"a": {"method": "gradient"}}), tmp_path / "seeds" / "a" / "0"
    place.mkdir(parents=True)

    def live() -> tuple[float, str]:
        return _live(study, ("seed", "a", 0), tmp_path)

    assert live() == (0.0, "")
    write_phase(place, "compiling")
    assert live() == (0.0, "a seed 0: compiling")
    write_progress(place, {"steps": 250 * 64 * study.num_steps, "return": 3.0})
    write_phase(place, "")
    assert live() == (0.25, "a seed 0: updating 250 of 1,000; return 3")
    write_phase(place, "evaluating")
    assert live() == (0.25, "a seed 0: evaluating")
