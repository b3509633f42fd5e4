"""Quality of an estimate: fit, and tests of the residual.

Everything here runs once, after a fit, on NumPy arrays; nothing is differentiated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float


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
    residuals of zeros.
    """
    statistic, degrees = 0.0, 0
    for residual in residuals:
        n, centred = residual.size, residual - residual.mean()
        lags, power = np.arange(1, min(num_lags, n // 5) + 1), float(centred @ centred)
        if power == 0:
            continue
        r = np.array([centred[lag:] @ centred[:-lag] for lag in lags]) / power
        statistic += float(n * (n + 2) * np.sum(r**2 / (n - lags)))
        degrees += len(lags)
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
        own = _lagged(centred[:, None], past)
        memory = np.linalg.lstsq(own[past:], centred[past:], rcond=None)[0]
        white = (centred - own @ memory)[past + lags :]
        before = _lagged(record, past).reshape(len(record), past, record.shape[1])
        filtered = record - np.einsum("spi,p->si", before, memory)
        regressors = _lagged(filtered, lags)[past + lags :]
        left, sizes, _ = np.linalg.svd(regressors - regressors.mean(axis=0), full_matrices=False)
        seen = left[:, sizes > 1e-6 * max(sizes[0], 1e-300)]
        power = float(np.mean((white - white.mean()) ** 2))
        if power > 0:
            statistic += float(np.sum((seen.T @ white) ** 2)) / power
            degrees += seen.shape[1]
    return chi2_tail(degrees, statistic) if degrees else math.nan


def _lagged(
    values: Float[np.ndarray, "sample part"], num_lags: int
) -> Float[np.ndarray, "sample column"]:
    """Values 1, 2, ... samples before each sample, side by side; zero before the first."""
    padded = np.concatenate([np.zeros((num_lags, values.shape[1])), values])
    starts = range(num_lags - 1, -1, -1)
    columns = [padded[start : start + len(values)] for start in starts]
    return np.concatenate(columns, axis=1) if columns else np.zeros((len(values), 0))


def innovations(residuals: Sequence[Float[np.ndarray, " _sample"]]) -> list[np.ndarray]:
    """What residuals do not follow from their own past: the errors of an autoregression.

    One autoregression, of order 10 at most, is fitted to all of them.
    """
    order = min(10, sum(r.size for r in residuals) // 20)
    past = [_lagged(r[:, None], order) for r in residuals]
    memory = np.linalg.lstsq(np.concatenate(past), np.concatenate(residuals), rcond=None)[0]
    return [r - own @ memory for r, own in zip(residuals, past, strict=True)]


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


def correlation(covariance: Float[np.ndarray, "param param"]) -> Float[np.ndarray, "param param"]:
    """Correlation of the estimates; NaN for a parameter without variance."""
    sd = np.sqrt(np.diag(covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        return covariance / np.outer(sd, sd)


def robust_covariance(
    sensitivity: Float[np.ndarray, "experiment time output unknown"],
    residual: Float[np.ndarray, "experiment time output"],
) -> Float[np.ndarray, "unknown unknown"]:
    """Covariance of a least-squares estimate whose residual is correlated in time.

    H^-1 V H^-1 with H = S' S and V the long-run covariance of the scores S_k' r_k, by
    Bartlett's window with the bandwidth of D. Andrews ("Heteroskedasticity and
    autocorrelation consistent covariance matrix estimation", Econometrica 59, 1991) for
    the autocorrelation of the residual. Both arguments are over the noise's standard
    deviation. Undetermined directions get zero.
    """
    H = np.einsum("etou,etov->uv", sensitivity, sensitivity)
    size = np.sqrt(np.diag(H))
    size[size == 0] = 1.0
    inverse = np.linalg.pinv(H / np.outer(size, size), hermitian=True) / np.outer(size, size)
    scores = np.einsum("etou,eto->etu", sensitivity, residual)
    length = residual.shape[1]
    rho = np.sum(residual[:, 1:] * residual[:, :-1]) / max(np.sum(residual**2), 1e-300)
    rho = min(abs(rho), 1 - 1 / length)
    alpha = (2 * rho / (1 - rho**2)) ** 2
    width = int(np.clip(1.1447 * (alpha * length) ** (1 / 3), 1, length // 3))
    # Sums over every window of `width` samples: their squares are Bartlett's estimate.
    padded = np.pad(scores, ((0, 0), (width, width - 1), (0, 0))).cumsum(axis=1)
    sums = padded[:, width:] - padded[:, :-width]
    V = np.einsum("etu,etv->uv", sums, sums) / width
    return inverse @ V @ inverse


def widened(
    white: Float[np.ndarray, "param param"], robust: Float[np.ndarray, "param param"]
) -> Float[np.ndarray, "param param"]:
    """The covariance for white noise, with each variance raised to the robust one if larger."""
    variance, safe = np.diag(white), np.where(np.diag(white) > 0, np.diag(white), 1.0)
    factor = np.sqrt(np.where(variance > 0, np.maximum(np.diag(robust) / safe, 1.0), 1.0))
    return white * np.outer(factor, factor)
