"""Plants without inputs: kinetics, free decays, bodies that cool."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from commands import excite
from experiments import recording
from kinetics import TIME, TRUTH, Conversion, Product, concentrations

import excite as ex
from excite.description import Output, Parameter, PlantDescription, State
from excite.estimation.diagnosis import student_95
from excite.plant import AbstractPlant
from excite.record import Record, read_record

FILE = f"{Path(__file__).parent / 'kinetics.py'}:Conversion"


def measured(plant: type, noise: float = 0.02) -> Record:
    """A record at ten uneven instants, made without the package."""
    values = concentrations(TRUTH["k1"], TRUTH["k2"])[:, -len(plant.definition.outputs) :]
    noisy = values + noise * np.random.default_rng(3).normal(size=values.shape)
    return Record(TIME, np.zeros((len(TIME), 0)), noisy, source="kinetics.csv")


def scipys(record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Rate constants and half of their 95 % intervals by SciPy and matrix exponentials."""
    count = record.outputs.shape[1]

    def residual(rates: np.ndarray) -> np.ndarray:
        return (concentrations(*rates)[:, -count:] - record.outputs).ravel()

    found = scipy.optimize.least_squares(residual, [0.4, 0.3], xtol=1e-12, ftol=1e-12)
    degrees = record.outputs.size - 2
    variance = 2 * found.cost / degrees * np.linalg.inv(found.jac.T @ found.jac)
    return found.x, student_95(degrees) * np.sqrt(np.diag(variance))


class Leak(AbstractPlant):
    """A tank that runs empty through a hole; the slope of the root at zero is infinite."""

    definition = PlantDescription(
        name="leak",
        states=(State("level", "m"),),
        inputs=(),
        outputs=(Output("level", "m", scale=1.0, noise_sd=0.01),),
        parameters=(Parameter("k", "m^0.5/s", 0.1),),
        dt=0.5,
    )

    def derivative(self, state, input, params):
        return -params.k * jnp.sqrt(state)

    def output(self, state, params):
        return state


def test_an_infinite_slope_where_the_simulation_begins_is_told():
    time = 0.5 * np.arange(20)
    level = (1 - 0.06 * time)[:, None] ** 2  # of k = 0.12 from a level of 1
    record = Record(time, np.zeros((20, 0)), level, source="leak.csv")
    failed = ex.identify(record, Leak, initial_state="known")
    assert failed.status == "not finite"
    assert "derivative of level over level is not finite at level = 0" in failed.verdict[-1]
    full = Leak(initial_state=jnp.array([1.0]))
    assert ex.identify(record, full, initial_state="known").params["k"] == pytest.approx(0.12)


@pytest.mark.science
@pytest.mark.parametrize("plant", [Conversion, Product])
def test_rate_constants_and_intervals_are_those_of_scipy(plant):
    record = measured(plant)
    result = ex.identify(record, plant, initial_state="known")
    rates, half = scipys(record)
    assert result.status == "successful"
    for i, name in enumerate(("k1", "k2")):
        assert abs(result.params[name] - rates[i]) < 0.01 * half[i]
        low, high = result.ci95(name)
        # With two outputs, each has a noise of its own.
        assert (high - low) / 2 == pytest.approx(half[i], rel=0.01 if plant is Product else 0.3)
        assert low < TRUTH[name] < high
    assert np.isnan(result.structure["b"])
    assert "follow" not in str(result)
    result.plot()


@pytest.mark.science
def test_an_experiment_needs_no_excitation():
    record = ex.simulate(Conversion, steps=40, params=TRUTH, noise={"a": 0.0, "b": 0.0})
    assert record.inputs.shape == (41, 0)
    np.testing.assert_allclose(record.outputs, concentrations(**TRUTH, time=record.time), atol=1e-4)
    assert "conversion, no input: 41 samples" in repr(record)
    record.plot()
    result = ex.identify(record, Conversion)
    np.testing.assert_allclose(list(result.params.values()), list(TRUTH.values()), rtol=1e-3)


@pytest.mark.parametrize("excitation", ["chirp", np.zeros((40, 1)), np.zeros((40, 0))])
def test_an_excitation_is_refused(excitation):
    for verb in (ex.simulate, ex.information):
        with pytest.raises(ValueError, match="has no inputs: leave the excitation out"):
            verb(Conversion, excitation)


@pytest.mark.slow
def test_information_is_that_of_the_free_response():
    result = ex.information(Conversion, steps=20)
    bound = result.params["k1"].cramer_rao_bound
    record = ex.simulate(Conversion, steps=20)
    error = ex.identify(record, Conversion).std_error["k1"]
    assert bound == pytest.approx(error, rel=0.4)
    assert ex.information(Conversion, record).params["k1"].cramer_rao_bound == pytest.approx(bound)
    result.plot()


