"""A functional mock-up unit (FMI 2 or 3) as a rig, by FMPy.

The unit contains its integrator (co-simulation). Its inputs and outputs are found by the
plant's names, or by `names` where they differ; experiment, supervisor and record are then
the same as on any other rig. A wrong file or name raises ValueError before anything is
started; a unit that fails while it runs raises `RigError`.

A unit contains native code, which is run. Open only units that you trust.
"""

from __future__ import annotations

import contextlib
import difflib
import hashlib
import shutil
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

try:
    import fmpy
    import fmpy.simulation as fmi
    from fmpy.model_description import ModelDescription, ScalarVariable
except ImportError:
    fmpy: Any = None
    fmi: Any = None

from ..description import PlantDescription, names_of
from .contract import AbstractRig, Pacer, Reading, RigError

_REAL = ("Real", "Float64", "Float32")
_FATAL = 4  # the status after which a unit may not even be released


class FMURig(AbstractRig):
    """A co-simulation unit that behaves like a plant."""

    def __init__(
        self,
        path: Path,
        description: PlantDescription,
        *,
        names: Mapping[str, str] | None = None,
        start: Mapping[str, float] | None = None,
        num_readings: int = 1,
        is_real_time: bool = False,
    ) -> None:
        """The unit in a file, which is read but not yet started.

        Args:
            names: the unit's names of inputs and outputs, where they are not the plant's.
            start: values of the unit's parameters, by the unit's names.
            num_readings: in one sampling time.
            is_real_time: whether readings come in real time.

        Raises:
            ValueError: one sentence for a missing FMPy, a file that is no such unit, or a
                variable that it does not have.
        """
        self.description, self.num_readings = description, num_readings
        self.is_real_time = is_real_time
        self._path, self._start = path, dict(start or {})
        self._model, self._hash = _read(path)
        self._inputs, self._outputs = _variables(self._model, path, description, names or {})
        _require_settable(self._model, path, self._start)
        self._unit: Any = None
        self._folder: str | None = None
        self._said = ""
        self._is_running = self._is_lost = False

    def open(self) -> None:
        """Extracts, instantiates and initialises the unit, its inputs safe."""
        self._interval = self.description.dt / self.num_readings
        self._pacer, self._count, self._is_lost = Pacer(self._interval), 0, False
        with self._failing("could not be started"):
            self._folder = tempfile.mkdtemp(prefix="excite-fmu-")
            fmpy.extract(self._path, self._folder)
            # FMPy changes the working directory to load a library, and keeps it on failure.
            with contextlib.chdir("."):
                self._unit = fmi.instantiate_fmu(
                    self._folder, self._model, "CoSimulation", logger=self._log
                )
            self._initialise()

    def read(self) -> Reading:
        """The outputs one interval later; those of time zero first."""
        now = self._count * self._interval
        with self._failing(f"failed at {now:.4g} s"):
            if self._count:
                self._step(now - self._interval)
            outputs = self._get()
        self._count += 1
        if self.is_real_time:
            self._pacer.wait()
        return Reading(now, outputs)

    def write(self, input: np.ndarray) -> None:
        """Sets the inputs; does nothing after a failure, as the standard requires."""
        if self._is_running:
            with self._failing("refused an input"):
                self._set(input)

    def close(self) -> None:
        """Terminates and frees the unit and removes what was extracted."""
        unit, self._unit = self._unit, None
        if self._is_running:
            with contextlib.suppress(Exception):
                unit.terminate()
        if unit is not None and not self._is_lost:
            with contextlib.suppress(Exception):
                unit.freeInstance()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
        self._folder, self._is_running = None, False

    def facts(self) -> Mapping[str, object]:
        """The unit, its file's hash, and the start values."""
        return {
            "fmu": self._path.name,
            "fmu_hash": self._hash,
            "fmi_version": self._model.fmiVersion,
            "model": self._model.modelName,
            "start": self._start,
        }

    def _initialise(self) -> None:
        unit, left = self._unit, self._start
        if self._model.fmiVersion == "2.0":
            unit.setupExperiment(startTime=0.0)
        left = fmi.apply_start_values(unit, self._model, left, fmi.settable_in_instantiated)
        unit.enterInitializationMode()
        fmi.apply_start_values(unit, self._model, left, fmi.settable_in_initialization_mode)
        self._set(self.safe_input)
        unit.exitInitializationMode()
        self._is_running = True

    def _get(self) -> np.ndarray:
        read = [getattr(self._unit, f"get{v.type}")([v.valueReference])[0] for v in self._outputs]
        return np.array(read, float)

    def _set(self, input: np.ndarray) -> None:
        for variable, value in zip(self._inputs, input.tolist(), strict=True):
            getattr(self._unit, f"set{variable.type}")([variable.valueReference], [value])

    def _step(self, time: float) -> None:
        done = self._unit.doStep(time, self._interval)
        if done is not None and done[1]:  # FMI 3 returns more: event, terminate, early, last time
            raise RigError("the unit requested the end of the simulation")

    def _log(self, *message: bytes | int | None) -> None:
        """Keeps the unit's last message, which FMPy would print."""
        self._said = (message[-1] or b"").decode(errors="replace")

    @contextlib.contextmanager
    def _failing(self, what: str) -> Iterator[None]:
        """Turns any error into one sentence with the unit's last message."""
        self._said = ""
        try:
            yield
        except Exception as error:
            self._is_running = False
            self._is_lost = getattr(error, "status", None) == _FATAL
            said = "; ".join(filter(None, [_one_line(error), _one_line(self._said)]))
            raise RigError(f"{self._path.name} {what} ({said})") from error


