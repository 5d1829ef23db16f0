"""A shared trunk with one output layer per task; knows no losses."""

from __future__ import annotations

import torch as th

from sb3_ars.nets.layers import Body, BodyShape, TaskLinear, trunk

__all__ = ["MultiHead"]


class MultiHead(Body):
    """y = W_i h + b_i, where h is the trunk's output and i the row's task.

    :param shape: ``hidden`` is the trunk
    :param task_in_input: whether the trunk sees the one-hot too

    Source: the multi-task, multi-head SAC of Yu et al. 2019 (Meta-World). The one-hot stays in the input, as in the
    authors' code of ARS and in Soft Modularization's.
    """

    def __init__(
        self,
        shape: BodyShape,
        task_in_input: bool = True,
    ) -> None:
        super().__init__(task_in_input)
        in_features, out_features, n_tasks, hidden, activation, layer_norm = shape
        in_features += n_tasks * task_in_input
        self.trunk = trunk(in_features, hidden, activation, layer_norm)
        self.heads = TaskLinear([in_features, *hidden][-1], out_features, n_tasks)

    def compute(self, x: th.Tensor, task: th.Tensor, task_major: bool) -> th.Tensor:
        """Return ``(rows, out_features)``; see :meth:`Body.compute`."""
        out: th.Tensor = self.heads(self.trunk(x), task, task_major)
        return out
