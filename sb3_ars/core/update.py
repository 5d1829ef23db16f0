"""One gradient step of temperatures, critics, actor and targets: a pure function of its arguments.

It reads no counter, logger or generator, never waits for the device, and gives its metrics as tensors.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch as th

from sb3_ars.core.gradients import GradientCombiner, MeanGradient
from sb3_ars.core.objectives import Objective
from sb3_ars.core.reward_scale import RewardScale
from sb3_ars.core.targets import soft_target
from sb3_ars.core.temperature import per_row, temperature_loss, temperature_weight

__all__ = [
    "Batch",
    "Hyperparameters",
    "Metrics",
    "Noise",
    "Timer",
    "UpdateState",
    "squashed_gaussian",
    "update",
]


class Actor(Protocol):
    """What the update needs of an actor."""

    def action_distribution(self, obs: Any, task_major: bool = False) -> tuple[th.Tensor, th.Tensor]:
        """Return mean and log standard deviation before squashing, each ``(rows, action_dim)``.

        :param task_major: whether the rows are task-major with equal counts, which some networks are faster on
        """


class Critic(Protocol):
    """What the update needs of the critics."""

    def q_values(self, obs: Any, actions: th.Tensor, task_major: bool = False) -> th.Tensor:
        """Return ``(rows, n_critics, n_outputs)``; ``task_major`` as in :class:`Actor`."""

    def parameters(self) -> Iterable[th.Tensor]:
        """Return what the critic optimizer steps, in the same order in critics and target critics."""


class Batch(Protocol):
    """One batch, rows task-major with equal counts per task; SB3's ``ReplayBufferSamples`` fits."""

    @property
    def observations(self) -> Any:
        """``(rows, obs_dim)``, or SB3's dictionary of tensors."""

    @property
    def actions(self) -> th.Tensor:
        """``(rows, action_dim)``, in [-1, 1]."""

    @property
    def next_observations(self) -> Any:
        """Like ``observations``."""

    @property
    def dones(self) -> th.Tensor:
        """``(rows, 1)``, 1 for terminations, not for time limits."""

    @property
    def rewards(self) -> th.Tensor:
        """``(rows, 1)``, raw."""

    @property
    def discounts(self) -> th.Tensor | None:
        """``(rows, 1)`` for n-step returns, otherwise ``None``."""


class ValueNormalizer(Protocol):
    """Shift and scale of each task's values, moved with the targets: PopArt's."""

    @property
    def mean(self) -> th.Tensor:
        """``(n_tasks,)``, in units of the target."""

    @property
    def std(self) -> th.Tensor:
        """``(n_tasks,)``, positive."""

    @property
    def update_period(self) -> int:
        """Updates from one refresh to the next."""

    def update_(self, target: th.Tensor, refresh: bool) -> None:
        """Take in a batch's targets.

        :param target: ``(rows, m)``, task-major
        :param refresh: whether ``mean`` and ``std`` follow now
        """


class ParameterMixture(Protocol):
    """A network whose tasks mix shared parameters: PaCo's."""

    def reinitialize_(self, healthy: th.Tensor, uniform: th.Tensor) -> None:
        """Mix the parameters of tasks that are not healthy anew from those that are.

        :param healthy: ``(n_tasks,)``, bool
        :param uniform: ``(n_tasks, n_tasks)``, from U(0, 1)
        """


@dataclass
class UpdateState:
    """The tensors one update changes, all in place.

    :param actor: policy network
    :param critic: critics
    :param critic_target: their slowly moving copies
    :param actor_optimizer: steps the parameters it holds
    :param critic_optimizer: steps the parameters it holds
    :param log_ent_coef: ``(n_tasks,)`` lambda_i, or ``None`` where the temperature is fixed
    :param ent_coef: the fixed temperature, a scalar tensor; read only where ``log_ent_coef`` is ``None``
    :param ent_coef_optimizer: steps ``log_ent_coef``
    :param norm_statistics: running statistics of batch-norm layers in the critics
    :param norm_statistics_target: the same of the target critics
    :param normalizer: in whose units the critics learn; ``None`` is the target's own
    :param mixtures: networks in which a task left out of an update starts from others' parameters
    """

    actor: Actor
    critic: Critic
    critic_target: Critic
    actor_optimizer: th.optim.Optimizer
    critic_optimizer: th.optim.Optimizer
    log_ent_coef: th.Tensor | None
    ent_coef: th.Tensor | None
    ent_coef_optimizer: th.optim.Optimizer | None
    norm_statistics: Sequence[th.Tensor] = ()
    norm_statistics_target: Sequence[th.Tensor] = ()
    normalizer: ValueNormalizer | None = None
    mixtures: Sequence[ParameterMixture] = ()

    def __post_init__(self) -> None:
        self.critic_parameters: list[th.Tensor] = list(self.critic.parameters())
        self.target_parameters: list[th.Tensor] = list(self.critic_target.parameters())


