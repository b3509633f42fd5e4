import contextlib
import dataclasses
import json
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.monitoring
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.io
import scipy.stats
from documented import documented
from experiments import NUM_STEPS, autoregressive, record_of, recording, spread_params

import excite as ex
from excite.description import Input, Output, Parameter, PlantDescription, State
from excite.estimation import ARX, NLS
from excite.estimation.fit import Fit, is_elsewhere
from excite.estimation.identify import agreement, identify
from excite.estimation.result import Identification
from excite.excitation import PRBS, Chirp, Random, Replay
from excite.files import json_ready
from excite.information import best_possible
from excite.plant import EMPS, AbstractPlant, Aero2, Aero2Detailed, Aero2Lag, DCMotor
from excite.plant.catalogue import plant_from
from excite.record import Record, read_record, require_columns, write_record
from excite.simulation import response, simulate

ROOT = Path(__file__).parent.parent
PLANT = Aero2()
TRUE = spread_params(PLANT)
TRUTH = {name: float(value) for name, value in TRUE._asdict().items()}
REST = Replay(jnp.zeros((NUM_STEPS, 1)))


def free_decay(pitch: float = 0.4) -> Record:
    """The plant let go from an angle, without input and without a sidecar."""
    lifted = PLANT.changed(initial_state=jnp.array([pitch, 0.0]))
    return record_of(lifted, REST, params=TRUE, sidecar=False)


def assert_within_sd(result: Identification, truth: Any, times: float = 4.0) -> None:
    """Every free parameter lies within so many standard errors of the truth."""
    for name in result.params.keys() - set(result.held):
        assert abs(result.params[name] - truth[name]) < times * result.std_error[name], name


@pytest.fixture(scope="module")
def chirp() -> Record:
    return record_of(PLANT, params=TRUE)


@pytest.fixture(scope="module")
def foreign() -> Record:
    """Another experiment, of which nothing is known but the numbers."""
    return dataclasses.replace(
        record_of(PLANT, PRBS(clock=5), params=TRUE, seed=1, sidecar=False), source="foreign.csv"
    )


@pytest.fixture(scope="module")
def result(chirp, foreign) -> Identification:
    return identify([chirp], PLANT, validate=[foreign])


def test_parameters_that_only_a_detour_hides_are_found():
    """Far from where the search begins, the data seem to say nothing of D_p and K_pu."""
    far = {"J_p": 0.3, "K_pu": 0.0125, "D_p": 0.00104}
    record = record_of(PLANT, Chirp(), params=PLANT.Params(**far), num_steps=500)
    result = identify([record], PLANT)
    assert result.status == "successful"
    assert_within_sd(result, far)


# A good record


@pytest.mark.science
def test_parameters_lie_within_their_standard_errors(result):
    assert result.status == "successful"
    assert result.is_usable
    assert result.held == ()
    assert_within_sd(result, TRUTH)


def test_standard_errors_are_those_of_the_bound(result, chirp):
    bound = best_possible(PLANT, TRUE, jnp.asarray(chirp.inputs[:-1]), initial_state_known=True)
    for name, error in result.std_error.items():
        assert error == pytest.approx(bound.params[name].cramer_rao_bound, rel=0.15)


def test_intervals_are_students_to_both_sides(result):
    t = scipy.stats.t.ppf(0.975, NUM_STEPS + 1 - 3)
    for name, (low, high) in ((n, result.ci95(n)) for n in result.params):
        assert (low + high) / 2 == pytest.approx(result.params[name], rel=1e-12)
        assert (high - low) / result.std_error[name] == pytest.approx(2 * t, rel=1e-6)


def test_fit_is_that_of_the_simulated_output(result, chirp):
    (fitted,) = result.fitted
    y = chirp.outputs[:, 0]
    misfit = np.linalg.norm(y - fitted.simulated[:, 0]) / np.linalg.norm(y - y.mean())
    assert result.fit()["pitch"] == pytest.approx(100 * (1 - misfit), rel=1e-12)
    assert fitted.fit_percent["pitch"] == pytest.approx(result.fit()["pitch"])
    assert result.fit()["pitch"] > 99


def test_a_residual_of_sensor_noise_is_white_and_the_verdict_is_one_sentence(result):
    assert result.whiteness["pitch"] > 0.01
    assert len(result.verdict) == 1
    assert result.verdict[0].startswith("all parameters identifiable; least certain ")


