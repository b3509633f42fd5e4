"""Work arrives whole, whatever happens to workers, and leaves nobody behind."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import tasks as functions
from cluster import Cluster, wait_for
from commands import PATIENCE

from excite import __version__
from excite.study import cluster as dask
from excite.study import engine
from excite.study.worker import Failure, answers

TESTS = Path(__file__).parent


@pytest.fixture(autouse=True)
def _tasks_are_importable(monkeypatch):
    told = os.environ.get("PYTHONPATH", "")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(TESTS), told])))


@pytest.fixture(autouse=True)
def _nobody_is_left():
    yield
    assert not workers_of(os.getpid())


def workers_of(parent: int) -> list[int]:
    """Worker processes that a process has started and not buried."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            of = int((place / "stat").read_text().rpartition(")")[2].split()[1])
            if of == parent and b"excite.study.worker" in (place / "cmdline").read_bytes():
                found.append(int(place.name))
    return found


def work(
    function: Callable[..., Any], tasks: dict[str, Any], where: engine.Engine, **options: Any
) -> tuple[dict[str, Any], dict[str, str]]:
    results = {}

    def on_done(name: str, result: Any) -> None:
        assert name not in results
        results[name] = result

    stages = [(function, tasks)]
    failures = engine.run(stages, where, len(tasks), on_done=on_done, **options)
    return results, sentences(failures)


def sentences(failures: dict[str, Exception]) -> dict[str, str]:
    """Why tasks failed; mistakes of the user's are marked."""
    return {n: "mistake: " * (type(e) is ValueError) + str(e) for n, e in failures.items()}


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # Nobody may be there to bury it in a container; the dead run no longer.
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"


# ----------------------------------------------------------------- without processes