@pytest.mark.parametrize(
    "verb",
    [
        lambda: ex.design(Conversion, steps=10),
        lambda: ex.train(FILE),
        lambda: ex.run(plant=Conversion, dry_run=True),
        lambda: ex.evaluate("aero2", FILE),
    ],
    ids=["design", "train", "run", "evaluate"],
)
def test_there_is_nothing_to_design(verb):
    with pytest.raises(ValueError, match="'conversion' has no inputs: there is no signal") as error:
        verb()
    assert "\n" not in str(error.value)


@pytest.mark.science
def test_a_gap_in_time_begins_nothing_new():
    time = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 30.0, 30.1])
    values = concentrations(**TRUTH, time=time)
    record = Record(time, np.zeros((8, 0)), values, source="gap.csv")
    result = ex.identify(record, Conversion, initial_state="known")
    assert result.initial_state_known
    np.testing.assert_allclose(list(result.params.values()), list(TRUTH.values()), rtol=1e-3)


def test_a_description_needs_neither_inputs_nor_a_band():
    d = Conversion.definition
    assert d.band == (0.01, 0.5)
    assert d.columns == ("time", "a", "b")
    assert PlantDescription.from_dict(d.to_dict()) == d


@pytest.mark.slow
def test_the_command_line_identifies_a_file_without_inputs(tmp_path):
    rows = np.column_stack([TIME, measured(Conversion).outputs])
    np.savetxt(tmp_path / "r.csv", rows, delimiter=",", header="time,a,b", comments="")
    arguments = ["r.csv", "--plant", FILE, "--initial-state", "known"]
    done = excite("identify", *arguments, "--out", "run", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["params"]["k1"]["estimate"] == pytest.approx(TRUTH["k1"], rel=0.2)
    assert excite("report", "run", "--out", "r.html", cwd=tmp_path).returncode == 0
    assert excite("plants", FILE, cwd=tmp_path).returncode == 0
    refused = excite("design", FILE, "--out", "d.csv", cwd=tmp_path)
    assert refused.returncode == 2
    assert refused.stderr.count("\n") == 1


# One measurement in each row


class Boehm(Conversion):
    """Three observables, for reading only."""

    definition = PlantDescription(
        name="boehm",
        states=(State("x", ""),),
        inputs=(),
        outputs=tuple(
            Output(name, "%", scale=100.0) for name in ("pSTAT5A_rel", "pSTAT5B_rel", "rSTAT5A_rel")
        ),
        parameters=(Parameter("k", "1/s", 1.0),),
        dt=1.0,
    )


def test_a_petab_table_is_read_as_it_is():
    path = recording("measurementData_Boehm_JProteomeRes2014.tsv")
    if path is None:
        pytest.skip("the recording is not here; EXCITE_DATA names the folder that has it")
    record = read_record(path, Boehm.definition)
    assert record.inputs.shape == (16, 0)
    assert record.outputs.shape == (16, 3)
    assert record.time[[0, 1, -1]].tolist() == [0.0, 2.5, 240.0]
    assert record.outputs[1, 0] == pytest.approx(66.3634939682528)
    assert np.isfinite(record.outputs).all()


PETAB = "observableId\tsimulationConditionId\tmeasurement\ttime\n"


def test_observables_measured_at_other_times_are_missing_there(tmp_path):
    path = tmp_path / "m.tsv"
    path.write_text(f"{PETAB}b\tone\t0.5\t1\na\tone\t1.0\t0\na\tone\t0.7\t2\n")
    record = read_record(path, Conversion.definition)
    np.testing.assert_array_equal(record.time, [0, 1, 2])
    np.testing.assert_array_equal(record.outputs, [[1, np.nan], [np.nan, 0.5], [0.7, np.nan]])


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("a\tone\t1\t0\na\ttwo\t1\t1\n", "measured under 2 conditions"),
        ("a\tone\t1\t0\na\tone\t2\t0\nb\tone\t1\t1\n", "'a' is measured twice at the same time"),
        ("a\tone\tmuch\t0\na\tone\t1\t1\n", "is not a number"),
    ],
)
def test_a_petab_table_that_is_no_single_record_is_refused(rows, words, tmp_path):
    path = tmp_path / "m.tsv"
    path.write_text(PETAB + rows)
    with pytest.raises(ValueError, match=words) as error:
        read_record(path, Conversion.definition)
    assert "\n" not in str(error.value)


def test_few_values_are_said_to_widen_the_intervals():
    """Four samples of one output for two rates: Student's t has 2 degrees of freedom."""
    whole = measured(Product, 1e-3)
    few = Record(whole.time[::3], whole.inputs[::3], whole.outputs[::3], source="few.csv")
    result = ex.identify(few, Product, start=TRUTH, initial_state="known")
    told = f"(2 degrees of freedom): Student's t, {student_95(2):.3g} in place of 1.96"
    assert told in " ".join(result.verdict)
    assert not any(
        "degrees" in s for s in ex.identify(whole, Product, initial_state="known").verdict
    )