def test_held_out_data_are_simulated_with_the_estimate(result, foreign):
    (validated,) = result.validation
    assert validated.record is foreign
    assert validated.fit_percent["pitch"] > 99
    assert np.std(foreign.outputs - validated.simulated) == pytest.approx(2e-4, rel=0.3)


def test_held_out_data_change_no_estimate(result, chirp):
    assert identify([chirp], PLANT).params == result.params


def test_the_start_changes_no_estimate(result, chirp):
    moved = identify([chirp], PLANT, start={"J_p": 0.018, "K_pu": 0.016, "D_p": 0.002})
    for name, value in moved.params.items():
        assert abs(value - result.params[name]) < 0.02 * result.std_error[name]


@pytest.mark.slow
def test_a_known_parameter_is_held_and_the_others_gain(chirp, result):
    held = identify([chirp], PLANT, NLS(known=("K_pu",)), start={"K_pu": 0.012})
    assert held.status == "successful"
    assert held.held == ("K_pu",)
    assert held.params["K_pu"] == pytest.approx(0.012, rel=1e-12)
    assert np.isnan(held.std_error["K_pu"])
    right = {"K_pu": result.params["K_pu"]}
    known = identify([chirp], PLANT, NLS(known=("K_pu",)), start=right)
    for name in ("J_p", "D_p"):
        assert abs(known.params[name] - result.params[name]) < 0.05 * result.std_error[name]
        assert known.std_error[name] <= result.std_error[name] * 1.001


@pytest.mark.science
def test_a_lag_may_be_known_or_estimated():
    plant = Aero2Lag()
    signal = Chirp().sequence(plant, 300, jax.random.key(0))
    truth = plant.nominal._replace(J_p=jnp.asarray(0.025), tau=jnp.asarray(0.2))
    outputs = np.asarray(response(plant, truth, signal))
    noisy = outputs + np.random.default_rng(0).normal(0, 2e-4, outputs.shape)
    record = Record.of_episode(
        np.arange(301) * 0.1, np.asarray(signal), noisy, {"starts_at_initial_state": True}
    )
    free = identify([record], plant, initial_state="known")
    known = identify(record, plant, hold={"tau": 0.2}, initial_state="known")
    wrong = identify(record, plant, NLS(known=("tau",)), start={"tau": 0.1}, initial_state="known")
    assert abs(free.params["tau"] - 0.2) < 4 * free.std_error["tau"]
    assert abs(known.params["J_p"] - 0.025) < 4 * known.std_error["J_p"]
    assert known.structure["pitch"] > 0.01
    assert "structure" in wrong.verdict[0]


@pytest.mark.parametrize(
    ("hold", "complaint"),
    [(("J",), "no parameter 'J'"), (("J_p", "K_pu", "D_p"), "all parameters are held")],
)
def test_what_cannot_be_held_is_refused(chirp, hold, complaint):
    with pytest.raises(ValueError, match=complaint):
        identify([chirp], PLANT, NLS(known=hold))


# Initial states


def test_the_initial_state_is_known_where_the_sidecar_says_so(chirp, foreign, tmp_path):
    write_record(tmp_path / "ours.csv", chirp, PLANT.description)
    ours = read_record(tmp_path / "ours.csv", PLANT.description)
    assert identify([ours], PLANT).initial_state_known
    assert not identify([foreign], PLANT).initial_state_known
    assert not identify([ours], PLANT, initial_state="free").initial_state_known
    assert identify([foreign], PLANT, initial_state="known").initial_state_known


def test_a_sidecar_of_another_initial_state_leaves_it_free():
    lifted = PLANT.changed(initial_state=jnp.array([0.2, 0.0]))
    record = record_of(lifted, params=TRUE)
    assert record.starts_at_initial_state
    result = identify([record], PLANT)
    assert not result.initial_state_known
    assert_within_sd(result, TRUTH)


def test_a_free_initial_state_costs_accuracy(result, chirp):
    free = identify([chirp], PLANT, initial_state="free")
    assert_within_sd(free, TRUTH)
    assert free.std_error["J_p"] > 1.1 * result.std_error["J_p"]


# Several records