@dataclass(frozen=True)
class Hyperparameters:
    """The numbers of one update.

    :param discount: gamma, in [0, 1]
    :param tau: weight of the new critics in the target, in (0, 1]
    :param target_entropy: H, in nats
    :param objective: SAC's or TQC's
    :param combiner: how the tasks' losses become one gradient, of the actor and of all critics together
    :param weight_by_temperature: whether a task's losses weigh N softmax(-lambda_i) instead of 1
    :param max_task_loss: a task whose critic loss is larger is left out of the update; ``None`` leaves none out
    """

    discount: float
    tau: float
    target_entropy: float
    objective: Objective
    combiner: GradientCombiner
    weight_by_temperature: bool = False
    max_task_loss: float | None = None


class Noise(NamedTuple):
    """All that is random in one update but the batch.

    :param action: ``(rows, action_dim)``, standard normal, for the actions at s
    :param next_action: the same at s'
    :param critic_order: ``(n_tasks, n_tasks)``, U(0, 1), or ``None`` for combiners that need none
    :param actor_order: the same for the actor's gradient
    :param mixture: the same for tasks left out; read only where there are ``mixtures``
    """

    action: th.Tensor
    next_action: th.Tensor
    critic_order: th.Tensor | None = None
    actor_order: th.Tensor | None = None
    mixture: th.Tensor | None = None


class Timer(Protocol):
    """Measures parts of a run; ``contextlib.nullcontext`` measures nothing."""

    def __call__(self, part: str, /) -> contextlib.AbstractContextManager[Any]:
        """Return a context in which the named part runs."""


class Metrics(NamedTuple):
    """What one update reports, detached and on the device."""

    actor_loss: th.Tensor  # ()
    critic_loss: th.Tensor  # ()
    ent_coef_loss: th.Tensor  # (), 0 where the temperature is fixed
    ent_coef: th.Tensor  # (n_tasks,) or (1,), the one used in this update
    q_value: (
        th.Tensor
    )  # (n_tasks,), mean of Q(s, a) over critics, outputs and the task's rows, in scaled reward
    left_out: th.Tensor  # (n_tasks,), 1 where the task's loss was too large for this update