def test_importing_the_engine_loads_no_jax():
    code = (
        "import sys, excite.study.engine; "
        "print(*{'jax', 'torch', 'equinox', 'distributed'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_another_version_is_refused():
    answer = dask.call("tasks:add", "0.0.0", {"a": 1, "b": 2})
    sentence = f"the worker runs excite {__version__}, the study was started by 0.0.0"
    assert answer == Failure(sentence, is_mistake=True)


@pytest.mark.parametrize(
    ("module", "needs_extra"), [("no_such_module", False), ("stable_baselines3.no_such", True)]
)
def test_only_a_missing_module_of_ppo_names_its_extra(module, needs_extra):
    [answer] = answers(f"{module}:train", {})
    assert isinstance(answer, Failure)
    assert answer.is_mistake
    assert repr(module.partition(".")[0])[:-1] in answer.sentence
    assert ("excite[ppo]" in answer.sentence) == needs_extra


def test_no_tasks_open_no_engine():
    def never(num_tasks: int) -> Any:
        raise RuntimeError

    assert work(functions.add, {}, never) == ({}, {})


def test_less_than_one_worker_is_refused():
    with pytest.raises(ValueError, match="at least 1"):
        engine.local_engine(0)


def test_without_dask_the_extra_is_named(monkeypatch):
    monkeypatch.setattr(dask, "distributed", None)
    with pytest.raises(ValueError, match=r"pip install 'excite\[dask\]'"):
        dask.dask_engine("tcp://127.0.0.1:8786")


@pytest.mark.parametrize(
    "address",
    [
        *("", "here", "127.0.0.1", "tcp://:8786", "http://h:1", "h:99999", "h:one", "[::1"),
        *("tcp://h:1/x", "h:1?x=2", "tcp://a..b:1"),
    ],
)
def test_a_malformed_address_is_refused(address):
    pytest.importorskip("distributed")
    with pytest.raises(ValueError, match="no address of a scheduler"):
        dask.dask_engine(address)


# ------------------------------------------------------------------- processes here


def test_results_arrive_and_what_fails_is_tried_again(tmp_path):
    def failing(kind: str, times: int) -> dict[str, Any]:
        marker = str(tmp_path / f"{kind}{times}")
        return {"function": "fail", "marker": marker, "kind": kind, "times": times}

    tasks = {f"sum {i}": {"function": "add", "a": i, "b": 1} for i in range(5)}
    tasks |= {"once": failing("os", 1), "always": failing("os", 99), "two": failing("two", 99)}
    tasks |= {"value": failing("value", 99), "exit": failing("exit", 1)}
    results, failures = work(functions.any_of_them, tasks, engine.local_engine(2))
    assert results == {f"sum {i}": i + 1 for i in range(5)} | {"once": "mended", "exit": "mended"}
    assert failures == {
        "always": "OSError: a disk is full",
        "two": "NeedsTwoError: does not travel",
        "value": "mistake: a user's mistake",
    }
    assert {p.name: len(p.read_text().splitlines()) for p in tmp_path.iterdir()} == {
        "os1": 2,
        "os99": 3,
        "two99": 3,
        "value99": 1,  # a user's mistake stays one
        "exit1": 2,
    }


def test_a_stage_follows_the_one_before_in_the_same_worker():
    results = {}

    def stages() -> Iterator[engine.Stage]:
        yield functions.process, {"first": {}}
        assert list(results) == ["first"]
        yield functions.add, {}
        yield functions.process, {"second": {}, "third": {}}

    assert engine.run(stages(), engine.local_engine(1), 2, on_done=results.__setitem__) == {}
    assert list(results) == ["first", "second", "third"]
    assert len(set(results.values())) == 1


def test_workers_that_die_take_nobody_along(tmp_path):
    tasks: dict[str, Any] = {"always": {"function": "die"}}
    tasks["once"] = {"function": "die", "marker": str(tmp_path / "died"), "a": 1, "b": 2}
    for i in range(4):
        marker = str(tmp_path / f"sum{i}")
        tasks[f"sum {i}"] = {"function": "add", "a": i, "b": 1, "marker": marker, "seconds": 0.5}
    results, failures = work(functions.any_of_them, tasks, engine.local_engine(2))
    assert results == {"once": 3} | {f"sum {i}": i + 1 for i in range(4)}
    assert failures == {"always": "its worker died 3 times"}
    for i in range(4):  # not even a task that ran beside one that died is done again
        assert (tmp_path / f"sum{i}").read_text() == "called\n"


def test_the_environment_is_set_before_anything_is_imported(monkeypatch):
    # XLA takes the first word for a file where it has no --.
    told = "--xla_cpu_multi_thread_eigen=true --xla_dump_to=nowhere word=1"
    monkeypatch.setenv("XLA_FLAGS", told)
    monkeypatch.delenv("NPROC", raising=False)
    before = os.environ.copy()
    results, failures = work(functions.environment, {"e": {}}, engine.local_engine(1))
    assert not failures
    expected = {
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        "NPROC": "1",
        "JAX_ENABLE_X64": "1",
        "TF_CPP_MIN_LOG_LEVEL": "3",
        "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false --xla_dump_to=nowhere word=1",
    }
    assert results["e"]["environment"] == expected
    assert results["e"]["at the import of this file"].items() >= expected.items()
    assert results["e"]["loaded"] == []
    assert os.environ.copy() == before  # of the driver, which is left as it was


def test_openblas_of_a_worker_has_one_thread():
    """Dask imports NumPy before a worker is told anything: what it inherits has to do."""
    there, _ = work(functions.num_blas_threads, {"t": {}}, engine.local_engine(1))
    assert there == {"t": 1}


def test_openblas_of_a_command_has_one_thread():
    """Threads that wait for one another make a fit five times as long on a busy computer."""
    told = "import excite.cli.options as o; o.prepare_jax(); import tasks; "
    told += "print(tasks.num_blas_threads())"
    own = {n: value for n, value in os.environ.items() if not n.endswith("_NUM_THREADS")}
    own["PYTHONPATH"] = str(Path(__file__).parent)
    words = [sys.executable, "-c", told]
    done = subprocess.run(words, env=own, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "1"


def test_ctrl_c_ends_the_workers_at_once(tmp_path):
    markers = [tmp_path / str(i) for i in range(2)]

    def interrupt() -> None:
        if all(m.exists() and m.read_text() for m in markers):
            os.kill(os.getpid(), signal.SIGINT)  # as it comes, between two lines of anything
            time.sleep(5)

    tasks = {m.name: {"marker": str(m)} for m in markers}
    with pytest.raises(KeyboardInterrupt):
        work(functions.hang, tasks, engine.local_engine(2), on_tick=interrupt)
    pids = [int(m.read_text()) for m in markers]
    assert wait_for(lambda: not any(map(is_alive, pids)))


def test_an_error_of_on_done_ends_the_workers_and_is_told(tmp_path):
    def on_done(name: str, result: Any) -> None:
        assert wait_for(lambda: marker.exists() and marker.read_text(), PATIENCE)
        raise OSError("disk full")

    marker = tmp_path / "pid"
    tasks: dict[str, Any] = {"hang": {"function": "hang", "marker": str(marker)}}
    tasks["sum"] = {"function": "add", "a": 1, "b": 1}
    with pytest.raises(OSError, match="disk full"):
        engine.run([(functions.any_of_them, tasks)], engine.local_engine(2), 2, on_done=on_done)
    assert wait_for(lambda: not is_alive(int(marker.read_text())))


def test_a_killed_driver_leaves_no_worker(tmp_path):
    markers = [tmp_path / str(i) for i in range(2)]
    tasks = {m.name: {"marker": str(m)} for m in markers}
    code = (
        "import tasks\nfrom excite.study import engine\n"
        f"engine.run([(tasks.hang, {tasks})], engine.local_engine(2), 2, on_done=print)"
    )
    driver = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL)
    try:
        assert wait_for(lambda: all(m.exists() and m.read_text() for m in markers), PATIENCE)
        pids = [int(m.read_text()) for m in markers]
        assert all(map(is_alive, pids))
    finally:
        driver.kill()
        driver.wait()
    assert wait_for(lambda: not any(map(is_alive, pids)))


# -------------------------------------------------------------------- a Dask cluster


@pytest.fixture
def cluster(tmp_path, monkeypatch) -> Iterator[Cluster]:
    pytest.importorskip("distributed")
    # The scheduler tells of every death at once, or one task would end all three workers.
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "0")
    cluster = Cluster(tmp_path)
    yield cluster
    cluster.close()


