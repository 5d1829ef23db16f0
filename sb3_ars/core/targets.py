"""The critic's regression target, with scaled rewards (Eq. 7); the same for SAC and TQC."""

from __future__ import annotations

import torch as th

from sb3_ars.core.reward_scale import RewardScale

__all__ = ["soft_target"]


def soft_target(
    reward: th.Tensor,
    done: th.Tensor,
    discount: float | th.Tensor,
    next_value: th.Tensor,
    ent_coef: th.Tensor,
    next_log_prob: th.Tensor,
    reward_scale: RewardScale,
) -> th.Tensor:
    """Return c_i r + gamma (1 - done) (Q'(s', a') - alpha_i log pi(a'|s')).

    The scale acts on the reward alone: the entropy term keeps its own, learned, temperature.

    :param reward: ``(n_tasks * batch, 1)``, task-major, raw
    :param done: ``(n_tasks * batch, 1)``, 1 where the episode terminated (not where a time limit cut it)
    :param discount: gamma, or ``(n_tasks * batch, 1)`` for n-step returns
    :param next_value: ``(n_tasks * batch, m)``, m = 1 for SAC, the kept quantiles for TQC
    :param ent_coef: ``(1,)`` or ``(n_tasks * batch, 1)``
    :param next_log_prob: ``(n_tasks * batch, 1)``
    :param reward_scale: c_i
    :return: same shape as ``next_value``

    Source: paper, section 4.1, Eq. 7.
    """
    # y = c_i r + gamma (1 - done) (Q' - alpha_i log pi'), in SB3's order of operations so that it is SB3's to the bit
    soft_value = next_value - ent_coef * next_log_prob
    return reward_scale(reward) + (1 - done) * discount * soft_value
