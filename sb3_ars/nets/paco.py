"""PaCo: each task's parameters are its own mixture of shared parameter sets; knows no losses."""

from __future__ import annotations

from itertools import pairwise

import torch as th
from torch import nn

from sb3_ars.nets.layers import Body, BodyShape, StackedLinear, stacked_product

__all__ = ["PaCo"]


class PaCo(Body):
    """theta_i = Phi w_i in every layer.

    :param shape: ``hidden`` is the network; LayerNorm is one for all sets
    :param n_parameter_sets: K
    :param task_in_input: whether the input sees the one-hot; w_i carries the task in any case

    Source: Sun et al. 2022, section 3. The sets start equal and w from N(0, 1), as in the authors' code. Deviation:
    every network has its own w, stepped by its own optimizer, where the authors' code shares one among all networks.
    """

    def __init__(
        self,
        shape: BodyShape,
        n_parameter_sets: int = 5,
        task_in_input: bool = False,
    ) -> None:
        super().__init__(task_in_input)
        in_features, out_features, n_tasks, hidden, activation, layer_norm = shape
        widths = [in_features + n_tasks * task_in_input, *hidden, out_features]
        self.activation = activation()
        self.task_weights = nn.Parameter(th.randn(n_tasks, n_parameter_sets))  # w_i is row i
        self.layers = nn.ModuleList(
            StackedLinear(n_parameter_sets, width, next_width, identical=True)
            for width, next_width in pairwise(widths)
        )
        self.norms = nn.ModuleList(
            nn.LayerNorm(width) if layer_norm else nn.Identity() for width in widths[:-1]
        )

    def compute(self, x: th.Tensor, task: th.Tensor, task_major: bool) -> th.Tensor:
        """Return ``(rows, out_features)``; see :meth:`Body.compute`."""
        weights = None if task_major else task @ self.task_weights
        for index, (norm, layer) in enumerate(zip(self.norms, self.layers, strict=True)):
            assert isinstance(layer, StackedLinear)
            x = norm(x)
            x = self.activation(x) if index else x
            x = self._own_parameters(layer, x) if weights is None else self._own_outputs(layer, x, weights)
        return x

    @th.no_grad()
    def reinitialize_(self, healthy: th.Tensor, uniform: th.Tensor) -> None:
        """Give each unhealthy task's w a random convex combination of the healthy tasks', in place.

        Without a healthy task nothing changes.

        :param healthy: ``(n_tasks,)``, bool
        :param uniform: ``(n_tasks, n_tasks)``, from U(0, 1); row i are task i's unnormalised shares of the others

        Source: Sun et al. 2022, section 3.3: w_i = sum_j beta_j w_j, beta from U(0, 1) normalised to sum 1.
        """
        share = uniform * healthy
        total = share.sum(dim=1, keepdim=True)
        fresh = (share / th.where(total > 0, total, 1)) @ self.task_weights
        keep = healthy.unsqueeze(1) | (total <= 0)
        self.task_weights.copy_(th.where(keep, self.task_weights, fresh))

    def _own_parameters(self, layer: StackedLinear, x: th.Tensor) -> th.Tensor:
        """Mix parameters, then multiply: as many products per row as in one plain network."""
        n_tasks = self.task_weights.shape[0]
        weight = (self.task_weights @ layer.weight.flatten(1)).view(n_tasks, *layer.weight.shape[1:])
        bias = self.task_weights @ layer.bias
        x = x.view(n_tasks, -1, x.shape[1])
        return stacked_product(x, weight, bias, layer.fused, layer.precision).flatten(0, 1)

    @staticmethod
    def _own_outputs(layer: StackedLinear, x: th.Tensor, weights: th.Tensor) -> th.Tensor:
        """Multiply, then mix the sets' outputs: for rows in any order."""
        # sum_k w_ik (W_k x + b_k)
        out: th.Tensor = (layer(x) * weights.t().unsqueeze(2)).sum(dim=0)
        return out