@pytest.mark.science
def test_a_cluster_that_loses_a_worker_gives_what_the_local_engine_gives(cluster, tmp_path):
    tasks = {f"{i}": {"function": "add", "a": i, "b": 1, "seconds": 0.1} for i in range(24)}
    for kind in ("os", "two", "value"):
        marker = str(tmp_path / kind)
        tasks[kind] = {"function": "fail", "marker": marker, "kind": kind, "times": 1}
    results = {}

    def on_done(name: str, result: Any) -> None:
        results[name] = result
        if len(results) == 8:
            cluster.kill(1)

    where = dask.dask_engine(cluster.address)
    stages = [(functions.any_of_them, tasks)]
    failures = sentences(engine.run(stages, where, len(tasks), on_done=on_done))
    for kind in ("os", "two", "value"):
        (tmp_path / kind).unlink()
    assert (results, failures) == work(functions.any_of_them, tasks, engine.local_engine(2))
    assert results == {f"{i}": i + 1 for i in range(24)} | {"os": "mended", "two": "mended"}
    assert failures == {"value": "mistake: a user's mistake"}


@pytest.mark.science
def test_a_task_that_kills_the_workers_of_a_cluster_is_given_up(cluster):
    tasks: dict[str, Any] = {"always": {"function": "die"}}
    tasks |= {f"{i}": {"function": "add", "a": i, "b": 1, "seconds": 0.1} for i in range(9)}
    where = dask.dask_engine(cluster.address)
    results, failures = work(functions.any_of_them, tasks, where, num_tries=2)
    assert results == {f"{i}": i + 1 for i in range(9)}
    assert failures == {"always": "its worker died 2 times"}


@pytest.mark.slow
def test_ctrl_c_calls_back_what_waits_on_a_cluster_and_a_lost_one_is_told(
    cluster, tmp_path, monkeypatch
):
    def stop() -> None:
        if marker.exists():
            raise KeyboardInterrupt

    def lose(name: str, result: Any) -> None:
        cluster.kill(0)

    marker = tmp_path / "called"
    task = {"a": 1, "b": 1, "marker": str(marker), "seconds": 0.4}
    where = dask.dask_engine(cluster.address)
    with pytest.raises(KeyboardInterrupt):
        work(functions.add, {f"{i}": task for i in range(40)}, where, on_tick=stop)
    num_calls = 0
    while (found := len(marker.read_text().splitlines())) > num_calls:
        num_calls = found
        time.sleep(2)  # three workers would call a dozen more
    assert num_calls < 40

    monkeypatch.setattr(dask, "CONNECT_TIMEOUT", 1.0)
    stages = [(functions.add, {f"{i}": task for i in range(40)})]
    with pytest.raises(ValueError, match="no Dask scheduler answers"):
        engine.run(stages, where, 40, on_done=lose)


def test_a_cluster_without_workers_is_waited_for_and_that_is_told(tmp_path):
    pytest.importorskip("distributed")
    cluster, told = Cluster(tmp_path, num_workers=0), []

    def on_wait() -> None:
        told.append("waiting")
        cluster.start_worker()

    try:
        where = dask.dask_engine(cluster.address, on_wait)
        assert work(functions.add, {"sum": {"a": 1, "b": 2}}, where) == ({"sum": 3}, {})
    finally:
        cluster.close()
    assert told == ["waiting"]


@pytest.mark.parametrize("is_silent", [True, False], ids=["silent", "closed"])
def test_a_scheduler_that_does_not_answer_is_one_sentence(is_silent):
    pytest.importorskip("distributed")
    code = (
        "import sys\nfrom excite.study import cluster, engine\ncluster.CONNECT_TIMEOUT = 1.0\n"
        "try:\n    where = cluster.dask_engine(sys.argv[1])\n"
        "    engine.run([(print, {'t': {}})], where, 1, on_done=print)\n"
        "except ValueError as error:\n    print(error)"
    )
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        if not is_silent:
            server.close()
        command = [sys.executable, "-c", code, address]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE)
    assert done.stdout == f"no Dask scheduler answers at {address}\n"
    assert done.stderr == ""
