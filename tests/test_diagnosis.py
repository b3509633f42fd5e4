import numpy as np
import pytest
import scipy.stats
from experiments import autoregressive

from excite.estimation.diagnosis import (
    Autoregression,
    chance_of_fit,
    coloured_noise,
    correlation,
    fit_percent,
    innovations,
    input_dependence,
    ljung_box,
    mean_or_trend,
    misfit_factor,
    robust_covariance,
    widened,
)
from excite.information.identifiability import UNSEEN_SD, identifiability, worst_seen

# Fit


Y = np.sin(np.arange(40.0)) + 0.3


def test_fit_is_100_for_equality_and_0_for_the_mean():
    assert fit_percent(Y, Y) == 100
    assert fit_percent(Y, np.full_like(Y, Y.mean())) == pytest.approx(0, abs=1e-12)
    assert fit_percent(Y, 3 * Y) < 0


@pytest.mark.parametrize(("gain", "offset"), [(2.5, 0.0), (-1.0, 4.0), (1e-6, -3e-6)])
def test_fit_does_not_depend_on_unit_or_origin(gain, offset):
    model = Y + 0.1 * np.cos(3 * Y)
    expected = fit_percent(Y, model)
    assert 0 < expected < 100
    assert fit_percent(gain * Y + offset, gain * model + offset) == pytest.approx(expected)


def test_fit_falls_in_proportion_to_the_misfit():
    misfit = np.cos(7 * Y)
    lost = [100 - fit_percent(Y, Y + size * misfit) for size in (0.01, 0.02, 0.04)]
    np.testing.assert_allclose(lost, lost[0] * np.array([1, 2, 4]))


def test_fit_of_an_output_that_never_moves_is_no_number():
    assert np.isnan(fit_percent(np.ones(10), np.zeros(10)))


# Whiteness


