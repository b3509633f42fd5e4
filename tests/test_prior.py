"""What is known beforehand, and noise with outliers, in least squares."""

import dataclasses
import json
import pickle
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats
from commands import excite

from excite.description import Input, Output, Parameter, PlantDescription, State
from excite.estimation import NLS, Prior, stack_experiments
from excite.estimation.diagnosis import half_95
from excite.estimation.identify import identify
from excite.estimation.prior_knowledge import plants_of
from excite.files import json_ready
from excite.plant import AbstractPlant, Aero2
from excite.record import Record, write_record

SD = 0.1


class Ramp(AbstractPlant):
    """x' = a u + b, measured directly: linear in both parameters."""

    definition = PlantDescription(
        name="ramp",
        states=(State("x", "m"),),
        inputs=(Input("u", "V", -1.0, 1.0),),
        outputs=(Output("y", "m", scale=1.0, noise_sd=SD),),
        parameters=(
            Parameter("a", "m/(V s)", 1.0, positive=False),
            Parameter("b", "m/s", 0.2, positive=False),
        ),
        dt=0.1,
    )

    def derivative(self, state, input, params):
        return params.a * input + params.b

    def output(self, state, params):
        return state


TIME = 0.1 * np.arange(41)
INPUT = np.sin(TIME)[:, None]
COLUMNS = np.stack([np.append(0.0, 0.1 * np.cumsum(INPUT[:-1, 0])), TIME], axis=1)
TRUTH = np.array([0.8, 0.3])
STARTS = {"starts_at_initial_state": True, "plant": json_ready(Ramp.definition.to_dict())}


def record_with(noise: np.ndarray, source: str = "ramp.csv") -> Record:
    """The ramp, measured with this noise."""
    outputs = (COLUMNS @ TRUTH + noise)[:, None]
    return Record(time=TIME, inputs=INPUT, outputs=outputs, metadata=STARTS, source=source)


def noisy(seed: int = 0) -> Record:
    return record_with(SD * np.random.default_rng(seed).normal(size=len(TIME)))


MEAN = np.array([1.1, 0.1])
COVARIANCE = np.array([[0.01, 0.004], [0.004, 0.005]])


def test_with_known_noise_it_is_the_posterior_of_a_linear_regression():
    record = noisy()
    information = COLUMNS.T @ COLUMNS / SD**2 + np.linalg.inv(COVARIANCE)
    weighted = COLUMNS.T @ record.outputs[:, 0] / SD**2 + np.linalg.solve(COVARIANCE, MEAN)
    expected = np.linalg.solve(information, weighted)
    estimator = NLS(noise="known", prior=Prior.normal(["a", "b"], MEAN, COVARIANCE))
    found = identify(record, Ramp, estimator)
    np.testing.assert_allclose(list(found.params.values()), expected, rtol=1e-6)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(information), rtol=1e-6)


