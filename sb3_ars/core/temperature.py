"""The entropy temperatures alpha_i: one learned number per task, or a fixed one."""

from __future__ import annotations

import torch as th

__all__ = ["per_row", "temperature_loss", "temperature_weight"]


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


def per_row(per_task: th.Tensor, n_rows: int) -> th.Tensor:
    """Return each row's number, ``(n_rows, 1)``, from ``(n_tasks,)`` or a scalar; rows are task-major."""
    return per_task.view(-1, 1, 1).expand(-1, n_rows // per_task.numel(), 1).reshape(n_rows, 1)


def temperature_weight(ent_coef: th.Tensor) -> th.Tensor:
    """Return w_i = N softmax_i(-lambda_i), lambda_i = log alpha_i, whose mean is 1: an uncertain task weighs less.

    :param ent_coef: alpha_i, ``(n_tasks,)``, positive
    :return: ``(n_tasks,)``

    Source: Yang et al. 2020, section 4.3, with the sign and the factor N that only their code shows.
    """
    # w_i = N exp(-lambda_i) / sum_j exp(-lambda_j)
    return len(ent_coef) * th.softmax(-ent_coef.log(), dim=0)