def update(
    state: UpdateState,
    batch: Batch,
    noise: Noise,
    reward_scale: RewardScale,
    hyperparameters: Hyperparameters,
    update_target: bool = True,
    refresh_normalizer: bool = True,
    timer: Timer = contextlib.nullcontext,
) -> Metrics:
    """Change ``state`` by one gradient step on ``batch``.

    Order: temperatures, critics, actor (through the new critics, with the action sampled first), targets.

    :param state: changed in place
    :param batch: raw rewards
    :param noise: drawn by the caller
    :param reward_scale: c_i
    :param hyperparameters: constants
    :param update_target: whether the target critics move in this step
    :param refresh_normalizer: whether the normalizer's shift and scale move in this step
    :param timer: told which part is running: "actor", "critic", "targets"

    A task left out has weight 0 in both losses. Deviation from PaCo: what decides is the critics' loss alone, for the
    actor's comes after their step here.

    Source: paper, Eq. 3, 4 and 7; with one task, c = 1 and SB3's networks it is SB3's ``SAC.train``, or sb3-contrib's
    ``TQC.train``, to the bit.
    """
    objective, combiner = hyperparameters.objective, hyperparameters.combiner
    obs, next_obs, n_rows = batch.observations, batch.next_observations, batch.rewards.shape[0]
    n_tasks = reward_scale.scale.shape[0]
    # what needs a gradient is computed group by group: all rows at once, or for PCGrad each task's on their own
    groups = combiner.rows(n_rows, n_tasks)
    task_major = len(groups) == 1

    with timer("actor"):
        sampled = [
            squashed_gaussian(
                *state.actor.action_distribution(_rows(obs, group, n_rows), task_major), noise.action[group]
            )
            for group in groups
        ]
        log_prob = th.cat([log_prob for _, log_prob in sampled])
        ent_coef, ent_coef_loss = _step_temperature(state, log_prob, hyperparameters.target_entropy)
        row_ent_coef = per_row(ent_coef, n_rows)

    with timer("critic"):
        with th.no_grad():
            distribution = state.actor.action_distribution(next_obs, task_major=True)
            next_actions, next_log_prob = squashed_gaussian(*distribution, noise.next_action)
            next_q = state.critic_target.q_values(next_obs, next_actions, task_major=True)
            discount = hyperparameters.discount if batch.discounts is None else batch.discounts
            target = soft_target(
                batch.rewards,
                batch.dones,
                discount,
                objective.next_value(next_q),
                row_ent_coef,
                next_log_prob,
                reward_scale,
            )
            if state.normalizer is not None:
                state.normalizer.update_(target, refresh_normalizer)
        q = [
            state.critic.q_values(_rows(obs, group, n_rows), batch.actions[group], task_major)
            for group in groups
        ]
        if state.normalizer is None:
            errors = [objective.loss(values, target[group]) for values, group in zip(q, groups, strict=True)]
        else:
            mean, std = (per_row(x, n_rows) for x in (state.normalizer.mean, state.normalizer.std))
            target = (target - mean) / std
            errors = [
                objective.loss((values - mean[group, None]) / std[group, None], target[group])
                for values, group in zip(q, groups, strict=True)
            ]
        healthy, weight = _task_weight(errors, ent_coef, n_tasks, hyperparameters)
        losses = _weighted(errors, weight)
        critic_loss = _mean(losses)
        _step(state.critic_optimizer, losses, combiner, noise.critic_order)

    with timer("actor"):
        errors = []
        for group, (actions, own_log_prob) in zip(groups, sampled, strict=True):
            with _frozen(state.critic_parameters):
                q_pi = state.critic.q_values(_rows(obs, group, n_rows), actions, task_major)
            errors.append(row_ent_coef[group] * own_log_prob - objective.actor_value(q_pi))
        losses = _weighted(errors, weight)
        actor_loss = _mean(losses)
        _step(state.actor_optimizer, losses, combiner, noise.actor_order)

    with timer("targets"):
        if update_target:
            _move_target(state, hyperparameters.tau)
        if noise.mixture is not None:
            for mixture in state.mixtures:  # only now: a backward pass needs what the forward pass saw
                mixture.reinitialize_(healthy, noise.mixture)
    q_value = th.cat([values.detach() for values in q]).reshape(n_tasks, -1).mean(dim=1)
    return Metrics(actor_loss, critic_loss, ent_coef_loss, ent_coef, q_value, (~healthy).float())