@pytest.mark.slow
def test_records_fitted_together_share_their_information(chirp, foreign):
    short = dataclasses.replace(
        foreign, time=foreign.time[:151], inputs=foreign.inputs[:151], outputs=foreign.outputs[:151]
    )
    together = identify([chirp, short], PLANT, initial_state="known")
    assert_within_sd(together, TRUTH)
    parts = [
        best_possible(PLANT, TRUE, jnp.asarray(r.inputs[:-1]), initial_state_known=True).information
        for r in (chirp, short)
    ]
    np.testing.assert_allclose(together.information, sum(parts), rtol=0.3)
    assert [len(f.simulated) for f in together.fitted] == [NUM_STEPS + 1, 151]
    assert together.fit()["pitch"] > 99


@pytest.mark.science
def test_each_record_has_an_initial_state_of_its_own(foreign):
    result = identify([free_decay(), foreign], PLANT)
    assert result.held == ()
    assert_within_sd(result, TRUTH)
    assert min(f.fit_percent["pitch"] for f in result.fitted) > 99


@pytest.mark.science
def test_one_record_from_elsewhere_frees_all_initial_states(chirp, foreign):
    assert not identify([chirp, foreign], PLANT).initial_state_known


# What the data cannot see


@pytest.fixture(scope="module")
def decay() -> Identification:
    return identify([free_decay()], PLANT, start={"K_pu": 0.03})


def test_the_size_of_the_residual_leaves_out_what_was_not_measured(result):
    fitted = result.fitted[0]
    outputs = fitted.record.outputs.copy()
    outputs[10:400] = np.nan
    record = dataclasses.replace(fitted.record, outputs=outputs)
    fewer = dataclasses.replace(result, fitted=(dataclasses.replace(fitted, record=record),))
    left = np.delete(fitted.record.outputs - fitted.simulated, slice(10, 400))
    size = fewer.residual()["pitch"]
    assert size["sum_of_squares"] == pytest.approx(left @ left)
    assert size["rms"] == pytest.approx(np.sqrt(np.mean(left**2)))


def test_a_free_decay_holds_the_input_gain_and_fits_the_rest(decay):
    assert decay.status == "partly identifiable"
    assert decay.is_usable
    assert decay.held == ("K_pu",)
    assert decay.params["K_pu"] == pytest.approx(0.03, rel=1e-9)
    assert np.isnan(decay.std_error["K_pu"])
    assert_within_sd(decay, TRUTH)
    assert decay.fit()["pitch"] > 99


def test_a_sentence_names_the_held_parameter_and_where_it_was_held(decay):
    assert decay.verdict[0] == "K_pu is not identifiable from the data; K_pu was held at 0.03"
    assert decay.verdict[1].startswith("K_pu is structurally identifiable, but practically not ")
    assert decay.verdict[2].startswith("J_p, D_p identifiable; least certain ")


class Slow(AbstractPlant):
    """A first-order lag, of which the search begins at five sampling times."""

    definition = PlantDescription(
        name="slow",
        states=(State("x", "m", scale=1.0),),
        inputs=(Input("u", "m", -2.0, 2.0, amplitude=1.0),),
        outputs=(Output("x", "m", scale=1.0, noise_sd=0.4),),
        parameters=(Parameter("gain", "1", 1.0), Parameter("tau", "s", 0.5)),
        dt=0.1,
        substeps=16,
    )

    def derivative(self, state, input, params):
        return (params.gain * input - state) / params.tau

    def output(self, state, params):
        return state


@pytest.mark.science
def test_an_unseen_parameter_is_not_held_where_it_ruins_the_fit():
    record = record_of(Slow(), PRBS(clock=1), params=Slow().Params(0.8, 0.012), sidecar=False)
    result = identify([record], Slow())
    assert result.held == ("tau",)
    assert result.params["tau"] < 0.05
    assert result.params["gain"] == pytest.approx(0.8, abs=0.1)
    assert result.fitted[0].fit_percent["x"] > 50


@pytest.mark.science
def test_a_held_value_that_contradicts_the_data_is_told():
    """The search runs away to zero, which may be the truth or a sign of wrong data."""
    record = record_of(PLANT, params=TRUE._replace(D_p=jnp.asarray(1e-9)))
    result = identify([record], PLANT)
    assert result.held == ("D_p",)
    told = "D_p was held at 0.00104, which contradicts the data (--start)"
    assert any(s.endswith(told) for s in result.verdict)
    right = identify([record], PLANT, start={"D_p": 1e-8})
    assert not any("contradicts" in s for s in right.verdict)
    assert_within_sd(right, TRUTH)


