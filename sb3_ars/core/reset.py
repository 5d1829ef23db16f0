"""The reset: live networks, optimizers and temperatures take fresh values in place; aliases stay valid."""

from __future__ import annotations

import torch as th

__all__ = ["reset_module_", "reset_optimizer_"]


@th.no_grad()
def reset_module_(live: th.nn.Module, fresh: th.nn.Module) -> None:
    """Copy every parameter and buffer of ``fresh`` into ``live``; the memory of ``live`` stays where it is.

    :param live: the module in use
    :param fresh: a newly built module of the same shape

    Source: paper, Algorithm 1, line 16; Nikishin et al. 2022.
    """
    for old, new in zip(live.state_dict().values(), fresh.state_dict().values(), strict=True):
        old.copy_(new)


@th.no_grad()
def reset_optimizer_(optimizer: th.optim.Optimizer) -> None:
    """Set the optimizer's moments and step counts to zero in place; learning rates and options stay.

    An optimizer that has not stepped yet has no state, and needs none.
    """
    for state in optimizer.state.values():
        for value in state.values():
            if isinstance(value, th.Tensor):
                value.zero_()
