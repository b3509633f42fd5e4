"""The examples of CONTRIBUTING.md work under the strict settings of the tests."""

import importlib
import re
import shlex
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import test_plant
from catalogue import TwoMasses
from commands import excite

import excite as ex
from excite import estimation
from excite.environment import StepData
from excite.excitation import Chirp
from excite.excitation.catalogue import EXCITATIONS
from excite.plant import Aero2
from excite.safety import critical_levels, is_violation

ROOT = Path(__file__).parent.parent
Added = Callable[[str, str, str], ModuleType]


def examples(heading: str) -> list[str]:
    """The Python of one section."""
    section = (ROOT / "CONTRIBUTING.md").read_text().split(f"\n## {heading}\n")[1]
    return re.findall(r"```python\n(.*?)```", section.split("\n## ")[0], re.S)


@pytest.fixture
def added(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Added]:
    """Adds a module to a package, where types and shapes are checked."""
    names = []

    def add(package: str, module: str, text: str) -> ModuleType:
        (tmp_path / f"{module}.py").write_text(text)
        room = importlib.import_module(f"excite.{package}")
        monkeypatch.setattr(room, "__path__", [*room.__path__, str(tmp_path)])
        names.append(f"excite.{package}.{module}")
        return importlib.import_module(names[-1])

    yield add
    for name in names:
        sys.modules.pop(name, None)


@pytest.mark.slow
def test_the_plant_obeys_its_equations_and_the_classical_signals_are_safe(added, monkeypatch):
    text, functions = examples("Add a plant")
    plant = added("plant", "pendulum", text).Pendulum()
    for table in (test_plant.MOTION, test_plant.ENERGY):
        monkeypatch.setitem(table, "pendulum", None)  # so that the entry goes with the test
    exec(functions, vars(test_plant).copy())
    test_plant.test_derivative_obeys_the_equations_of_motion(plant)
    test_plant.test_energy_never_rises_without_input(plant)
    for name in EXCITATIONS:
        outputs = ex.simulate(plant, name, params={"J": 0.021}, seed=0).outputs
        assert not is_violation(outputs, critical_levels(plant.description)), name


def test_the_excitation_swings_twice_as_fast_for_every_further_input(added):
    text, check = examples("Add an excitation")
    for allowed in (Chirp(), SimpleNamespace(duty=jnp.array(1.0))):
        exec(check, {"excitation": allowed})
    with pytest.raises(ValueError, match=r"duty is 1\.5; it must lie between 0 and 1"):
        exec(check, {"excitation": SimpleNamespace(duty=jnp.array(1.5))})
    signals = (ROOT / "src" / "excite" / "excitation" / "signals.py").read_text()
    Triangle = added("excitation", "signals_and_triangle", f"{signals}\n\n{text}").Triangle
    wave = Triangle(frequency=0.5).shape(TwoMasses(), 200, jax.random.key(0))  # 40 samples
    np.testing.assert_allclose(wave[:40:5, 0], [0, 0.5, 1, 0.5, 0, -0.5, -1, -0.5], atol=1e-9)
    np.testing.assert_allclose(wave[:100, 1], wave[::2, 0], atol=1e-9)


@pytest.mark.slow
def test_the_estimator_passes_its_test(added, monkeypatch):
    text, test = examples("Add an estimator")
    OneStep = added("estimation", "one_step", text).OneStep
    monkeypatch.setattr(estimation, "OneStep", OneStep, raising=False)
    names: dict[str, Any] = {"__name__": "test_one_step"}
    exec(test, names)
    names["test_noise_free_data_give_the_parameters"]()
    record = ex.simulate("aero2", "chirp", params={"J_p": 0.0233}, seed=0)
    assert ex.identify(record, "aero2", OneStep).status == "successful"
    with pytest.raises(ValueError, match="known initial state"):
        ex.identify(record, "aero2", OneStep, initial_state="free")


@pytest.mark.slow
def test_classes_in_a_file_of_ones_own_work_from_python_and_the_command_line(tmp_path, monkeypatch):
    page = (ROOT / "docs/how-to/use-your-own-excitation.md").read_text()
    triangle, use, one_step, compare, _ = re.findall(r"```python\n(.*?)```", page, re.S)
    (tmp_path / "own.py").write_text(triangle + one_step)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    names: dict[str, Any] = {}
    exec(use + compare, names)
    assert abs(ex.identify(names["record"], "aero2", estimator=names["OneStep"]).params.J_p
               - 0.0233) < 1e-4  # fmt: skip
    sys.modules.pop("own")
    for command in re.findall(r"```sh\n(.*?)```", page, re.S)[0].splitlines():
        assert excite(*shlex.split(command)[1:]).returncode == 0


def test_the_objective_rewards_little_input(added):
    [text] = examples("Add an objective")
    objective, plant = added("environment", "effort", text).Effort(0.1), Aero2()
    sample = StepData(plant.nominal, plant.initial_state, jnp.array([12.0]), jnp.zeros(1))
    _, reward = objective.update(plant, None, sample, jnp.asarray(0))
    assert float(reward) == pytest.approx(-0.1 * 0.5**2)
    assert float(objective.final(plant, None, plant.nominal)) == 0
