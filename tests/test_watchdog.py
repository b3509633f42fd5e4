"""A watchdog: the rig sees the safe input after every end of the process, also `kill -9`.

The rig is a file: every line that is written to it is an input that a rig has seen.
"""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from commands import PATIENCE

import excite
from excite.policy import read_policy
from excite.rig import AbstractRig, Reading, Recorder, RigError, SignalPlayer, Watchdog, run_loop
from excite.safety import Supervision

AERO = read_policy("aero2_detailed").plant
SOURCE = str(Path(excite.__file__).parent.parent)

RIG = """
import os
import time

import numpy as np
from excite.rig import AbstractRig, Pacer, Reading, Watchdog


def send(word):
    with open("seen.txt", "a") as file:
        file.write(f"{word}\\n")


def stop(safe_input, name):
    send(f"{name} {safe_input[0]:g} {os.getpid()}")


class Filed(AbstractRig):
    num_readings, is_real_time = 2, False  # a busy computer loses deadlines
    watchdog = Watchdog(stop, ["watchdog"], timeout=1.0)

    def open(self):
        send(f"open {os.getpid()}")
        self.n, self.pacer = -1, Pacer(self.description.dt / 2)

    def read(self):
        self.n += 1
        if self.n == 7 and os.environ.get("HANGS"):
            time.sleep(float(os.environ["HANGS"]))
        return Reading(self.pacer.wait(), np.array([0.0001 * (self.n % 7)]))

    def write(self, input):
        send(f"loop {input[0]:g}")

    def close(self):
        send("close")
"""

PROGRAM = """
import sys
from pathlib import Path
import numpy as np
from excite.files import class_at
from excite.policy import read_policy
from excite.rig import AbstractRig, Recorder, SignalPlayer, interruptible, run_loop
from excite.safety import Supervision

rig = class_at(Path("filed.py"), "Filed", AbstractRig, "rig")()
rig.description = read_policy("aero2_detailed").plant
player = SignalPlayer(np.full((int(sys.argv[1]), 1), 5.0))
recorder = Recorder(Path("r.csv"), rig.description, {}, overwrite=True)
with interruptible() as stop, recorder, rig:
    outcome = run_loop(rig, player, Supervision.of(rig.description), recorder, stop=stop)
print(outcome.reason)
"""


def started(folder: Path, num_steps: int = 100, **settings: str) -> subprocess.Popen[str]:
    """An experiment on that rig, of 0.1 s a step."""
    (folder / "filed.py").write_text(RIG)
    environment = {**os.environ, "PYTHONPATH": SOURCE, **settings}
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(num_steps)], cwd=folder, env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip


def seen(folder: Path) -> list[str]:
    path = folder / "seen.txt"
    return path.read_text().splitlines() if path.exists() else []


def await_line(folder: Path, word: str, process: subprocess.Popen[str] | None = None) -> None:
    until = time.monotonic() + PATIENCE
    while not any(line.startswith(word) for line in seen(folder)):
        assert time.monotonic() < until, seen(folder)
        assert process is None or process.poll() is None, process.communicate()
        time.sleep(0.005)


NUM_KILLS = int(os.environ.get("EXCITE_KILLS", "3"))


@pytest.mark.parametrize("seed", range(NUM_KILLS))
def test_after_kill_9_at_any_time_the_rig_sees_the_safe_input(tmp_path, seed):
    with started(tmp_path) as process:
        await_line(tmp_path, "open", process)
        time.sleep(random.Random(seed).uniform(0.0, 1.5))
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        told = process.communicate(timeout=PATIENCE)[1]  # until the watchdog has ended too
    assert "close" not in seen(tmp_path)
    last = seen(tmp_path)[-1]
    assert last.startswith("watchdog 0 ")
    assert int(last.split()[-1]) != process.pid
    assert "the watchdog sent the safe input: the process of the experiment has ended" in told


def test_a_process_that_hangs_is_replaced(tmp_path):
    with started(tmp_path, HANGS="4") as process:
        out, told = process.communicate(timeout=PATIENCE)
    lines = seen(tmp_path)
    at = next(i for i, line in enumerate(lines) if line.startswith("watchdog 0 "))
    assert set(lines[at + 1 :]) <= {"loop 0", "close"}  # and no other input after it
    assert lines[at - 1] == "loop 5"
    assert "silence of more than 1 s" in out
    assert "the watchdog sent the safe input: silence of more than 1 s" in told


def test_a_stopped_process_is_replaced(tmp_path):
    with started(tmp_path) as process:
        await_line(tmp_path, "loop 5", process)
        process.send_signal(signal.SIGSTOP)
        await_line(tmp_path, "watchdog 0")
        process.kill()


@pytest.mark.parametrize("number", [None, signal.SIGINT, signal.SIGTERM])
def test_an_experiment_that_ends_needs_no_watchdog(tmp_path, number):
    """Signals to the whole group, as a terminal sends them."""
    with started(tmp_path, 8) as process:
        await_line(tmp_path, "loop 5", process)
        if number is not None:
            os.killpg(process.pid, number)
        out, told = process.communicate(timeout=PATIENCE)
    assert (told, process.returncode) == ("", 0)
    assert ("complete" if number is None else number.name) in out
    assert seen(tmp_path)[-3:] == ["loop 0", "loop 0", "close"]