@pytest.mark.science
def test_a_coarse_integration_is_told():
    class Coarse(DCMotor):
        definition = dataclasses.replace(DCMotor.definition, substeps=1)

    fine = DCMotor().integrated_in(20)
    record = record_of(fine, sidecar=False)
    result = identify([record], Coarse())
    told = next(s for s in result.verdict if "the integration is too coarse" in s)
    needed = int(told.split("substeps=")[1].split()[0])
    assert needed == 2

    class Finer(DCMotor):
        definition = dataclasses.replace(DCMotor.definition, substeps=8)

    assert not any("too coarse" in s for s in identify([record], Finer()).verdict)


@pytest.mark.science
def test_a_finer_integration_is_advised_for_the_sampling_time_of_the_data():
    """The advised number of steps is in the definition's sampling time."""

    class Coarse(DCMotor):
        definition = dataclasses.replace(
            DCMotor.definition, dt=4 * DCMotor.definition.dt, band=(2.0, 50.0)
        )

    record = record_of(DCMotor().integrated_in(20), sidecar=False)
    told = [s for s in identify([record], Coarse()).verdict if "too coarse" in s]
    needed = int(told[0].split("substeps=")[1].split()[0])

    class Finer(DCMotor):
        definition = dataclasses.replace(Coarse.definition, substeps=needed)

    finer = Finer().changed(dt=DCMotor.definition.dt)
    assert finer.substeps == 2 * Coarse().changed(dt=DCMotor.definition.dt).substeps


@pytest.mark.science
def test_an_interval_ends_at_a_parameters_bound_and_zero_is_told():
    decay, hold = free_decay(), {"K_pu": 0.0125, "J_p": TRUTH["J_p"]}
    noise = np.random.default_rng(3).normal(size=(7, 1))

    def found(sd: float) -> Identification:
        outputs = decay.outputs[::30] + sd * noise
        return identify(
            [Record(decay.time[::30], decay.inputs[::30], outputs, {})], PLANT, hold=hold
        )

    quiet = found(1e-4)
    uncertain = 1.45 * quiet.params["D_p"] / quiet.std_error["D_p"]
    result = found(1e-4 * uncertain)
    assert result.held == ("J_p", "K_pu")
    assert result.intervals["D_p"][0] == 0


def test_what_is_wide_because_of_colour_is_not_called_identifiable(foreign):
    noise = 0.05 * autoregressive(np.random.default_rng(2), foreign.outputs.T.shape, 0.97).T
    coloured = dataclasses.replace(foreign, outputs=foreign.outputs + noise)
    result = identify([coloured], PLANT)
    wide = [n for n in result.params if result.std_error[n] > 0.5 * result.params[n]]
    assert wide
    assert any(s.startswith(wide[0]) and s.endswith("above 50 %") for s in result.verdict)
    assert not any(wide[0] in s for s in result.verdict if " identifiable; least" in s)


def test_a_held_parameter_is_null_in_json_but_for_its_value(decay):
    entry = json_ready(decay.to_dict())["params"]["K_pu"]
    assert entry["estimate"] == pytest.approx(0.03)
    assert entry["held"] is True
    assert entry["std_error"] is None
    assert entry["ci95"] == [None, None]


def noise_only(record: Record) -> Record:
    noise = 2e-4 * np.random.default_rng(0).normal(size=record.outputs.shape)
    return dataclasses.replace(record, outputs=noise)


@pytest.mark.science
@pytest.mark.parametrize(
    "spoil",
    [
        lambda r: noise_only(dataclasses.replace(r, inputs=0 * r.inputs)),
        lambda r: dataclasses.replace(r, inputs=0 * r.inputs, outputs=0 * r.outputs),
        lambda r: dataclasses.replace(r, outputs=0 * r.outputs),
        noise_only,
    ],
    ids=["noise at rest", "nothing", "no response", "noise for a response"],
)
def test_data_in_which_no_parameter_can_be_seen_are_refused(spoil, foreign):
    with pytest.raises(ValueError, match="no parameter is identifiable from the data") as error:
        identify([spoil(foreign)], PLANT)
    assert "\n" not in str(error.value)


def test_a_record_of_a_plant_with_other_constants_is_remarked(chirp):
    result = identify([dataclasses.replace(chirp, source="chirp.csv")], PLANT.changed(m=1.2))
    assert any("chirp.csv" in s and "other known constants" in s for s in result.verdict)


