"""Numbers that summarise success over tasks and seeds; plain NumPy and SciPy, knows no models or environments."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import stats

from sb3_ars.errors import ConfigError

__all__ = ["Interval", "bottom_k", "estr", "iqm", "iqm_interval", "mean_success", "success_rates"]

Array = npt.NDArray[np.float64]


class Interval(NamedTuple):
    """A point estimate and its confidence bounds, in the units of the scores."""

    estimate: float
    low: float
    high: float


def success_rates(episodes: npt.ArrayLike) -> Array:
    """Return each task's share of successful episodes, ``(n_tasks,)`` in [0, 1].

    :param episodes: ``(n_tasks, n_episodes)``, 1 or 0 for each episode; NaN for a task that reports no success
    """
    rates: Array = np.asarray(episodes, dtype=np.float64).mean(axis=1)
    return rates


def mean_success(success: npt.ArrayLike) -> float:
    """Return the mean over the tasks that report success, NaN if none does.

    :param success: ``(n_tasks,)`` success rates in [0, 1], NaN for a task that reports none
    """
    rates = np.asarray(success, dtype=np.float64)
    reported = rates[~np.isnan(rates)]
    return float(reported.mean()) if reported.size else float("nan")


def bottom_k(success: npt.ArrayLike, k: int) -> float:
    """Return the mean success over the k tasks with the lowest success.

    :param success: ``(n_tasks,)`` success rates in [0, 1]
    :param k: between 1 and n_tasks
    :raises ConfigError: if k is out of range or ``success`` is not one row of finite numbers

    Source: paper, section 5.1, Table 2.
    """
    rates = _checked("success", success, ndim=1)
    if k != int(k) or not 1 <= k <= rates.size:
        raise ConfigError(f"k={k!r} must be an integer between 1 and the number of tasks, {rates.size}.")
    return float(np.sort(rates)[:k].mean())


def estr(success: npt.ArrayLike, threshold: float) -> float:
    """Return the share of tasks whose success reaches the threshold: ``|{i : success_i >= delta}| / N``.

    :param success: ``(n_tasks,)`` final success rates in [0, 1]
    :param threshold: delta, in [0, 1]
    :raises ConfigError: if ``success`` is not one row of finite numbers

    Source: paper, section 5.1, Eq. 8.
    """
    if not 0 <= threshold <= 1:
        raise ConfigError(f"threshold={threshold!r} must be between 0 and 1.")
    return float((_checked("success", success, ndim=1) >= threshold).mean())


def iqm(scores: npt.ArrayLike) -> float:
    """Return the mean of the middle half of all scores, seeds and tasks pooled.

    :param scores: any shape, for instance ``(n_seeds, n_tasks)``
    :raises ConfigError: if a score is not finite or there are none

    Source: Agarwal et al. 2021, section 4.3: the mean after the lowest and highest quarter are cut, whole scores only.
    """
    return float(stats.trim_mean(_checked("scores", scores).ravel(), 0.25))


def iqm_interval(
    scores: npt.ArrayLike, confidence: float = 0.95, n_resamples: int = 2000, seed: int = 0
) -> Interval:
    """Return the interquartile mean with a stratified percentile bootstrap interval.

    Seeds are resampled within each task, so every resample holds every task.

    :param scores: ``(n_seeds, n_tasks)``, at least two seeds
    :param confidence: level, in (0, 1)
    :param n_resamples: bootstrap resamples
    :param seed: of the resampling
    :raises ConfigError: if there is one seed only, or a score is not finite

    Source: Agarwal et al. 2021, section 4.1.
    """
    if not 0 < confidence < 1:
        raise ConfigError(f"confidence={confidence!r} must be between 0 and 1, such as 0.95.")
    table = _checked("scores", scores, ndim=2)
    if table.shape[0] < 2:
        raise ConfigError(
            "An interval needs the scores of at least two seeds; iqm() gives the point estimate of one."
        )
    result = stats.bootstrap(
        tuple(table.T),
        lambda *tasks, axis: stats.trim_mean(np.concatenate(tasks, axis=axis), 0.25, axis=axis),
        confidence_level=confidence,
        n_resamples=n_resamples,
        method="percentile",
        rng=np.random.default_rng(seed),
    )
    return Interval(iqm(table), float(result.confidence_interval.low), float(result.confidence_interval.high))


def _checked(name: str, values: npt.ArrayLike, ndim: int | None = None) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if array.size == 0 or (ndim is not None and array.ndim != ndim) or not np.isfinite(array).all():
        wanted = "" if ndim is None else f" of {ndim} dimension{'s' if ndim > 1 else ''}"
        raise ConfigError(
            f"{name} must be a non-empty array{wanted} of finite numbers, not shape {array.shape}: {array}."
        )
    return array