@pytest.mark.science
def test_the_estimate_of_other_records_is_a_prior_for_these(tmp_path):
    first, second = noisy(1), noisy(2)
    both = identify([first, second], Ramp)
    before = identify(first, Ramp)
    write_record(tmp_path / "first.csv", first, Ramp.definition)
    (tmp_path / "plants.py").write_text(
        "from test_prior import Ramp as Own\n\n\nclass Ramp(Own):\n    pass\n"
    )
    done = excite(
        "identify", tmp_path / "first.csv", "--plant", f"{tmp_path}/plants.py:Ramp",
        "--out", tmp_path / "run",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for prior in (before, tmp_path / "run"):
        found = identify(second, Ramp, prior=prior)
        for name in ("a", "b"):
            # The size of the noise is estimated from one record or from both.
            distance = abs(found.params[name] - both.params[name])
            assert distance < 0.3 * both.std_error[name]
            assert found.std_error[name] == pytest.approx(both.std_error[name], rel=0.15)


def test_parameters_change_by_their_standard_deviations_and_known_ones_do_not():
    plant, nominal = Aero2(), {n: float(v) for n, v in Aero2().nominal._asdict().items()}
    prior = plants_of(plant, {"J_p": "lognormal:0.02:10%", "D_p": "uniform:0.001:0.004"})
    changes = np.asarray(prior.changes(plant.nominal))
    at = {name: i for i, name in enumerate(plant.nominal._fields)}
    expected = np.zeros((3, 3))
    log_sd = np.sqrt(np.log1p(0.1**2))
    expected[at["J_p"], at["J_p"]] = changes[at["J_p"], at["J_p"]]
    assert changes[at["J_p"], at["J_p"]] == pytest.approx(log_sd * nominal["J_p"], rel=0.01)
    expected[at["D_p"], at["D_p"]] = 0.003 / np.sqrt(12)
    np.testing.assert_allclose(changes, expected, rtol=1e-9)


@pytest.mark.slow
def test_a_prior_holds_what_the_data_do_not_tell_and_says_so():
    still = dataclasses.replace(noisy(), inputs=0 * INPUT)
    without = identify(still, Ramp)
    assert without.held == ("a",)
    found = identify(still, Ramp, prior={"a": "normal:0.9:0.05"})
    assert found.held == ()
    assert found.params.a == pytest.approx(0.9)
    assert found.std_error.a == pytest.approx(0.05, rel=1e-3)
    assert "the estimate of a is that of its prior; the data hardly change it" in found.verdict


@pytest.mark.slow
def test_data_that_contradict_a_prior_are_remarked():
    found = identify(noisy(), Ramp, prior={"b": "normal:0.5:0.01"})
    assert "the data contradict the prior of b" in found.verdict
    assert not found.suspects  # it is the prior, not the plant
    agreed = identify(noisy(), Ramp, prior={"b": "normal:0.3:0.1"})
    assert not any("prior" in sentence for sentence in agreed.verdict)


@pytest.mark.slow
def test_a_held_parameter_takes_its_joint_prior_as_a_condition():
    """As profile and standard intervals agree only then, and it contradicts nothing."""
    joint = Prior.normal(["a", "b"], [0.9, 0.6], [[0.01, 0.0095], [0.0095, 0.01]])
    estimator = NLS(noise="known", prior=joint)
    options = {"hold": {"b": 0.3}, "initial_state": "known"}
    linear = identify(noisy(), Ramp, estimator, **options)
    profile = identify(noisy(), Ramp, estimator, intervals="profile", **options)
    np.testing.assert_allclose(profile.ci95("a"), linear.ci95("a"), rtol=1e-3)
    information = COLUMNS[:, 0] @ COLUMNS[:, 0] / SD**2 + np.linalg.inv(joint_covariance())[0, 0]
    assert linear.std_error.a == pytest.approx(information**-0.5, rel=1e-6)
    assert not any("prior of b" in sentence for sentence in linear.verdict)


def joint_covariance() -> np.ndarray:
    return np.array([[0.01, 0.0095], [0.0095, 0.01]])


def test_the_search_begins_at_the_mean_of_a_prior():
    still = dataclasses.replace(noisy(), inputs=0 * INPUT)
    told = identify(still, Ramp, prior={"a": "normal:7:1e9"})
    assert told.held == ("a",)
    assert told.params.a == pytest.approx(7.0)


@pytest.mark.science
def test_the_only_parameter_may_end_at_its_bound():
    with pytest.raises(ValueError, match="no parameter is left to estimate: b ended at its bound"):
        identify(noisy(), Ramp, hold={"a": 0.8}, prior={"b": "uniform:0.1:0.25"})


@pytest.mark.science
def test_a_uniform_prior_bounds_the_estimate():
    found = identify(noisy(), Ramp, prior={"b": "uniform:0.1:0.25"})
    assert found.params.b == pytest.approx(0.25, rel=1e-3)
    assert any("b ended at its bound 0.25" in sentence for sentence in found.verdict)
    wide, free = identify(noisy(), Ramp, prior={"b": "uniform:-5:5"}), identify(noisy(), Ramp)
    assert wide.params.b == pytest.approx(free.params.b, rel=1e-5)
    assert found.plant == wide.plant == free.plant


def test_with_known_noise_a_normal_prior_counts_as_a_value():
    few, known = record_cut(noisy(), 2), NLS(noise="known")
    prior = {"a": "normal:0.9:0.05", "b": "normal:0.25:0.1"}
    found = identify(few, Ramp, known, prior=prior)
    precision = COLUMNS[:2].T @ COLUMNS[:2] / SD**2 + np.diag([0.05**-2, 0.1**-2])
    told = COLUMNS[:2].T @ few.outputs[:, 0] / SD**2 + np.array([0.9 / 0.05**2, 0.25 / 0.1**2])
    expected = np.linalg.solve(precision, told)
    np.testing.assert_allclose(list(found.params.values()), expected, rtol=1e-6)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(precision), rtol=1e-6)
    for estimator, own in ((known, {"b": "uniform:0:1"}), ("nls", prior)):
        with pytest.raises(ValueError, match=r"2 measured values for 2 unknowns .*noise='known'"):
            identify(few, Ramp, estimator, prior=own)
    one = dataclasses.replace(few, outputs=np.array([[np.nan], [np.nan]]))
    with pytest.raises(ValueError, match="0 measured values and 2 priors for 2 unknowns"):
        identify(one, Ramp, known, prior=prior)