def test_a_scale_that_only_the_parameters_show_is_asked_for(foreign):
    """Without its factor of 30, the input makes the gain 30 times larger and fits as well."""
    wrong = dataclasses.replace(foreign, inputs=foreign.inputs / 30)
    right, found = identify([foreign], PLANT), identify([wrong], PLANT)
    assert found.fit()["pitch"] == pytest.approx(right.fit()["pitch"], abs=0.1)
    factor = found.params.K_pu / PLANT.definition.parameter("K_pu").nominal
    unit = PLANT.definition.parameter("K_pu").unit
    assert found.verdict[0] == (
        f"K_pu = {found.params.K_pu:.4g} {unit} ({factor:.2g} times its nominal value): are units, "
        "scales and sampling time right (--unit, --scale, --dt)?"
    )
    expected = identify([wrong], PLANT, start={"K_pu": 30 * right.params.K_pu})
    for silent in (right, expected):  # what the caller expects is not remarked
        assert not any("nominal value" in s for s in silent.verdict)


@pytest.mark.science
def test_a_record_of_another_plant_is_remarked_first_or_refused(chirp):
    result = identify([chirp], Aero2Detailed())
    assert result.verdict[0].endswith("was made with plant 'aero2', not with 'aero2_detailed'")
    with pytest.raises(ValueError, match="'aero2' and has voltage, pitch; plant 'emps' has force"):
        identify([chirp], "emps")
    with pytest.raises(ValueError, match="'aero2' and has voltage; plant 'emps' has force"):
        simulate("emps", chirp)


def test_a_record_whose_columns_were_mapped_is_of_the_plant_they_were_mapped_to(tmp_path):
    simulate("aero2", "chirp", steps=60).save(tmp_path / "r.csv")
    plant = plant_from("emps")
    mapped = {"force": "voltage", "position": "pitch"}
    record = read_record(tmp_path / "r.csv", plant.description, mapped)
    require_columns(record, plant.description)
    with pytest.raises(ValueError, match="is of plant 'aero2'"):
        require_columns(read_record(tmp_path / "r.csv"), plant.description)


def test_a_failed_estimate_says_what_the_estimator_needs_and_shows_no_fit(chirp):
    result = identify([chirp], PLANT, "decrement")
    assert not result.is_usable
    shown = str(result)
    assert "decrement needs an input that ends at rest, and a free decay after it" in shown
    assert "fit" not in shown
    assert "– to –" not in shown


@pytest.mark.science
def test_a_correlation_needs_two_estimates(chirp):
    held = {"J_p": 0.0232, "D_p": 0.00071}
    assert "correlation" in str(identify([chirp], PLANT))
    assert "correlation" not in str(identify([chirp], PLANT, hold=held))


@pytest.mark.slow
def test_an_input_of_the_wrong_sign_gives_no_usable_result(foreign):
    result = None
    with contextlib.suppress(ValueError):
        result = identify([dataclasses.replace(foreign, inputs=-foreign.inputs)], PLANT)
    assert result is None or not result.is_usable


# Bad input


@pytest.mark.parametrize(
    ("start", "words"),
    [
        ({"J_q": 0.02}, "no parameter 'J_q'; it has J_p, K_pu, D_p"),
        ({"J_p": -0.02}, "J_p = -0.02 kg m² is not allowed; it must be finite, above 0"),
        ({"D_p": float("nan")}, "D_p = nan .* is not allowed"),
        ({"D_p": float("inf")}, "D_p = inf .* is not allowed"),
    ],
)
def test_a_start_that_is_not_allowed_is_refused(start, words, chirp):
    with pytest.raises(ValueError, match=words):
        identify([chirp], PLANT, start=start)


def test_arx_needs_a_plant_with_a_mapping():
    d = DCMotor.definition
    record = Record(0.001 * np.arange(30), np.ones((30, 1)), np.ones((30, len(d.outputs))))
    with pytest.raises(ValueError, match=r"'dc_motor' has no mapping .* use the estimator 'nls'"):
        identify([record], DCMotor(), ARX())


# One compilation, and bounds