def simulate_fmu(
    path: Path,
    description: PlantDescription,
    inputs: np.ndarray,
    *,
    names: Mapping[str, str] | None = None,
    start: Mapping[str, float] | None = None,
) -> np.ndarray:
    """Outputs [time+1, output] of a unit for inputs [time, input], to compare it with a plant.

    Raises:
        ValueError: as `FMURig` does.
        RigError: for a unit that fails.
    """
    rig, outputs = FMURig(path, description, names=names, start=start), []
    with rig:
        outputs.append(rig.read().outputs)
        for row in np.asarray(inputs, float):
            rig.write(row)
            outputs.append(rig.read().outputs)
    return np.array(outputs)


def _read(path: Path) -> tuple[ModelDescription, str]:
    """FMPy's description of a co-simulation unit that runs on this machine, and the file's hash."""
    if fmpy is None:
        raise ValueError("an FMU needs FMPy: pip install 'excite[fmu]'")
    try:
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
            model = fmpy.read_model_description(file)
            files = [name.split("/") for name in zipfile.ZipFile(file).namelist()]
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    except Exception as error:  # from the ZIP file, its XML, or the standard's rules
        raise ValueError(f"{path}: truncated, or no FMU ({_one_line(error)})") from None
    if model.fmiVersion == "1.0":
        raise ValueError(f"{path}: FMI 1.0; FMI 2 and 3 are supported")
    if model.coSimulation is None:
        raise ValueError(
            f"{path}: contains no integrator; export it for co-simulation, not only for "
            "model exchange"
        )
    here = fmpy.platform if model.fmiVersion == "2.0" else fmpy.platform_tuple
    platforms = sorted({name[1] for name in files if name[0] == "binaries" and len(name) > 2})
    if here not in platforms:
        raise ValueError(f"{path}: has no library for {here} (there is {_listed(platforms)})")
    return model, digest


def _variables(
    model: ModelDescription, path: Path, description: PlantDescription, names: Mapping[str, str]
) -> tuple[list[ScalarVariable], list[ScalarVariable]]:
    """Inputs and outputs of the unit in the plant's order."""
    inputs, outputs = names_of(description.inputs), names_of(description.outputs)
    for name in names:
        if name not in (*inputs, *outputs):
            raise _unknown(f"{description.name} has no input or output", name, (*inputs, *outputs))
    real = {v.name: v for v in model.modelVariables if v.type in _REAL and not v.shape}
    settable = {name: v for name, v in real.items() if v.causality == "input"}
    shown = {name: v for name, v in real.items() if v.causality == "output"}
    found: list[list[ScalarVariable]] = []
    for kind, plant_names, first, there in (
        ("input", inputs, settable, settable),
        ("output", outputs, shown, real),  # internal variables may be measured too
    ):
        found.append([])
        for name in (names.get(name, name) for name in plant_names):
            if name not in there:
                raise _unknown(f"{path}: has no real {kind}", name, first)
            found[-1].append(there[name])
    return found[0], found[1]


def _require_settable(model: ModelDescription, path: Path, start: Mapping[str, float]) -> None:
    """Raises ValueError where a start value has no variable that takes it."""
    settable = [
        v.name
        for v in model.modelVariables
        if v.causality != "input"
        and (fmi.settable_in_instantiated(v) or fmi.settable_in_initialization_mode(v))
    ]
    for name in start:
        if name not in settable:
            raise _unknown(f"{path}: has no start value", name, settable)


def _unknown(what: str, name: str, there: Iterable[str]) -> ValueError:
    """An error with the nearest names, or the first few."""
    there = list(there)
    near = difflib.get_close_matches(name, there, cutoff=0.5) or there[:5]
    return ValueError(f"{what} {name!r} (there is {_listed(near)})")


def _listed(words: Iterable[str]) -> str:
    return ", ".join(words) or "none"


def _one_line(text: object) -> str:
    return " ".join(str(text).split()).rstrip(".")