def test_records_of_two_samples_are_enough_together():
    """One alone has as many values as there are parameters, and would be fitted by chance."""
    few = record_cut(record_with(0 * TIME), 2)
    inputs = [np.full((2, 1), value) for value in (1.0, -1.0, 0.5)]
    outputs = [np.array([[0.0], 0.1 * (TRUTH[0] * u[0] + TRUTH[1])]) for u in inputs]
    pairs = zip(inputs, outputs, strict=True)
    records = [dataclasses.replace(few, inputs=u, outputs=y) for u, y in pairs]
    np.testing.assert_allclose(list(identify(records, Ramp).params.values()), TRUTH, rtol=1e-6)


@pytest.mark.slow
def test_an_interval_does_not_leave_a_uniform_prior():
    free = identify(noisy(), Ramp)
    (low, high), center = free.ci95("b"), free.params.b
    bound = (center + high) / 2
    found = identify(noisy(), Ramp, prior={"b": f"uniform:-1:{bound!r}"})
    assert found.held == ()
    np.testing.assert_allclose(found.ci95("b"), (low, bound), rtol=1e-4)
    np.testing.assert_allclose(found.ci95("a"), free.ci95("a"), rtol=1e-4)
    assert found.std_error.b == pytest.approx(free.std_error.b, rel=1e-3)


@pytest.mark.science
def test_the_profile_of_a_linear_plant_with_a_prior_is_its_interval():
    prior = {"a": "normal:0.9:0.05", "b": "normal:0.25:10%"}
    linear, profile = (
        identify(noisy(), Ramp, prior=prior, intervals=kind) for kind in ("linear", "profile")
    )
    for name in ("a", "b"):
        np.testing.assert_allclose(profile.ci95(name), linear.ci95(name), rtol=2e-3)


def test_a_lognormal_prior_is_one_of_the_logarithm():
    class Positive(Ramp):
        definition = dataclasses.replace(
            Ramp.definition,
            parameters=tuple(
                dataclasses.replace(p, positive=True) for p in Ramp.definition.parameters
            ),
        )

    record, center, spread = noisy(), 0.5, 0.1

    def cost(params: np.ndarray) -> float:
        misfit = (record.outputs[:, 0] - COLUMNS @ params) / SD
        return float(misfit @ misfit + (np.log(params[1] / center) / spread) ** 2)

    expected = scipy.optimize.minimize(cost, TRUTH, method="Nelder-Mead", tol=1e-10).x
    prior = Prior.normal(["b"], [np.log(center)], [[spread**2]], [True])
    found = identify(record, Positive, NLS(noise="known", prior=prior))
    np.testing.assert_allclose(list(found.params.values()), expected, rtol=1e-4)
    same = identify(record, Positive, NLS(noise="known"), prior={"b": "lognormal:0.5:10%"})
    np.testing.assert_allclose(list(same.params.values()), expected, rtol=1e-4)