class Tank(AbstractPlant):
    """A level that follows an inflow; quick to compile."""

    definition = PlantDescription(
        name="tank",
        states=(State("level", "m"),),
        inputs=(Input("flow", "m³/s", 0.0, 1.0),),
        outputs=(Output("level_m", "m", 1.0, noise_sd=0.001),),
        parameters=(Parameter("area", "m²", 2.0, upper=2.5), Parameter("leak", "m²/s", 0.3)),
        dt=0.5,
        band=(0.01, 0.5),
    )

    def derivative(self, state, input, params):
        return (input - params.leak * state) / params.area

    def output(self, state, params):
        return state


def tank_record(area: float, seed: int = 0) -> Record:
    plant = Tank()
    params = plant.Params(jnp.array(area), jnp.array(0.4))
    return record_of(plant, Random(hold=5), params=params, seed=seed)


@pytest.fixture
def compilations() -> Iterator[list[str]]:
    """Grows with every program that is compiled."""
    names: list[str] = []

    def listen(event: str, duration_secs: float, **_: object) -> None:
        del duration_secs
        if event.endswith("backend_compile_duration"):
            names.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield names
    jax.monitoring.unregister_event_duration_listener(listen)


@pytest.mark.slow
def test_another_start_or_record_compiles_nothing(compilations):
    identify([tank_record(2.2)], Tank())
    record = tank_record(2.1, seed=1)
    count = len(compilations)
    assert count > 0
    for start in ({}, {"area": 1.5}, {"area": 2.4, "leak": 0.2}):
        assert identify([record], Tank(), start=start).status == "successful"
    assert len(compilations) == count


def test_a_parameter_that_ends_at_its_bound_is_held_there_and_named():
    result = identify([tank_record(3.5)], Tank())
    assert result.held == ("area",)
    assert result.params["area"] == pytest.approx(2.5, rel=1e-2)
    assert result.status == "partly identifiable"
    assert "area ended at its bound 2.5 and was held there" in result.verdict


# Other estimators, other noise


def test_arx_goes_the_same_way(chirp):
    quiet = dataclasses.replace(
        chirp,
        outputs=np.asarray(
            record_of(
                PLANT.changed(sensor=dataclasses.replace(PLANT.sensor, noise_sd=jnp.zeros(1))),
                params=TRUE,
            ).outputs
        ),
    )
    result = identify([quiet], PLANT, ARX(start_covariance=1e12))
    assert result.estimator == "arx-rls"
    assert result.status == "successful"
    for name, value in result.params.items():
        assert value == pytest.approx(TRUTH[name], rel=0.05)
    assert result.fit()["pitch"] > 95


def test_arx_that_cannot_say_is_no_usable_result():
    result = identify([free_decay()], PLANT, ARX())
    assert not result.is_usable
    assert result.status == "ill conditioned"
    assert result.verdict == ("the data do not determine all parameters",)
    json.dumps(json_ready(result.to_dict()), allow_nan=False)


def test_coloured_noise_is_said_and_widens_the_intervals(foreign):
    usual = identify([foreign], PLANT)
    noise = 2e-3 * autoregressive(np.random.default_rng(4), (1, NUM_STEPS + 1), 0.9).T
    result = identify([dataclasses.replace(foreign, outputs=foreign.outputs + noise)], PLANT)
    assert result.whiteness["pitch"] < 0.01
    assert "the residual of pitch is not white: the intervals allow for" in "".join(result.verdict)
    assert_within_sd(result, TRUTH)
    ratio = {n: result.std_error[n] / usual.std_error[n] for n in TRUTH}
    size = np.std(noise) / 2e-4
    assert max(ratio.values()) > 1.5 * size  # more than the noise's size explains


# What is shown and left on disk


def test_the_dictionary_has_the_keys_that_are_documented(result, decay):
    for r in (result, decay):
        d = r.to_dict()
        assert set(d) == documented("identify")
        assert set(d) >= {"plant", "estimator", "status", "params", "fit_percent", "validation"}
        assert list(d["params"]) == ["J_p", "K_pu", "D_p"]
        for p in d["params"].values():
            assert set(p) == {
                "estimate", "std_error", "ci95", "unit", "relative_to_nominal", "held",
            }  # fmt: skip