def squashed_gaussian(mean: th.Tensor, log_std: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Return actions tanh(mean + std * noise) in [-1, 1] and their log probabilities.

    :param mean: ``(rows, action_dim)``
    :param log_std: ``(rows, action_dim)``
    :param noise: ``(rows, action_dim)``, standard normal
    :return: ``(rows, action_dim)`` and ``(rows, 1)``

    Source: SAC (Haarnoja et al. 2018), appendix C, with SB3's epsilon of 1e-6.
    """
    std = log_std.exp()
    gaussian = mean + noise * std
    actions = th.tanh(gaussian)
    # log pi = sum_d log N(u_d; mean_d, std_d) - log(1 - tanh(u_d)^2 + eps), torch's Normal term by term: same bits
    log_density = -((gaussian - mean) ** 2) / (2 * std**2) - std.log() - _LOG_SQRT_2_PI
    log_prob = log_density.sum(dim=1) - th.log(1 - actions**2 + 1e-6).sum(dim=1)
    return actions, log_prob.reshape(-1, 1)


_LOG_SQRT_2_PI = math.log(math.sqrt(2 * math.pi))


def _step_temperature(
    state: UpdateState, log_prob: th.Tensor, target_entropy: float
) -> tuple[th.Tensor, th.Tensor]:
    """Return the temperatures before the step, ``(n_tasks,)`` or ``(1,)``, and the loss of the step."""
    if state.log_ent_coef is None or state.ent_coef_optimizer is None:
        assert state.ent_coef is not None
        return state.ent_coef.reshape(1), th.zeros((), device=log_prob.device)
    ent_coef = th.exp(state.log_ent_coef.detach())
    loss = temperature_loss(state.log_ent_coef, log_prob, target_entropy)
    _step(state.ent_coef_optimizer, [loss], _MEAN)
    return ent_coef, loss.detach()


def _step(
    optimizer: th.optim.Optimizer,
    losses: Sequence[th.Tensor],
    combiner: GradientCombiner,
    order: th.Tensor | None = None,
) -> None:
    """Step the optimizer's own parameters; gradients of other parameters in the graph are not computed."""
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    gradients = combiner.combine(losses, parameters, order)
    for parameter, gradient in zip(parameters, gradients, strict=True):
        # Autograd may give a transposed view. Fused Adam reads it as if it were not one on the CPU (torch 2.13), and
        # refuses it on CUDA.
        parameter.grad = None if gradient is None else gradient.contiguous()
    optimizer.step()


@th.no_grad()
def _task_weight(
    errors: Sequence[th.Tensor], ent_coef: th.Tensor, n_tasks: int, hyperparameters: Hyperparameters
) -> tuple[th.Tensor, th.Tensor | None]:
    """Return whether each task's loss is small enough, ``(n_tasks,)`` bool, and its weight, ``None`` if all are 1."""
    weight = temperature_weight(ent_coef) if hyperparameters.weight_by_temperature else None
    if hyperparameters.max_task_loss is None:
        return th.ones(n_tasks, dtype=th.bool, device=ent_coef.device), weight
    healthy = _per_task(errors, n_tasks) <= hyperparameters.max_task_loss
    return healthy, healthy.float() if weight is None else weight * healthy


def _per_task(errors: Sequence[th.Tensor], n_tasks: int) -> th.Tensor:
    """Return each task's mean, ``(n_tasks,)``, from one tensor per group of rows."""
    of_group = n_tasks // len(errors)
    return th.cat([error.reshape(of_group, -1).mean(dim=1) for error in errors])


def _weighted(errors: Sequence[th.Tensor], weight: th.Tensor | None) -> list[th.Tensor]:
    """Return one loss per group of rows: the mean over its tasks of weight times mean error."""
    if weight is None:
        return [error.mean() for error in errors]
    losses = []
    for error, of_tasks in zip(errors, weight.chunk(len(errors)), strict=True):
        per_task = _per_task([error], len(of_tasks))
        losses.append((th.where(of_tasks > 0, per_task, 0.0) * of_tasks).mean())
    return losses


_MEAN = MeanGradient()  # a temperature sees one task alone: nothing to combine


def _mean(losses: Sequence[th.Tensor]) -> th.Tensor:
    detached = [loss.detach() for loss in losses]
    return detached[0] if len(detached) == 1 else th.stack(detached).mean()


def _rows(obs: Any, group: slice, n_rows: int) -> Any:
    """Return some rows of the observations; all of them also where they are SB3's dictionary."""
    return obs if group == slice(0, n_rows) else obs[group]


@contextlib.contextmanager
def _frozen(parameters: Sequence[th.Tensor]) -> Iterator[None]:
    """Record no gradient of these parameters: the actor's loss needs the critics' gradient by the action alone."""
    learned = [parameter for parameter in parameters if parameter.requires_grad]
    for parameter in learned:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in learned:
            parameter.requires_grad_(True)


@th.no_grad()
def _move_target(state: UpdateState, tau: float) -> None:
    # target = (1 - tau) target + tau critic
    th._foreach_mul_(state.target_parameters, 1 - tau)
    th._foreach_add_(state.target_parameters, state.critic_parameters, alpha=tau)
    for target, statistic in zip(state.norm_statistics_target, state.norm_statistics, strict=True):
        target.copy_(statistic)