@pytest.mark.parametrize(("n", "num_lags"), [(300, 25), (60, 25), (500, 5)])
def test_ljung_box_is_the_published_formula(n, num_lags):
    e = np.random.default_rng(n).normal(size=n) + 0.2
    lags = min(num_lags, n // 5)
    centred = e - e.mean()
    r = np.correlate(centred, centred, "full")[n - 1 :] / np.sum(centred**2)
    Q = n * (n + 2) * sum(r[k] ** 2 / (n - k) for k in range(1, lags + 1))
    assert ljung_box(e, num_lags=num_lags) == pytest.approx(scipy.stats.chi2.sf(Q, lags), rel=1e-9)


def test_ljung_box_of_white_noise_is_uniform():
    noise = np.random.default_rng(1).normal(size=(400, 500))
    p = np.array([ljung_box(e) for e in noise])
    assert scipy.stats.kstest(p, "uniform").pvalue > 0.01
    assert scipy.stats.binomtest(int(np.sum(p < 0.05)), p.size, 0.05).pvalue > 0.01


def test_a_mean_or_a_trend_below_the_noise_is_seen_and_white_noise_has_none():
    noise = np.random.default_rng(6).normal(size=(400, 500))
    p = np.array([mean_or_trend(e) for e in noise])
    assert scipy.stats.kstest(p, "uniform").pvalue > 0.01
    assert max(mean_or_trend(e + 0.3) for e in noise[:20]) < 0.01
    assert max(mean_or_trend(e + np.linspace(-0.6, 0.6, 500)) for e in noise[:20]) < 0.01
    assert np.median([ljung_box(e + 0.3) for e in noise[:20]]) > 0.01
    parts = np.split(noise[0] + 0.3, 5)  # the evidence of several records adds up
    assert mean_or_trend(*parts) < min(map(mean_or_trend, parts))
    assert np.isnan(mean_or_trend(np.zeros(500)))


def test_ljung_box_rejects_noise_that_remembers():
    noise = autoregressive(np.random.default_rng(2), (50, 500), 0.4)
    assert max(ljung_box(e) for e in noise) < 0.01


def test_ljung_box_does_not_depend_on_unit_or_origin():
    e = autoregressive(np.random.default_rng(3), (300,), 0.1)
    assert ljung_box(5e-4 * e + 3e-4) == pytest.approx(ljung_box(e), rel=1e-6)


def test_ljung_box_of_several_records_adds_their_evidence():
    noise = np.random.default_rng(11).normal(size=(200, 3, 120))
    p = np.array([ljung_box(*records) for records in noise])
    assert scipy.stats.kstest(p, "uniform").pvalue > 0.01
    weak = autoregressive(np.random.default_rng(12), (8, 150), 0.25)
    assert ljung_box(*weak) < 0.01 < np.median([ljung_box(e) for e in weak])
    assert ljung_box(weak[0], np.zeros(50)) == ljung_box(weak[0])


@pytest.mark.parametrize("residual", [np.zeros(100), np.full(100, 0.25), np.array([1.0, -1, 1])])
def test_ljung_box_of_nothing_is_no_number(residual):
    assert np.isnan(ljung_box(residual))


# Chance


def test_the_chance_of_a_fit_to_noise_is_uniform():
    """A regression on noise explains something, and no more often than chance says."""
    rng = np.random.default_rng(13)
    X = np.column_stack([np.ones(80), rng.normal(size=(80, 3))])
    chances = []
    for y in rng.normal(size=(400, 80)):
        residual = y - X @ np.linalg.lstsq(X, y)[0]
        chances.append(chance_of_fit(y, residual, 3))
    # The test counts one degree of freedom more than there is: the mean is fitted, too.
    assert scipy.stats.kstest(chances, "uniform").pvalue > 0.01


def test_a_fit_that_explains_much_is_no_chance_and_one_that_does_not_is():
    rng = np.random.default_rng(14)
    noise = rng.normal(size=200)
    assert chance_of_fit(Y, 0.1 * Y, 3) < 1e-20
    assert chance_of_fit(Y, np.zeros_like(Y), 3) == 0
    assert chance_of_fit(noise, noise, 3) > 0.5
    assert chance_of_fit(noise, 3 * noise, 3) == 1
    assert chance_of_fit(np.ones(20), np.zeros(20), 3) == 1


# Correlation


def test_correlation_undoes_the_units():
    table = np.array([[1, 0.5, -0.2], [0.5, 1, 0.1], [-0.2, 0.1, 1]])
    sd = np.array([1e-3, 1.0, 250.0])
    np.testing.assert_allclose(correlation(table * np.outer(sd, sd)), table, rtol=1e-12)


def test_correlation_of_a_held_parameter_is_no_number():
    result = correlation(np.diag([4.0, 0.0]))
    assert result[0, 0] == 1
    assert np.isnan(result[1]).all()
    assert np.isnan(result[:, 1]).all()


# An error of the structure


def test_the_misfit_of_noise_is_small_and_that_of_a_wrong_structure_as_expected():
    rng = np.random.default_rng(7)
    signals, white = rng.normal(size=(1, 2000, 2)), rng.normal(size=(1, 2000, 1))
    S, valid = rng.normal(size=(1, 2000, 1, 1)), np.ones((1, 2000, 1), bool)
    coloured = autoregressive(rng, (1, 2000), 0.9)[..., None]
    for noise in (white, coloured):
        assert misfit_factor(S, noise, valid, signals, 2) < 1.8
    follows = white + 0.2 * np.roll(signals[:, :, :1], 1, axis=1)
    factor = misfit_factor(S, follows, valid, signals, 2)
    # Of five directions, one of them the mean, one has 0.04 * 2000 more than noise has.
    assert factor == pytest.approx(np.sqrt(1 + 0.04 * 2000 / 5 / 1.04), rel=0.3)
    other_units = signals * np.array([1e5, 1e-5])
    assert misfit_factor(S, follows, valid, other_units, 2) == pytest.approx(factor)
    quiet = np.concatenate([follows, white], axis=2)
    both = np.concatenate([S, np.zeros_like(S)], axis=2), quiet, np.tile(valid, (1, 1, 2))
    assert misfit_factor(*both, signals, 2) == pytest.approx(factor, rel=0.05)


def test_autocovariances_of_no_process_end_the_recursion():
    """Those of a smooth residual are not exactly those of a process."""
    smooth = np.cos(0.05 * np.arange(30))
    smooth[3:] *= 1.02
    found = Autoregression.of(smooth, 1000.0)
    assert found.variance > 1e-9


def test_a_long_residual_is_tested_block_by_block(monkeypatch):
    rng = np.random.default_rng(8)
    residual, inputs = np.cumsum(rng.normal(size=3001)), rng.normal(size=(3001, 2))
    whole = input_dependence([residual], [inputs])
    errors = innovations([residual])[0]
    monkeypatch.setattr("excite.estimation.diagnosis._BLOCK", 500)
    assert input_dependence([residual], [inputs]) == pytest.approx(whole, rel=1e-9)
    np.testing.assert_allclose(innovations([residual])[0], errors, atol=1e-9)
    assert innovations([np.zeros(0)])[0].size == 0


# What the data cannot see


NAMES = ("a", "b", "c")
ALL = np.ones(3, bool)


def information_of(directions: list[list[float]], sd: list[float]) -> np.ndarray:
    """Information whose (orthogonal) directions are known to these standard deviations."""
    V = np.array(directions, float)
    V /= np.linalg.norm(V, axis=1, keepdims=True)
    return V.T @ np.diag(1 / np.array(sd) ** 2) @ V


def test_when_all_is_seen_nothing_is_held():
    assert worst_seen(NAMES, information_of(np.eye(3).tolist(), [0.01, 0.4, 0.1]), ALL) is None


@pytest.mark.parametrize(("factor", "is_seen"), [(0.98, True), (1.02, False)])
def test_a_direction_is_seen_when_its_standard_deviation_is_below_the_limit(factor, is_seen):
    information = information_of(np.eye(3).tolist(), [0.01, factor * UNSEEN_SD, 0.01])
    assert (worst_seen(NAMES, information, ALL) is None) == is_seen


@pytest.mark.parametrize("index", [0, 1, 2])
def test_one_unseen_parameter_is_named(index):
    information = 1e4 * np.eye(3)
    information[index, index] = 0.0
    found = worst_seen(NAMES, information, ALL)
    assert found is not None
    assert found == (index, f"{NAMES[index]} is not identifiable from the data")


def test_an_unseen_combination_of_a_planned_experiment_is_named_with_its_exponents():
    # The data see a b and c: a may grow as b falls.
    information = information_of([[1, 1, 0], [0, 0, 1], [1, -1, 0]], [0.01, 0.01, 1e6])
    seen = worst_seen(NAMES, information, ALL)
    found = worst_seen(NAMES, information, ALL, is_planned=True)
    assert seen is not None
    assert found is not None
    assert seen[1] == "a and b are not identifiable separately"
    index, why = found
    assert NAMES[index] in ("a", "b")
    exponents = dict(
        part.split("^") for part in why.split(": ")[1].removesuffix(" is undetermined").split()
    )
    assert sorted(exponents) == ["a", "b"]
    assert float(exponents["a"]) == pytest.approx(-float(exponents["b"]))


def test_of_parts_alike_the_one_is_held_that_leaves_the_others_most_certain():
    # a, b and c are known but for a common factor, and a hardly acts besides.
    ratios = np.array([[1 / 3, -1 / 3, 0], [0, 100, -100]])
    found = worst_seen(NAMES, ratios.T @ ratios, ALL)
    assert found is not None
    assert found[0] in (1, 2)


def test_of_a_combination_the_largest_part_is_held():
    information = information_of([[1, 2, 0], [0, 0, 1], [2, -1, 0]], [0.01, 0.01, 1e6])
    found = worst_seen(NAMES, information, ALL)
    assert found is not None
    assert found[0] == 0


def test_held_parameters_are_left_out():
    information = np.diag([1e4, 0.0, 1e4])
    assert worst_seen(NAMES, information, np.array([True, False, True])) is None
    found = worst_seen(NAMES, np.diag([0.0, 0.0, 1e-3]), np.array([False, False, True]))
    assert found is not None
    assert found[0] == 2
    assert worst_seen(NAMES, np.zeros((3, 3)), np.zeros(3, bool)) is None


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_where_nothing_is_seen_one_parameter_after_the_other_is_held(value):
    free, held = ALL.copy(), []
    while (found := worst_seen(NAMES, np.full((3, 3), value), free)) is not None:
        held.append(int(found[0]))
        free[found[0]] = False
    assert sorted(held) == [0, 1, 2]


def test_rounding_below_zero_counts_as_unseen():
    found = worst_seen(NAMES, np.diag([1e4, -1e-9, 1e4]), ALL)
    assert found is not None
    assert found[0] == 1


def test_identifiability_names_the_worst_direction_and_its_size():
    sentence = identifiability(NAMES, np.diag([1e-4, 0.04, 1e-6]), ALL)
    assert sentence == "all parameters identifiable; least certain direction: b, 20 % (1 SD)"
    pair = np.array([[0.01, -0.0099, 0], [-0.0099, 0.01, 0], [0, 0, 1e-4]])
    assert "a combination of a and b, 14 % (1 SD)" in identifiability(NAMES, pair, ALL)
    held = identifiability(NAMES, np.diag([1e-4, 9.0, 1e-6]), np.array([True, False, True]))
    assert held == "a, c identifiable; least certain direction: a, 1 % (1 SD)"


# Robust covariance


N = 2000
TIME = np.arange(N) / N
REGRESSORS = np.column_stack([np.ones(N), np.sin(6 * TIME), np.cos(9 * TIME + 0.4)])


def robust(S: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """The covariance where nothing is missing."""
    return robust_covariance(S, residual, np.ones(residual.shape, bool))[0]


def white_covariance(X: np.ndarray, residual: np.ndarray) -> np.ndarray:
    return np.linalg.inv(X.T @ X) * np.mean(residual**2)


def regressions(rho: float, count: int = 300) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True standard deviation of regression coefficients, and both kinds of standard error."""
    noise = autoregressive(np.random.default_rng(5), (count, N), rho)
    inverse = np.linalg.pinv(REGRESSORS)
    estimates = noise @ inverse.T
    residuals = noise - estimates @ REGRESSORS.T
    S = REGRESSORS[None, :, None, :]
    found = [np.diag(robust(S, r[None, :, None])) for r in residuals]
    white = [np.diag(white_covariance(REGRESSORS, r)) for r in residuals]
    true = np.sqrt(np.mean(estimates**2, axis=0))
    return true, np.sqrt(np.mean(found, axis=0)), np.sqrt(np.mean(white, axis=0))


@pytest.mark.science
def test_robust_standard_errors_hold_for_noise_that_remembers():
    true, found, white = regressions(0.9)
    assert np.all(np.abs(found / true - 1) < 0.1)
    assert np.all(true > 2 * white)  # what they repair


@pytest.mark.science
def test_robust_standard_errors_of_white_noise_are_the_usual_ones():
    true, found, white = regressions(0.0)
    np.testing.assert_allclose(found, white, rtol=0.02)
    np.testing.assert_allclose(found, true, rtol=0.1)


def test_an_autoregression_is_found_with_its_covariance():
    noise = autoregressive(np.random.default_rng(6), (1, 4000), 0.7)
    own = np.array([noise[0, lag:] @ noise[0, : 4000 - lag] / 4000 for lag in range(11)])
    found = Autoregression.of(own, 4000)
    assert len(found.coefficients) == 1
    assert found.coefficients[0] == pytest.approx(0.7, abs=0.03)
    rows = np.random.default_rng(7).normal(size=(1, 60, 2))
    lags = np.arange(60)
    toeplitz = found.coefficients[0] ** np.abs(np.subtract.outer(lags, lags))
    toeplitz *= found.variance / (1 - found.coefficients[0] ** 2)
    np.testing.assert_allclose(found.times(rows)[0], toeplitz @ rows[0], rtol=1e-9)
    variance, spread = found.variances(rows)
    np.testing.assert_allclose(variance, np.diag(rows[0].T @ toeplitz @ rows[0]), rtol=1e-9)
    assert np.all(spread > 2 * variance**2 / 4000)


@pytest.mark.science
@pytest.mark.parametrize("rho", [0.5, 0.9])
def test_noise_is_found_without_what_the_fit_took_along(rho):
    """In short records with many unknowns the residual remembers less than the noise."""
    time = np.linspace(0, 1, 150)
    X = np.stack([time**0, time, time**2, np.sin(9 * time), np.cos(9 * time)], axis=1)
    noise = autoregressive(np.random.default_rng(8), (300, 150), rho)
    residuals = noise - noise @ np.linalg.pinv(X).T @ X.T
    everywhere = np.ones((1, 150, 1), bool)
    found = [
        coloured_noise(X[None, :, None], r[None, :, None], everywhere)[0].coefficients[:1].sum()
        for r in residuals
    ]
    plain = np.sum(residuals[:, 1:] * residuals[:, :-1], axis=1) / np.sum(residuals**2, axis=1)
    assert rho - np.mean(found) < 0.5 * (rho - np.mean(plain))


def test_missing_samples_are_left_out():
    rng = np.random.default_rng(9)
    S, noise = rng.normal(size=(1, 3000, 1, 2)), autoregressive(rng, (1, 3000), 0.8)[..., None]
    valid = rng.random((1, 3000, 1)) < 0.7
    held = S * valid[..., None]
    whole = robust(S, noise)
    part, degrees = robust_covariance(held, noise * valid, valid)
    np.testing.assert_allclose(np.diag(part), np.diag(whole) / 0.7, rtol=0.25)
    assert np.all((degrees > 50) & (degrees < 3000))


def test_experiments_side_by_side_share_their_information():
    rng = np.random.default_rng(7)
    S = rng.normal(size=(1, 300, 2, 2))
    residual = rng.normal(size=(1, 300, 2))
    one = robust(S, residual)
    two = robust(np.concatenate([S, S]), np.concatenate([residual, residual]))
    np.testing.assert_allclose(two, one / 2, rtol=0.02, atol=1e-6)


def test_robust_covariance_follows_the_units_of_the_unknowns():
    rng = np.random.default_rng(8)
    S, residual = rng.normal(size=(2, 200, 1, 3)), rng.normal(size=(2, 200, 1))
    units = np.array([1e-4, 1.0, 3e5])
    expected = robust(S, residual) * np.outer(units, units)
    np.testing.assert_allclose(robust(S / units, residual), expected, rtol=1e-8)


def test_an_unknown_without_influence_gets_no_covariance():
    rng = np.random.default_rng(9)
    S, residual = rng.normal(size=(1, 200, 1, 3)), rng.normal(size=(1, 200, 1))
    S[..., 1] = 0.0
    covariance = robust(S, residual)
    assert np.all(covariance[1] == 0)
    assert np.all(covariance[:, 1] == 0)
    rest = robust(S[..., [0, 2]], residual)
    np.testing.assert_allclose(covariance[np.ix_([0, 2], [0, 2])], rest, rtol=1e-9)


def test_intervals_are_widened_and_never_narrowed():
    white = np.array([[4.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    result = widened(white, np.diag([1.0, 9.0, 5.0]))
    np.testing.assert_allclose(np.diag(result), [4, 9, 0])
    np.testing.assert_allclose(correlation(result)[0, 1], correlation(white)[0, 1])
    np.testing.assert_array_equal(widened(white, np.zeros((3, 3))), white)
