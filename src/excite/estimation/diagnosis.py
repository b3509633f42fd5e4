"""Quality of an estimate: fit, and tests of the residual.

Everything here runs once, after a fit, on NumPy arrays; nothing is differentiated.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Bool, Complex, Float

from ..description import HALF_95

_FEW = 15
"""Samples of a residual below which the fit itself correlates it too much to be tested."""
_MOST_LAGS = 25  # of an autoregression
_BLOCK = 2**13  # samples of a long record that are looked at together
_STATIONARY = 0.999  # largest partial autocorrelation
_LEAST = 1e-4  # of its inverse transfer function, where rounding leaves less
_CORRECTIONS = 3  # of the autocovariances for what the fit took along


def fit_percent(
    measured: Float[np.ndarray, " sample"], simulated: Float[np.ndarray, " sample"]
) -> float:
    """100 (1 - |y - y_s| / |y - mean y|) of measured samples; NaN for a constant output."""
    seen = np.isfinite(measured)
    measured, simulated = measured[seen], simulated[seen]
    spread = np.linalg.norm(measured - measured.mean())
    if spread == 0:
        return float("nan")
    return float(100 * (1 - np.linalg.norm(measured - simulated) / spread))


def ljung_box(*residuals: Float[np.ndarray, " _sample"], num_lags: int = 25) -> float:
    """p-value of the hypothesis that the residuals of one or several records are white.

    G. Ljung and G. Box, "On a measure of lack of fit in time series models", Biometrika
    65, 1978; statistics and degrees of freedom of several records add up. Not a number for
    residuals of zeros, and for fewer than 15 samples, which do not tell.
    """
    statistic, degrees = 0.0, 0
    for residual in residuals:
        n, centred = residual.size, residual - residual.mean()
        lags, power = np.arange(1, min(num_lags, n // 5) + 1), float(centred @ centred)
        if power == 0 or n < _FEW:
            continue
        r = np.array([centred[lag:] @ centred[:-lag] for lag in lags]) / power
        statistic += float(n * (n + 2) * np.sum(r**2 / (n - lags)))
        degrees += len(lags)
    return chi2_tail(degrees, statistic) if degrees else math.nan


def whiteness_of(residuals: list[np.ndarray], scale: float) -> float:
    """p-value of white residuals; NaN where only rounding errors are left."""
    return ljung_box(*(r for r in residuals if is_more_than_rounding(r, scale)))


def is_more_than_rounding(residual: np.ndarray, scale: float) -> bool:
    """Whether a residual is more than rounding errors of values of this size."""
    return bool(np.any(np.abs(residual) > 1e-8 * scale))


def mean_or_trend(*residuals: Float[np.ndarray, " _sample"]) -> float:
    """p-value of the hypothesis that white residuals have neither a mean nor a trend.

    Both are small beside the noise of each sample, and the test of whiteness hardly sees them.
    Not a number for residuals of zeros, and for fewer than 15 samples.
    """
    statistic, degrees = 0.0, 0
    for residual in residuals:
        n, power = residual.size, float(np.mean(residual**2))
        if power == 0 or n < _FEW:
            continue
        time = np.linspace(-1, 1, n)
        parts = float(residual.mean()) ** 2 * n + float(residual @ time) ** 2 / float(time @ time)
        statistic, degrees = statistic + parts / power, degrees + 2
    return chi2_tail(degrees, statistic) if degrees else math.nan


def input_dependence(
    residuals: Sequence[Float[np.ndarray, " _sample"]],
    inputs: Sequence[Float[np.ndarray, "_sample input"]],
    num_lags: int = 20,
    order: int = 10,
) -> float:
    """p-value of the hypothesis that the residuals of some records do not follow past inputs.

    A residual that follows the input is not noise: the structure of the model is wrong
    (cross-correlation test, L. Ljung, System Identification, 2nd ed. 1999, section 16.6).
    Residual and inputs are first filtered by an autoregression fitted to the residual, so
    that coloured noise alone does not fail the test. NaN for residuals of zeros.
    """
    statistic, degrees = 0.0, 0
    for residual, record in zip(residuals, inputs, strict=True):
        centred, past = residual - residual.mean(), min(order, residual.size // 20)
        lags = min(num_lags, residual.size // 10)
        memory = _autoregression([centred], past, past)
        white = _filtered(centred, memory)[past + lags :, None]
        if not (white.size and lags and record.shape[1]):
            continue
        filtered = _filtered(record, memory)
        rows = (
            np.hstack([np.ones((len(own), 1)), own, white[before : before + len(own)]])
            for before, own in _lagged(filtered, lags, past + lags)
        )
        triangle = _triangle(rows)[1:, 1:]
        regressors = triangle[:-1, :-1]
        lengths = np.linalg.norm(regressors, axis=0)
        left, sizes, _ = np.linalg.svd(regressors / np.where(lengths > 0, lengths, 1.0))
        seen = left[:, sizes > 1e-6 * max(sizes[0], 1e-300)]
        power = float(np.var(white))
        if power > 0:
            statistic += float(np.sum((seen.T @ triangle[:-1, -1]) ** 2)) / power
            degrees += seen.shape[1]
    return chi2_tail(degrees, statistic) if degrees else math.nan


def _lagged(
    values: Float[np.ndarray, "sample part"], num_lags: int, first: int
) -> Iterator[tuple[int, Float[np.ndarray, "row column"]]]:
    """Values 1, 2, ... samples before each sample from the first one on, side by side.

    In blocks, each with the number of samples before it; values before the record are zero.
    """
    padded = np.concatenate([np.zeros((num_lags, values.shape[1])), values])
    for k in range(first, len(values), _BLOCK):
        stop = min(k + _BLOCK, len(values))
        back = range(num_lags - 1, -1, -1)
        columns = [padded[k + lag : stop + lag] for lag in back]
        yield k - first, np.concatenate([np.zeros((stop - k, 0)), *columns], axis=1)


def _triangle(blocks: Iterable[Float[np.ndarray, "row column"]]) -> Float[np.ndarray, "row column"]:
    """Triangular factor of the blocks one below the other, as many rows as columns."""
    triangle = np.zeros((0, 0))
    for block in blocks:
        triangle = np.linalg.qr(np.vstack([triangle.reshape(-1, block.shape[1]), block]), mode="r")
    missing = triangle.shape[1] - len(triangle)
    return np.vstack([triangle, np.zeros((missing, triangle.shape[1]))])


def _autoregression(
    residuals: Sequence[Float[np.ndarray, " _sample"]], order: int, first: int = 0
) -> Float[np.ndarray, " lag"]:
    """The autoregression that predicts residuals best from their own past.

    From the samples from `first` on; what lies before a record counts as zero.
    """
    rows = (
        np.hstack([own, r[first + before : first + before + len(own), None]])
        for r in residuals
        for before, own in _lagged(r[:, None], order, first)
    )
    triangle = _triangle(rows)
    if not triangle.size:
        return np.zeros(order)
    return np.linalg.lstsq(triangle[:, :-1], triangle[:, -1], rcond=None)[0]


def _filtered(values: np.ndarray, memory: Float[np.ndarray, " lag"]) -> np.ndarray:
    """What values do not follow from their own past by an autoregression."""
    left = values.copy()
    for lag, coefficient in enumerate(memory, 1):
        left[lag:] -= coefficient * values[:-lag]
    return left


def innovations(residuals: Sequence[Float[np.ndarray, " _sample"]]) -> list[np.ndarray]:
    """What residuals do not follow from their own past: the errors of an autoregression.

    One autoregression, of order 10 at most, is fitted to all of them.
    """
    memory = _autoregression(residuals, min(10, sum(r.size for r in residuals) // 20))
    return [_filtered(r, memory) for r in residuals]


def log_likelihood(
    residuals: Sequence[Sequence[Float[np.ndarray, " _sample"]]], whiten: bool = False
) -> float:
    """Of residuals by output as normal noise, at the likeliest size of each output's noise.

    `whiten`: they are taken as autoregressions, so that colour alone gains nothing.
    """
    total = 0.0
    for parts in residuals:
        errors = innovations(parts) if whiten else parts
        count = max(sum(map(len, errors)), 1)
        variance = max(sum(float(r @ r) for r in errors) / count, 1e-300)
        total -= count * (math.log(2 * math.pi * variance) + 1) / 2
    return total


def chance_of_fit(
    measured: Float[np.ndarray, " sample"], residual: Float[np.ndarray, " sample"], unknowns: int
) -> float:
    """Probability of a fit this good by chance: an F-test against a constant output."""
    total = float(np.sum((measured - measured.mean()) ** 2))
    left, degrees = float(np.sum(residual**2)), measured.size - unknowns
    if total <= left:
        return 1.0
    if left == 0:
        return 0.0
    return incomplete_beta(degrees / 2, unknowns / 2, left / total)


# Tails of distributions; SciPy's would take a fifth of a second to load.


def chi2_tail(degrees: int, statistic: float) -> float:
    """Probability that a chi-squared variable is larger than `statistic`, as a finite sum.

    M. Abramowitz and I. Stegun, Handbook of Mathematical Functions, 26.4.4 and 26.4.5.
    """
    x, odd = statistic / 2, degrees % 2
    if x <= 0:
        return 1.0
    powers = [k + odd / 2 for k in range(degrees // 2)]
    terms = (math.exp(p * math.log(x) - x - math.lgamma(p + 1)) for p in powers)
    return math.fsum(terms) + (math.erfc(math.sqrt(x)) if odd else 0.0)


def incomplete_beta(a: float, b: float, x: float) -> float:
    """Regularised incomplete beta function by its continued fraction (ibid., 26.5.8)."""
    if not 0 < x < 1:
        return float(x >= 1)
    if x > (a + 1) / (a + b + 2):  # where the fraction converges quickly
        return 1 - incomplete_beta(b, a, 1 - x)
    logarithm = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b)
    logarithm += a * math.log(x) + b * math.log1p(-x)
    fraction, m = 0.0, 200 + int(5 * math.sqrt(max(a, b)))  # from its end, no overflow
    for k in range(m, 0, -1):
        even = k * (b - k) * x / ((a + 2 * k - 1) * (a + 2 * k))
        odd = -(a + k - 1) * (a + b + k - 1) * x / ((a + 2 * k - 2) * (a + 2 * k - 1))
        fraction = odd / (1 + even / (1 + fraction))
    return math.exp(logarithm) / a / (1 + fraction)


@cache
def student_95(degrees: float) -> float:
    """Half of a 95 % interval in standard deviations, by Student's t; 1.96 for infinitely many."""
    if degrees > 1e6:
        return HALF_95
    t, step, n = HALF_95, 1.0, max(degrees, 1.0)
    scale = math.lgamma((n + 1) / 2) - math.lgamma(n / 2) - math.log(math.pi * n) / 2
    while step > 1e-9 * t:  # Newton's method from below, where the tail is convex
        density = math.exp(scale - (n + 1) / 2 * math.log1p(t**2 / n))
        step = (incomplete_beta(n / 2, 0.5, n / (n + t**2)) - 0.05) / (2 * density)
        t += step
    return t


