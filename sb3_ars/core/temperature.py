"""The entropy temperatures alpha_i: one learned number per task, or a fixed one."""

from __future__ import annotations

import torch as th

__all__ = ["per_row", "temperature_loss"]


def temperature_loss(log_ent_coef: th.Tensor, log_prob: th.Tensor, target_entropy: float) -> th.Tensor:
    """Return the mean over tasks of -lambda_i (log pi + H), lambda_i = log alpha_i.

    Each lambda_i sees its own task's rows only.

    :param log_ent_coef: ``(n_tasks,)``, or ``(1,)`` for one temperature shared by all rows
    :param log_prob: ``(n_tasks * batch, 1)``, task-major
    :param target_entropy: H, in nats
    :return: scalar

    Source: SAC (Haarnoja et al. 2018b), section 5, in SB3's form (lambda_i for alpha_i). Deviation: one temperature per
    task, as every strong multi-task SAC has and the paper's equations leave open.
    """
    n_tasks = log_ent_coef.shape[0]
    # L = -mean_i lambda_i mean_b (log pi + H)
    return -(log_ent_coef.view(n_tasks, 1) * (log_prob.view(n_tasks, -1) + target_entropy).detach()).mean()


def per_row(ent_coef: th.Tensor, n_rows: int) -> th.Tensor:
    """Return each row's temperature, ``(n_rows, 1)``, from ``(n_tasks,)`` or a scalar."""
    return ent_coef.view(-1, 1, 1).expand(-1, n_rows // ent_coef.numel(), 1).reshape(n_rows, 1)