@pytest.mark.parametrize(
    ("prior", "sentence"),
    [
        ({"c": "normal:1:2"}, "unknown ramp parameter 'c'"),
        ({"a": "normal:1"}, "prior of 'a' must be normal:MEAN:SD"),
        ({"a": "normal:1:0"}, "got 'normal:1:0'"),
        ({"a": "normal:nan:1"}, "got 'normal:nan:1'"),
        ({"a": "cauchy:0:1"}, "got 'cauchy:0:1'"),
        ({"a": "3"}, "got '3'"),
        ({"a": "uniform:2:1"}, "got 'uniform:2:1'"),
        ({"a": "lognormal:1:0.1"}, "'a' may be negative and has no lognormal prior"),
        ({"a": "uniform:2:3"}, "begins at a = 1 m/(V s), outside its uniform prior 2 to 3"),
        ([{"a": "normal:1:2"}, {"a": "uniform:0:2"}], "parameter 'a' has two priors; give one"),
        ([{"a": "normal:1:2"}, {"a": "normal:1:2"}], "parameter 'a' has two priors; give one"),
        ([{"a": "uniform:0:2"}, {"a": "uniform:0:3"}], "parameter 'a' has two priors; give one"),
        ("nowhere", "'nowhere' is no run folder and no file; it may be a dict by parameter"),
        (Prior.normal(["c"], [1.0], [[1.0]]), "unknown ramp parameter 'c'"),
    ],
)  # fmt: skip
def test_a_prior_that_is_none_is_refused(prior, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        identify(noisy(), Ramp, prior=prior)


@pytest.mark.parametrize(
    ("covariance", "sentence"),
    [
        ([[1.0, 2.0], [2.0, 1.0]], "is not positive definite"),
        ([[1.0, 0.0], [0.0, 0.0]], "symmetric with variances above 0"),
        ([[1.0, 0.5], [0.1, 1.0]], "symmetric with variances above 0"),
        ([[1.0]], "needs 2 numbers and 2 x 2 covariances"),
    ],
)
def test_a_covariance_that_is_none_is_refused(covariance, sentence, tmp_path):
    with pytest.raises(ValueError, match=sentence):
        Prior.normal(["a", "b"], [1.0, 2.0], covariance)
    path = tmp_path / "prior.json"
    path.write_text(json.dumps({"mean": {"a": 1.0, "b": 2.0}, "covariance": covariance}))
    with pytest.raises(ValueError, match=f"prior.json: .*{sentence}"):
        identify(noisy(), Ramp, prior=path)


def test_other_estimators_take_no_prior():
    with pytest.raises(ValueError, match="a prior needs the estimator nls: got pem"):
        identify(noisy(), Ramp, "pem", prior={"a": "normal:1:1"})
    with pytest.raises(ValueError, match="a prior needs the estimator nls: got pem"):
        identify(noisy(), Ramp, "pem", prior={"a": "uniform:0:2"})
    own = NLS(prior=Prior.normal(["a"], [1.0], [[1.0]]))
    with pytest.raises(ValueError, match="the estimator has a prior already"):
        identify(noisy(), Ramp, own, prior={"a": "normal:1:1"})
    with pytest.raises(ValueError, match="'a' is held and needs no prior"):
        identify(noisy(), Ramp, hold={"a": 1.0}, prior={"a": "normal:1:1"})


# Outliers


def with_outliers(seed: int) -> Record:
    """A tenth of the samples is far off."""
    rng = np.random.default_rng(seed)
    noise = SD * rng.normal(size=len(TIME))
    return record_with(noise + 5.0 * (rng.random(len(TIME)) < 0.1))


@pytest.mark.science
def test_students_estimate_is_the_likeliest_one():
    record = with_outliers(3)

    def cost(unknowns: np.ndarray) -> float:
        misfit = record.outputs[:, 0] - COLUMNS @ unknowns[:2]
        return -float(np.sum(scipy.stats.t.logpdf(misfit, 4, scale=np.exp(unknowns[2]))))

    expected = scipy.optimize.minimize(
        cost, [*TRUTH, np.log(SD)], method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-10}
    ).x
    found = identify(record, Ramp, likelihood="student")
    for name, value in zip(("a", "b"), expected, strict=False):
        # The scale that is estimated allows for the number of unknowns.
        assert abs(found.params[name] - value) < 0.03 * found.std_error[name]
    least_squares = identify(record, Ramp)
    assert least_squares.std_error.b > 2 * found.std_error.b
    assert any("--likelihood student" in sentence for sentence in least_squares.verdict)
    assert not any("cause" in sentence for sentence in found.verdict)


