"""Numbers that summarise success over tasks and seeds; plain NumPy and SciPy, knows no models or environments."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import stats

from sb3_ars.errors import ConfigError

__all__ = ["Interval", "bottom_k", "estr", "iqm", "iqm_interval"]

Array = npt.NDArray[np.float64]


class Interval(NamedTuple):
    """A point estimate and its confidence bounds, in the units of the scores."""

    estimate: float
    low: float
    high: float


def bottom_k(success: npt.ArrayLike, k: int) -> float:
    """Return the mean success over the k tasks with the lowest success.

    :param success: ``(n_tasks,)`` success rates in [0, 1]
    :param k: between 1 and n_tasks
    :raises ConfigError: if k is out of range or ``success`` is not one row of finite numbers

    Source: paper, section 5.1, Table 2.
    """
    rates = _checked("success", success, ndim=1)
    if not 1 <= k <= rates.size:
        raise ConfigError(f"k={k} must be between 1 and the number of tasks, {rates.size}.")
    return float(np.sort(rates)[:k].mean())


def estr(success: npt.ArrayLike, threshold: float) -> float:
    """Return the share of tasks whose success reaches the threshold: |{i : success_i >= delta}| / N.

    :param success: ``(n_tasks,)`` final success rates in [0, 1]
    :param threshold: delta, in [0, 1]
    :raises ConfigError: if ``success`` is not one row of finite numbers

    Source: paper, section 5.1, Eq. 8.
    """
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