class Rig(AbstractRig):
    """At rest, and as fast as it can."""

    is_real_time, num_readings, description = False, 2, AERO

    def __init__(self, watchdog, failing=()):
        self.watchdog, self.failing, self.log = watchdog, failing, []

    def open(self):
        self.n = -1
        self.said("open")

    def read(self):
        self.n += 1
        return Reading(self.n * AERO.dt / 2, np.array([0.0001 * (self.n % 7)]))

    def write(self, input):
        self.said(f"write {input[0]:g}")

    def close(self):
        self.said("close")

    def said(self, word):
        self.log.append(word)
        if word in self.failing:
            raise RigError("the cable is out")


def append(safe_input, path, word="safe"):
    with open(path, "a") as file:
        file.write(f"{word} {safe_input[0]:g}\n")


def fail_twice(safe_input, path):
    append(safe_input, path, "tried")
    if Path(path).read_text().count("tried") < 3:
        raise OSError("busy")


def test_a_safe_input_that_the_loop_cannot_write_is_sent_by_the_watchdog(tmp_path, capfd):
    path = tmp_path / "seen.txt"
    rig = Rig(Watchdog(append, [str(path)]), failing=["write 0"])
    player = SignalPlayer(np.full((5, 1), 5.0))
    with (
        pytest.raises(RigError, match="the cable is out"),
        Recorder(tmp_path / "a.csv", AERO, {}) as recorder,
        rig,
    ):
        run_loop(rig, player, Supervision.of(AERO), recorder)
    assert rig.log[-1] == "close"
    assert path.read_text() == "safe 0\n"
    assert "the watchdog sent the safe input" in capfd.readouterr().err


def test_a_function_that_fails_is_called_again(tmp_path, capfd):
    path = tmp_path / "seen.txt"
    with pytest.raises(RigError), Rig(Watchdog(fail_twice, [str(path)]), failing=["write 0"]):
        pass
    assert path.read_text() == "tried 0\n" * 3
    assert "sent the safe input" in capfd.readouterr().err


def test_a_rig_that_does_not_open_needs_no_watchdog(tmp_path):
    rig = Rig(Watchdog(append, [str(tmp_path / "seen.txt")]), failing=["open"])
    with pytest.raises(RigError), rig:
        pass
    assert not list(tmp_path.iterdir())


def test_a_watchdog_that_was_killed_ends_the_experiment(tmp_path):
    rig = Rig(Watchdog(append, [str(tmp_path / "seen.txt")], timeout=2.0))

    class Player(SignalPlayer):
        def __call__(self, k, measured):
            if k == 2:
                rig._watching._process.kill()  # pyright: ignore[reportOptionalMemberAccess]
                rig._watching._process.wait()  # pyright: ignore[reportOptionalMemberAccess]
            time.sleep(0.03)
            return super().__call__(k, measured)

    with Recorder(tmp_path / "a.csv", AERO, {}) as recorder, rig:
        player = Player(np.full((50, 1), 5.0))
        outcome = run_loop(rig, player, Supervision.of(AERO), recorder)
    assert outcome.reason == "the watchdog has ended"
    assert rig.log[-1] == "close"


def local():
    def send(safe_input):
        del safe_input

    return send


@pytest.mark.parametrize(("watchdog", "sentence"), [
    (Watchdog(lambda _: None), "must be one that another process can import"),
    (Watchdog(local()), "must be one that another process can import"),
    (Watchdog(append, [{1, 2}]), "must be JSON-ready"),  # pyright: ignore[reportArgumentType]
    (Watchdog(append, timeout=float("nan")), "at least that of two readings, 0.1 s: got nan"),
    (Watchdog(append, timeout=float("inf")), "at least that of two readings"),
    (Watchdog(append, timeout=0.09), "at least that of two readings"),
    (Watchdog(append, timeout=-1.0), "at least that of two readings"),
])  # fmt: skip
def test_a_watchdog_that_cannot_work_is_refused_before_anything_is_opened(watchdog, sentence):
    rig = Rig(watchdog)
    with pytest.raises(ValueError, match=sentence), rig:
        pass
    assert rig.log == []


def test_a_function_of_the_program_that_is_run_is_refused(tmp_path):
    """Another process would run the experiment a second time when it imports it."""
    program = RIG + (
        "\nfrom excite.policy import read_policy\n"
        "Filed.description = read_policy('aero2_detailed').plant\n"
        "with Filed():\n    pass\n"
    )
    (tmp_path / "filed.py").write_text(program)
    done = subprocess.run(
        [sys.executable, "filed.py"], cwd=tmp_path, env={**os.environ, "PYTHONPATH": SOURCE},
        capture_output=True, text=True, check=False, timeout=PATIENCE,
    )  # fmt: skip
    assert "must be one that another process can import" in done.stderr
    assert not seen(tmp_path)


def test_a_module_that_cannot_be_imported_elsewhere_is_told(tmp_path, monkeypatch):
    """What it prints is no answer."""
    (tmp_path / "once.py").write_text(
        "from pathlib import Path\n"
        "print('ready')\n"
        "if Path(__file__).with_suffix('.txt').exists():\n"
        "    raise ZeroDivisionError('a second time')\n"
        "Path(__file__).with_suffix('.txt').touch()\n"
        "def stop(safe_input): pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    from once import stop  # pyright: ignore[reportMissingImports]

    rig = Rig(Watchdog(stop))
    with pytest.raises(ValueError, match="could not be started: ZeroDivisionError: a second"), rig:
        pass
    assert rig.log == []