def half_95(
    covariance: Float[np.ndarray, "param param"], degrees: Float[np.ndarray, " param"] | None
) -> Float[np.ndarray, " param"]:
    """Half of each parameter's 95 % interval; `degrees` as in an estimate."""
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if degrees is None:
        return HALF_95 * sd
    return sd * np.array([student_95(float(n)) for n in degrees])


def correlation(covariance: Float[np.ndarray, "param param"]) -> Float[np.ndarray, "param param"]:
    """Correlation of the estimates; NaN for a parameter without variance."""
    sd = np.sqrt(np.diag(covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        return covariance / np.outer(sd, sd)


@dataclass(frozen=True)
class Autoregression:
    """Coloured noise: each value from the ones before it, and from white noise.

    Attributes:
        coefficients: of the values 1, 2, ... samples before.
        variance: of the white noise.
        count: values that it was fitted to, less the unknowns that were fitted, too.
    """

    coefficients: Float[np.ndarray, " lag"]
    variance: float
    count: float

    @classmethod
    def of(cls, autocovariance: Float[np.ndarray, " lag"], count: float) -> Autoregression:
        """The one whose order the Bayesian information criterion chooses.

        By the recursion of N. Levinson and J. Durbin; `autocovariance` begins with lag zero.
        """
        a, variance = np.zeros(0), float(autocovariance[0])
        best, least = (a, variance), math.inf
        for order in range(len(autocovariance)):
            if order:
                known = autocovariance[order - 1 : 0 : -1]
                partial = (autocovariance[order] - a @ known) / variance
                if not abs(partial) < 1:  # these are the autocovariances of no process
                    break
                partial = float(np.clip(partial, -_STATIONARY, _STATIONARY))
                a = np.append(a - partial * a[::-1], partial)
                variance = variance * (1 - partial**2)
            criterion = count * math.log(max(variance, 1e-300)) + order * math.log(count)
            if criterion < least:
                best, least = (a, variance), criterion
        return cls(*best, count)

    def transfer(self, length: int) -> Complex[np.ndarray, " frequency"]:
        """1 / A(w) at the frequencies of a real Fourier transform of `length` values."""
        inverse = np.fft.rfft(np.append(1.0, -self.coefficients), length)
        return 1 / np.where(np.abs(inverse) < _LEAST, _LEAST, inverse)

    def spectrum(self, length: int) -> Float[np.ndarray, " frequency"]:
        """Power at these frequencies."""
        return self.variance * np.abs(self.transfer(length)) ** 2

    def times(
        self, rows: Float[np.ndarray, "experiment sample column"]
    ) -> Float[np.ndarray, "experiment sample column"]:
        """The covariance of the noise of each experiment times the columns."""
        length = _long_enough(rows.shape[1])
        transformed = np.fft.rfft(rows, length, axis=1) * self.spectrum(length)[None, :, None]
        return np.fft.irfft(transformed, length, axis=1)[:, : rows.shape[1]]

    def variances(
        self, weights: Float[np.ndarray, "experiment sample column"]
    ) -> tuple[Float[np.ndarray, " column"], Float[np.ndarray, " column"]]:
        """Variance of weighted sums of the noise, and the variance of these variances.

        The latter follows from the large-sample covariance of the coefficients (P. Brockwell and
        R. Davis, Time Series: Theory and Methods, 2nd ed. 1991, section 8.1).
        """
        length = _long_enough(weights.shape[1])
        power = np.sum(np.abs(np.fft.rfft(weights, length, axis=1)) ** 2, axis=0)
        power[1:-1] *= 2  # and the same at negative frequencies
        parts = power / length * self.spectrum(length)[:, None]
        variance, order = parts.sum(axis=0), len(self.coefficients)
        spread = 2 * variance**2 / self.count
        if order:
            delay = np.exp(-2j * np.pi * np.arange(length // 2 + 1) / length)
            lags = delay[:, None] ** np.arange(1, order + 1)
            slope = parts.T @ (2 * np.real(lags * self.transfer(length)[:, None]))
            own = np.fft.irfft(self.spectrum(length), length)[:order]
            toeplitz = own[np.abs(np.subtract.outer(np.arange(order), np.arange(order)))]
            covariance = self.variance / self.count * np.linalg.inv(toeplitz)
            spread += np.einsum("cp,pq,cq->c", slope, covariance, slope)
        return variance, spread


def _long_enough(num_samples: int) -> int:
    """A length of Fourier transforms in which samples at the end do not touch the first ones."""
    return 2 ** math.ceil(math.log2(max(2 * num_samples, 1024)))


def _lagged_products(
    first: Float[np.ndarray, "experiment sample column"],
    second: Float[np.ndarray, "experiment sample column"],
    num_lags: int,
) -> Float[np.ndarray, " lag"]:
    """Sums of first[k] second[k + lag] over experiments, samples and columns, from lag zero on."""
    length = _long_enough(first.shape[1])
    a, b = (np.fft.rfft(rows, length, axis=1) for rows in (first, second))
    return np.fft.irfft(np.sum(a.conj() * b, axis=(0, 2)), length)[: num_lags + 1]


def coloured_noise(
    sensitivity: Float[np.ndarray, "experiment sample output unknown"],
    residual: Float[np.ndarray, "experiment sample output"],
    valid: Bool[np.ndarray, "experiment sample output"],
) -> list[Autoregression]:
    """The noise of each output, from the residual of a least-squares fit.

    The fit takes some of the noise along: of noise of covariance G, the residual has
    (1 - P) G (1 - P) with P the projection on the sensitivities. The autocovariances of the
    residual are corrected for it, with G from the autoregression found before.
    """
    num_outputs, num_unknowns = sensitivity.shape[2:]
    basis, sizes, _ = np.linalg.svd(sensitivity.reshape(-1, num_unknowns), full_matrices=False)
    basis = basis[:, sizes > 1e-10 * max(sizes[0], 1e-300)].reshape(*residual.shape, -1)
    counts = valid.sum(axis=(0, 1)) - basis.shape[-1] / num_outputs
    lags = [int(np.clip(count // 10, 0, _MOST_LAGS)) for count in counts]

    def products(rows: np.ndarray, o: int) -> np.ndarray:
        return _lagged_products(rows[..., o, None], rows[..., o, None], lags[o])

    raw = [products(residual, o) for o in range(num_outputs)]
    pairs = [np.maximum(products(valid.astype(float), o), 1.0) for o in range(num_outputs)]
    noise = [
        Autoregression.of(r / p, max(float(count), 1.0))
        for r, p, count in zip(raw, pairs, counts, strict=True)
    ]
    for _ in range(_CORRECTIONS):
        through = [
            process.times(basis[:, :, o]) * valid[:, :, o, None] for o, process in enumerate(noise)
        ]
        common = sum(
            np.einsum("etu,etv->uv", basis[:, :, o], rows) for o, rows in enumerate(through)
        )
        for o, rows in enumerate(through):
            own = basis[:, :, o]
            taken = _lagged_products(own, rows, lags[o]) + _lagged_products(rows, own, lags[o])
            taken -= _lagged_products(own @ common, own, lags[o])
            noise[o] = Autoregression.of((raw[o] + taken) / pairs[o], noise[o].count)
    return noise


def robust_covariance(
    sensitivity: Float[np.ndarray, "experiment sample output unknown"],
    residual: Float[np.ndarray, "experiment sample output"],
    valid: Bool[np.ndarray, "experiment sample output"],
    prior: Float[np.ndarray, "unknown unknown"] | None = None,
) -> tuple[Float[np.ndarray, "unknown unknown"], Float[np.ndarray, " unknown"]]:
    """Covariance of a least-squares estimate in coloured noise, and its degrees of freedom.

    H^-1 (S' G S + P) H^-1 with H = S' S + P, P the information of a prior, and G the covariance
    of an autoregression fitted to each output's residual. The degrees of freedom are those of a
    chi-squared variable whose variance, relative to its mean, is that of the variance found (F.
    Satterthwaite, "An approximate distribution of estimates of variance components", Biometrics
    Bulletin 2, 1946). Sensitivity and residual are over the standard deviation of the weights.
    Undetermined directions get zero.
    """
    inverse = inverse_information(sensitivity, prior)
    count = len(inverse)
    covariance = np.zeros((count, count)) if prior is None else inverse @ prior @ inverse
    variance, spread = np.diag(covariance).copy(), np.zeros(count)
    for o, noise in enumerate(coloured_noise(sensitivity, residual, valid)):
        weights = sensitivity[:, :, o] @ inverse
        covariance += np.einsum("etu,etv->uv", weights, noise.times(weights))
        own, its_spread = noise.variances(weights)
        variance, spread = variance + own, spread + its_spread
    degrees = np.full(count, np.inf)
    np.divide(2 * variance**2, spread, out=degrees, where=spread > 0)
    return covariance, degrees


def misfit_factor(
    sensitivity: Float[np.ndarray, "experiment sample output unknown"],
    residual: Float[np.ndarray, "experiment sample output"],
    valid: Bool[np.ndarray, "experiment sample output"],
    signals: Float[np.ndarray, "experiment sample signal"],
    num_lags: int,
) -> float:
    """How much wider than coloured noise an error of the structure makes intervals; at least 1.

    The residual of each output is projected on the past of signals that follow from the inputs,
    such as simulated outputs. Noise of its colour has a known variance in these directions; an
    error of the structure has more. What the estimates took of it, the part along the
    sensitivities, cannot be seen: it is taken to be as large as in the mean of the others. The
    output with the largest error counts.

    Args:
        sensitivity, residual, valid: see `robust_covariance`.
        num_lags: past samples; as many as the plant has states determine its next output.
    """
    past = np.concatenate([own for rows in signals for _, own in _lagged(rows, num_lags, 0)])
    ratios = [1.0]
    for o, noise in enumerate(coloured_noise(sensitivity, residual, valid)):
        seen = valid[:, :, o].reshape(-1)
        estimated = _basis(sensitivity[:, :, o].reshape(len(seen), -1))
        directions = np.where(seen[:, None], np.column_stack([np.ones(len(seen)), past]), 0.0)
        directions = _basis(directions, estimated)
        along = directions.T @ residual[:, :, o].reshape(-1)
        by_experiment = directions.reshape(*valid.shape[:2], -1)
        expected = float(np.sum(by_experiment * noise.times(by_experiment)))
        if expected > 0:
            ratios.append(float(along @ along) / expected)
    return math.sqrt(max(ratios))


def _basis(
    columns: Float[np.ndarray, "row column"],
    without: Float[np.ndarray, "row other"] | None = None,
) -> Float[np.ndarray, "row direction"]:
    """Orthonormal directions of columns, less what other directions explain of them."""
    lengths = np.linalg.norm(columns, axis=0)
    columns = columns[:, lengths > 0] / lengths[lengths > 0]
    if without is not None:
        columns = columns - without @ (without.T @ columns)
    basis, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return basis[:, sizes > 1e-6]


def inverse_information(
    sensitivity: Float[np.ndarray, "experiment sample output unknown"],
    prior: Float[np.ndarray, "unknown unknown"] | None = None,
) -> Float[np.ndarray, "unknown unknown"]:
    """(S' S + P)^-1 with P the information of a prior; zero in undetermined directions."""
    H = np.einsum("etou,etov->uv", sensitivity, sensitivity)
    H = H if prior is None else H + prior
    size = np.sqrt(np.diag(H))
    size[size == 0] = 1.0
    return np.linalg.pinv(H / np.outer(size, size), hermitian=True) / np.outer(size, size)


def effect_of_constants(
    sensitivity: Float[np.ndarray, "experiment sample output unknown"],
    to_constants: Float[np.ndarray, "experiment sample output constant"],
    prior: Float[np.ndarray, "unknown unknown"] | None = None,
) -> Float[np.ndarray, "unknown constant"]:
    """Derivative of a least-squares estimate with respect to constants that it takes as known."""
    rows = np.einsum("etou,etoc->uc", sensitivity, to_constants)
    return -inverse_information(sensitivity, prior) @ rows


def with_independent(
    covariance: Float[np.ndarray, "param param"],
    degrees: Float[np.ndarray, " param"],
    other: Float[np.ndarray, "param param"],
) -> tuple[Float[np.ndarray, "param param"], Float[np.ndarray, " param"]]:
    """An estimated covariance and its degrees of freedom, with a known one added."""
    total, own = np.diag(covariance) + np.diag(other), np.diag(covariance)
    growth = np.where(own > 0, total / np.where(own > 0, own, 1.0), 1.0)
    return covariance + other, degrees * growth**2


def widened(
    white: Float[np.ndarray, "param param"], robust: Float[np.ndarray, "param param"]
) -> Float[np.ndarray, "param param"]:
    """The covariance for white noise, with each variance raised to the robust one if larger."""
    variance, safe = np.diag(white), np.where(np.diag(white) > 0, np.diag(white), 1.0)
    factor = np.sqrt(np.where(variance > 0, np.maximum(np.diag(robust) / safe, 1.0), 1.0))
    return white * np.outer(factor, factor)