@pytest.mark.science
def test_students_intervals_hold_with_outliers():
    records = [with_outliers(seed).outputs for seed in range(400)]
    plant = Ramp()
    data = [stack_experiments(plant, [INPUT[:-1]], [y], True) for y in records]
    stacked = jax.tree.map(lambda *parts: jnp.stack(parts), *data)
    estimate = jax.vmap(lambda e: NLS(likelihood="student")(plant, e))(stacked)
    degrees = np.asarray(estimate.degrees)
    half = [half_95(np.asarray(c), n) for c, n in zip(estimate.covariance, degrees, strict=True)]
    inside = np.abs(np.stack(estimate.params, axis=1) - TRUTH) < np.array(half)
    assert np.all(np.abs(inside.mean(axis=0) - 0.95) < 0.035)


def test_other_estimators_have_one_likelihood():
    with pytest.raises(ValueError, match="likelihood student needs the estimator nls: got pem"):
        identify(noisy(), Ramp, "pem", likelihood="student")


# The declared noise, and held-out records


class Quiet(Ramp):
    definition = dataclasses.replace(
        Ramp.definition, outputs=(Output("y", "m", scale=1.0, noise_sd=0.05 * SD),)
    )


def test_a_residual_far_above_the_declared_noise_is_remarked():
    (sentence,) = [s for s in identify(noisy(), Quiet).verdict if "declared noise" in s]
    assert "the residual of y is" in sentence
    assert not any("declared noise" in s for s in identify(noisy(), Ramp).verdict)


def shifted(offset: float) -> Record:
    """A held-out record that starts elsewhere; nothing tells where."""
    record = noisy(7)
    return dataclasses.replace(
        record, outputs=record.outputs + offset, metadata={}, source="held-out.csv"
    )


@pytest.mark.parametrize(
    ("state", "words", "error"),
    [
        ("auto", "initial state from the first measurements", None),
        ("first", "initial state from the first measurements", None),
        ("known", "known initial state", 2.0),
        ("25%", "initial state estimated from the first 25 %, which do not count", 0.0),
        (1.0, "initial state estimated from the whole record", 0.0),
    ],
)
def test_the_initial_state_of_a_held_out_record_is_found_as_asked(state, words, error):
    other = shifted(2.0)
    found = identify(noisy(), Ramp, validate=other, validate_state=state).validation[0]
    first, _, more = found.initial_state.partition(" (")
    assert first == words
    if state == 1.0:
        with_share = identify(noisy(), Ramp, validate=other, validate_state=0.1).validation[0]
        fit = f"{with_share.fit_percent['y']:.4g}"
        assert more == f"from its first 10 %, the rest fits {fit} %)"
    if error is None:  # the first sample's noise remains
        assert found.simulated[0] == pytest.approx(other.outputs[0])
    else:
        off = float(np.mean(other.outputs - found.simulated))
        assert off == pytest.approx(error, abs=3 * SD / np.sqrt(10))


def test_samples_that_the_initial_state_is_estimated_from_do_not_count():
    other = shifted(2.0)
    spoilt = other.outputs.copy()
    spoilt[30:] += 50.0
    bad = dataclasses.replace(other, outputs=spoilt)
    found = identify(noisy(), Ramp, validate=bad, validate_state=0.5).validation[0]
    late = slice(21, None)  # 41 samples, of which the first 21 begin it
    left = bad.outputs[late] - found.simulated[late]
    spread = bad.outputs[late] - bad.outputs[late].mean()
    expected = 100 * (1 - np.linalg.norm(left) / np.linalg.norm(spread))
    assert found.fit_percent["y"] == pytest.approx(expected)


def test_a_share_that_leaves_nothing_to_compare_is_refused():
    with pytest.raises(ValueError, match="too little is left to compare; give a smaller share"):
        identify(noisy(), Ramp, validate=shifted(0.0), validate_state="99%")


def test_a_record_too_short_for_a_share_reports_the_fit_of_all_of_it():
    few = record_cut(shifted(2.0), 3)
    few.outputs[0] = np.nan  # so that nothing but the rest tells the initial state
    found = identify(noisy(), Ramp, validate=few).validation[0]
    assert found.initial_state == "initial state estimated from the whole record"
    assert np.nanmean(few.outputs - found.simulated) == pytest.approx(0.0, abs=1e-6)


def record_cut(record: Record, count: int) -> Record:
    """The first samples."""
    return dataclasses.replace(
        record,
        time=record.time[:count],
        inputs=record.inputs[:count],
        outputs=record.outputs[:count].copy(),
    )