def test_the_dictionary_says_what_the_result_says(result):
    d = json_ready(result.to_dict())
    assert (d["plant"], d["estimator"], d["status"]) == ("aero2", "nls", "successful")
    for name, entry in d["params"].items():
        assert entry["estimate"] == result.params[name]
        assert entry["std_error"] == result.std_error[name]
        assert entry["ci95"] == list(result.ci95(name))
        nominal = getattr(PLANT.nominal, name)
        assert entry["relative_to_nominal"] == pytest.approx(result.params[name] / float(nominal))
    assert d["params"]["D_p"]["unit"] == "N m s/rad"
    assert d["fit_percent"] == {"pitch": result.fit()["pitch"]}
    residual = np.concatenate([f.record.outputs - f.simulated for f in result.fitted])
    assert d["residual"]["pitch"]["sum_of_squares"] == pytest.approx(np.vdot(residual, residual))
    assert d["residual"]["pitch"]["rms"] == pytest.approx(np.std(residual), rel=0.01)
    assert d["residual"]["pitch"]["unit"] == "rad"
    held_out = result.validation[0]
    assert d["validation"] == [
        {
            "file": "foreign.csv",
            "fit_percent": {"pitch": held_out.fit_percent["pitch"]},
            "initial_state": held_out.initial_state,
        }
    ]
    correlation = np.array(d["correlation"])
    np.testing.assert_allclose(np.diag(correlation), 1)
    np.testing.assert_allclose(correlation, correlation.T)
    assert np.all(np.abs(correlation) < 1 + 1e-12)


def columns_of(path: Path) -> np.ndarray:
    return np.loadtxt(path, delimiter=",", skiprows=1)


def test_a_run_folder_holds_what_was_found(result, chirp, tmp_path):
    result.save(tmp_path / "run")
    folder = tmp_path / "run"
    assert {f.name for f in folder.iterdir()} == {
        "record.csv", "record.json", "simulated.csv", "residual.csv", "estimate.json",
        "information.json", "run.json",
    }  # fmt: skip
    record = read_record(folder / "record.csv", result.plant)
    for name in ("time", "inputs", "outputs"):
        np.testing.assert_array_equal(getattr(record, name), getattr(chirp, name))
    assert record.starts_at_initial_state
    simulated, residual = columns_of(folder / "simulated.csv"), columns_of(folder / "residual.csv")
    np.testing.assert_array_equal(simulated[:, 0], chirp.time)
    np.testing.assert_array_equal(simulated[:, 1:], result.fitted[0].simulated)
    np.testing.assert_array_equal(residual[:, 1:], chirp.outputs - result.fitted[0].simulated)
    assert (folder / "residual.csv").read_text().startswith("time,pitch\n")
    assert json.loads((folder / "estimate.json").read_text()) == json_ready(result.to_dict())
    information = json.loads((folder / "information.json").read_text())
    assert information["parameters"] == ["J_p", "K_pu", "D_p"]
    np.testing.assert_array_equal(information["information"], result.information)
    np.testing.assert_array_equal(information["covariance"], result.covariance)
    run = json.loads((folder / "run.json").read_text())
    assert PlantDescription.from_dict(run["plant"]) == result.plant


@pytest.mark.slow
def test_a_run_folder_of_several_records_numbers_them(foreign, tmp_path):
    result = identify([free_decay(), foreign], PLANT)
    result.save(tmp_path / "run")
    for i, f in enumerate(result.fitted, 1):
        record = read_record(tmp_path / "run" / f"record_{i}.csv", result.plant)
        np.testing.assert_array_equal(record.outputs, f.record.outputs)
        np.testing.assert_array_equal(
            columns_of(tmp_path / "run" / f"simulated_{i}.csv")[:, 1:], f.simulated
        )


def test_a_run_folder_is_identified_to_the_same_result(result, tmp_path):
    result.save(tmp_path / "run")
    again = identify([read_record(tmp_path / "run" / "record.csv", PLANT.description)], PLANT)
    assert again.params == result.params


def test_covariance_and_information_belong_together(result):
    """In search coordinates (logarithms) one is the inverse of the other."""
    size = np.array(list(result.params.values()))
    relative = result.covariance / np.outer(size, size)
    np.testing.assert_allclose(relative @ result.information, np.eye(3), atol=1e-6)


# Real data


PUBLISHED_FIT = {"M": 96.04, "F_v": 218.0, "F_c": 19.05, "offset": -3.275}


@pytest.fixture(scope="module")
def emps_record() -> Record:
    """The public EMPS record, where the data are present."""
    path = recording("DATA_EMPS.mat")
    if path is None:
        pytest.skip("DATA_EMPS.mat is not here; EXCITE_DATA names the folder that has it")
    gain = float(scipy.io.loadmat(path)["gtau"].item())
    columns = {"time": "t", "force": "vir", "position": "qm"}
    return read_record(path, EMPS.definition, columns, {"force": gain})


