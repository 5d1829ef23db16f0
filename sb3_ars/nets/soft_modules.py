"""Soft Modularization: layers of modules whose outputs a routing network mixes, row by row; knows no losses."""

from __future__ import annotations

import torch as th
from torch import nn

from sb3_ars.nets.layers import Body, BodyShape, StackedLayerNorm, StackedLinear, trunk
from sb3_ars.nets.mlp import MLP

__all__ = ["SoftModules"]


class SoftModules(Body):
    """Modules m_(l,k) mixed by the probabilities P_l that a gate computes from observation and task.

    :param shape: ``hidden`` is the embedding of the observation, whose last width is D, its last activation the body's;
        ``activation`` stands wherever the publication has a ReLU; ``layer_norm`` leaves out the gate
    :param n_layers: L, layers of modules
    :param n_modules: n, modules in a layer
    :param module_width: d
    :param gate_width: g
    :param task_in_input: whether the modules' input sees the one-hot; the gate sees it in any case

    Source: Yang et al. 2020, section 4, with what only their code shows: the second layer of the gate, the activation
    on the embedding and after each mixture, and the routing from all earlier probabilities.
    """

    def __init__(
        self,
        shape: BodyShape,
        n_layers: int = 4,
        n_modules: int = 4,
        module_width: int = 128,
        gate_width: int = 256,
        task_in_input: bool = False,
    ) -> None:
        super().__init__(task_in_input)
        in_features, out_features, n_tasks, hidden, activation, layer_norm = shape
        in_features += n_tasks * task_in_input
        self.n_modules, self.activation = n_modules, activation()
        width = hidden[-1]
        # without the last activation, which the gate and the modules apply each to its own product
        self.embedding = MLP(*list(trunk(in_features, hidden, activation, layer_norm))[:-1])
        self.task_embedding = nn.Linear(n_tasks, width)
        self.gate = MLP(
            activation(), nn.Linear(width, gate_width), activation(), nn.Linear(gate_width, gate_width)
        )
        # layer l mixes for its n successors; the last one for the single output
        n_logits = [n_modules**2] * (n_layers - 1) + [n_modules]
        self.routing_in = nn.ModuleList(
            nn.Linear(layer * n_modules**2, gate_width) for layer in range(1, n_layers)
        )
        self.routing_out = nn.ModuleList(nn.Linear(gate_width, size) for size in n_logits)
        widths = [width] + [module_width] * n_layers
        self.layers = nn.ModuleList(
            StackedLinear(n_modules, widths[layer], module_width) for layer in range(n_layers)
        )
        n_norms = [n_modules] * (n_layers - 1) + [1]
        self.norms = nn.ModuleList(
            StackedLayerNorm(size, module_width) if layer_norm else nn.Identity() for size in n_norms
        )
        self.output = nn.Linear(module_width, out_features)

    def compute(self, x: th.Tensor, task: th.Tensor, task_major: bool) -> th.Tensor:
        """Return ``(rows, out_features)``; see :meth:`Body.compute`."""
        embedding = self.embedding(x)
        out = self.activation(embedding)
        for layer, norm, mixture in zip(self.layers, self.norms, self._routing(embedding, task), strict=True):
            # x_(l+1),j = ReLU(sum_k P_l[j, k] m_(l,k)(x_(l,k)))
            out = self.activation(norm(th.einsum("rjk,krd->jrd", mixture, layer(out))))
        value: th.Tensor = self.output(out[0])
        return value

    def routing(self, x: th.Tensor, task: th.Tensor) -> list[th.Tensor]:
        """Return P_1, ..., P_L, each ``(rows, destinations, n_modules)``, summing to 1 over the last dimension.

        :param x: ``(rows, in_features)``, with the one-hot where ``task_in_input``
        :param task: ``(rows, n_tasks)``
        """
        return self._routing(self.embedding(x), task)

    def _routing(self, embedding: th.Tensor, task: th.Tensor) -> list[th.Tensor]:
        gate = self.gate(embedding * self.task_embedding(task))
        mixtures = [self._probabilities(0, gate)]
        for layer, routing_in in enumerate(self.routing_in, start=1):
            earlier = th.cat([mixture.flatten(1) for mixture in mixtures], dim=1)
            mixtures.append(self._probabilities(layer, routing_in(earlier) * gate))
        return mixtures

    def _probabilities(self, layer: int, gate: th.Tensor) -> th.Tensor:
        logits: th.Tensor = self.routing_out[layer](self.activation(gate))
        return logits.view(len(logits), -1, self.n_modules).softmax(dim=2)