@pytest.mark.parametrize("state", ["0", "101%", "nan", "middle", 0.0, True])
def test_a_share_that_is_none_is_refused(state):
    with pytest.raises(ValueError, match="validate_state must be auto, known, first or a share"):
        identify(noisy(), Ramp, validate_state=state)
    with pytest.raises(ValueError, match="validate_state must be auto, known, first or a share"):
        identify(noisy(), Ramp, validate=shifted(0.0), validate_state=state)


def test_held_out_data_may_be_in_other_columns_of_the_same_file(tmp_path):
    (one, other), path = (noisy(), noisy(7)), tmp_path / "both.csv"
    cells = [TIME, one.inputs[:, 0], one.outputs[:, 0], other.inputs[:, 0], other.outputs[:, 0]]
    names = "time,u,yEst,uVal,yVal"
    np.savetxt(path, np.transpose(cells), delimiter=",", header=names, comments="")
    given = {"columns": {"y": "yEst"}, "validate": path}
    found = identify(path, Ramp, validate_columns={"u": "uVal", "y": "yVal"}, **given)
    np.testing.assert_array_equal(found.validation[0].record.outputs, other.outputs)
    np.testing.assert_array_equal(found.validation[0].record.inputs, other.inputs)
    np.testing.assert_array_equal(found.fitted[0].record.outputs, one.outputs)
    assert not any("there is" in s or "is also" in s for s in found.verdict)
    part = identify(path, Ramp, validate_columns={"u": "uVal"}, **given)  # y is that of `columns`
    np.testing.assert_array_equal(part.validation[0].record.outputs, one.outputs)
    (tmp_path / "plants.py").write_text("from test_prior import Ramp as Own\nclass Ramp(Own): pass")
    done = excite(
        "identify", path, "--plant", f"{tmp_path}/plants.py:Ramp", "--column", "y=yEst",
        "--validate", path, "--validate-column", "u=uVal,y=yVal", "--json",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)["validation"][0]
    assert told["fit_percent"]["y"] == pytest.approx(found.validation[0].fit_percent["y"])


def test_columns_of_held_out_records_need_one():
    with pytest.raises(ValueError, match=r"validate_columns need a held-out record \(--validate\)"):
        identify(noisy(), Ramp, validate_columns={"u": "uVal"})


@pytest.mark.science
def test_a_record_that_is_there_twice_is_remarked():
    one, late = noisy(), dataclasses.replace(noisy(), time=TIME + 100.0, source="copy.csv")
    sentence = "is also a record of the estimation: its fit says nothing about new data"
    found = identify([one, noisy(1)], Ramp, validate=[noisy(7), late])
    assert [s for s in found.verdict if "also" in s] == [f"copy.csv {sentence}"]
    twice = identify([one, late, one], Ramp).verdict
    ends = "is there twice: it counts double, which narrows intervals"
    assert [s for s in twice if "twice" in s] == [
        f"copy.csv (the same data as ramp.csv) {ends}", f"ramp.csv {ends}"
    ]  # fmt: skip
    held_out = identify(one, Ramp, validate=[noisy(7), noisy(7)]).verdict
    assert not any("twice" in s or "also" in s for s in held_out)


def test_a_result_can_be_pickled():
    result = identify(noisy(), Ramp)
    again = pickle.loads(pickle.dumps(result))
    assert str(again) == str(result)
    with pytest.raises(ValueError, match="a result that was loaded has no posterior"):
        again.posterior()


@pytest.mark.science
def test_a_prediction_error_search_does_not_claim_a_share_that_it_does_not_know():
    told = []
    identify(noisy(), Ramp, "pem", progress=lambda *step: told.append(step))
    text, done, total = told[-1]
    assert (text, total) == ("prediction error", 1.0)
    assert np.isnan(done)


def test_stages_are_told_in_order():
    told = []
    identify(
        with_outliers(1),
        Ramp,
        intervals="profile",
        progress=lambda text, done, total: told.append((text, done / total)),
    )
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert 0 <= shares[0] < shares[-1] < 1
    text = " ".join(text for text, _ in told)
    for stage in (
        "reading",
        "first search",
        "start 8 of 8",
        "steps",
        "likely causes",
        "profile of b",
    ):
        assert stage in text