@pytest.mark.science
@pytest.mark.parametrize(
    "signs", [(1, -1, 1, -1), (1, 1, 1, 1)], ids=["alternating", "all too large"]
)
def test_emps_is_identified_from_starts_that_are_30_percent_off(signs, emps_record):
    plant = EMPS()
    nominal = plant.nominal._asdict()
    start = {n: (1 + 0.3 * s) * float(v) for (n, v), s in zip(nominal.items(), signs, strict=True)}
    result = identify([emps_record], plant, start=start)
    assert result.status == "successful"
    assert not result.initial_state_known
    assert result.fit()["position"] >= 97.0
    for name, value in PUBLISHED_FIT.items():
        assert result.params[name] == pytest.approx(value, rel=5e-3)
    assert any("not white" in sentence for sentence in result.verdict)
    low, high = result.ci95("M")
    assert low < 95.1089 < high  # the value published with the data


def test_white_noise_far_above_the_declared_one_is_in_doubt():
    """A search that missed the plant may leave a residual that looks white."""
    record = ex.simulate("aero2", "prbs", noise={"pitch": 0.004}, seed=2)
    result = ex.identify(record, "aero2")
    assert result.whiteness["pitch"] > 0.01
    assert len(result.starts) == 8
    assert "times its declared noise" in " ".join(result.verdict)
    assert not result.suspects


def test_ends_without_variances_are_compared_silently():
    """A page that identified a hopeless record ended with a warning of NumPy."""
    record = ex.simulate("aero2", "prbs", steps=100)
    basis = ex.identify(record, "aero2").basis
    assert basis is not None
    end = jax.device_put(basis.estimate)
    lost = dataclasses.replace(end, covariance=-end.covariance)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not is_elsewhere(end, end)
        assert not is_elsewhere(end, lost)


def test_an_end_near_the_estimate_is_no_other_one():
    """With a cost that is larger by a twentieth of the noise, it was said to be elsewhere."""
    record = ex.simulate("aero2", "prbs", noise={"pitch": 0.004}, seed=2)
    basis = ex.identify(record, "aero2").basis
    assert basis is not None
    best = basis.estimate
    noise, error = best.cost / best.residual.size, np.sqrt(np.diag(best.covariance))
    here = jax.device_put(best)

    def ended(more: float, errors: float) -> str:
        params = type(best.params)(*map(jnp.asarray, np.stack(best.params) + errors * error))
        end = dataclasses.replace(here, params=params, cost=jnp.asarray(best.cost + more * noise))
        free = np.ones(len(error), bool)
        return agreement(Fit(best, free, ~free, {}, [end]))[0]

    told = "1 of 2 starts of the search ended at this estimate"
    assert ended(0.05, 0.2) == told
    assert ended(0.05, 50.0).startswith(f"{told}; another ended at J_p=")
    assert ended(50.0, 50.0) == told
    assert ended(0.0, 0.0).startswith("2 of 2 starts")


@pytest.mark.parametrize("initial_state", ["known", "free"])
def test_a_search_with_room_for_more_records_finds_the_same(initial_state):
    records = [ex.simulate("aero2", "prbs", steps=30 + i, seed=i) for i in range(2)]
    own, roomy = (
        ex.identify(records, "aero2", initial_state=initial_state, room=room)
        for room in ((0, 0), (4, 50))
    )
    for name in ("J_p", "K_pu", "D_p"):
        assert roomy.params[name] == pytest.approx(own.params[name], rel=1e-5)
        assert roomy.std_error[name] == pytest.approx(own.std_error[name], rel=1e-4)
        assert roomy.ci95(name) == pytest.approx(own.ci95(name), rel=1e-4)
    assert [f.simulated.shape for f in roomy.fitted] == [f.simulated.shape for f in own.fitted]


@pytest.mark.parametrize(
    ("room", "error", "words"),
    [
        (5, TypeError, "room"),
        ((1, 2, 3), TypeError, "room"),
        ((-1, 2), ValueError, "room must be a whole number"),
    ],
)
def test_a_room_that_is_no_pair_of_numbers_is_one_sentence(room, error, words):
    with pytest.raises(error, match=words):
        ex.identify(ex.simulate("aero2", "prbs", steps=30), room=room)
