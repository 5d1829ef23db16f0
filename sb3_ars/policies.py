"""Actor and critics of the paper behind SB3's policy classes and attribute names; knows nothing of tasks or scales."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Literal

import torch as th
from gymnasium import spaces
from sb3_contrib.tqc.policies import Actor as TQCActor
from sb3_contrib.tqc.policies import Critic as QuantileCritic
from sb3_contrib.tqc.policies import TQCPolicy
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    NatureCNN,
    get_actor_critic_arch,
)
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN, Actor, SACPolicy
from torch import nn

from sb3_ars.errors import ConfigError, check_count, check_flag
from sb3_ars.nets.bodies import body_config, build_body
from sb3_ars.nets.layers import ByTask
from sb3_ars.nets.lora import LoRAConfig, LoRALinear, TaskOfRows, adapters, add_adapters, renew_adapters
from sb3_ars.nets.mlp import MLP, with_layer_norm, xavier_

__all__ = [
    "ARSSACPolicy",
    "ARSTQCPolicy",
    "SACCnnPolicy",
    "SACMultiInputPolicy",
    "TQCCnnPolicy",
    "TQCMultiInputPolicy",
]

StdParametrization = Literal["exp", "softplus"]
WeightInit = Literal["torch", "xavier"]

_SOFTPLUS_STD_MIN = 1e-5  # the authors' code adds it to the softplus


class _Network:
    """Mixin for actors and critics: they change modes quickly, and may get adapters per task."""

    task_of_rows: TaskOfRows | None = None
    n_tasks: int = 1

    def set_training_mode(self, mode: bool) -> None:
        """Put the network in training or evaluation mode, as SB3 does.

        SB3 2.9.2 (common/policies.py) calls ``Module.train``, three times a vector step for actor and critics: on a
        GPU more of the step's Python than anything else. This sets the same flags in a tenth of the time.

        :param mode: true for training
        """
        assert isinstance(self, nn.Module)
        _set_training_(self, mode)

    def add_adapters(self, config: LoRAConfig, n_tasks: int) -> None:
        """Freeze the network and add adapters to it; its outputs stay.

        :param config: options
        :param n_tasks: how many of an observation's last entries are the one-hot
        """
        assert isinstance(self, nn.Module)
        self.task_of_rows, self.n_tasks = add_adapters(self, config, n_tasks), n_tasks

    def _task(self, obs: Any) -> th.Tensor:
        one_hot: th.Tensor = obs[:, -self.n_tasks :]
        return one_hot

    def _told_of_tasks(self, obs: Any, task_major: bool) -> AbstractContextManager[None]:
        """Return a context in which the adapters know each row's task."""
        if self.task_of_rows is None or task_major:
            return nullcontext()
        return self.task_of_rows.rows(self._task(obs))


class _TaskActor(_Network):
    """Mixin for SB3's actors: a choice of how the standard deviation is parametrised, and of a body that sees tasks."""

    std: StdParametrization = "exp"

    def action_distribution(self, obs: PyTorchObs, task_major: bool = False) -> tuple[th.Tensor, th.Tensor]:
        """Return mean and log standard deviation before squashing, each ``(rows, action_dim)``.

        :param obs: ``(rows, obs_dim)``
        :param task_major: whether the rows are task-major with equal counts, as in training batches
        """
        assert isinstance(self, (Actor, TQCActor)) and callable(self.log_std)
        features = self.extract_features(obs, self.features_extractor)
        if isinstance(self.latent_pi, ByTask):
            mean, rho = self.latent_pi(features, task_major).chunk(2, dim=1)
        else:
            with self._told_of_tasks(obs, task_major):
                latent = self.latent_pi(features)
                mean, rho = self.mu(latent), self.log_std(latent)
        if self.std == "exp":
            return mean, th.clamp(rho, LOG_STD_MIN, LOG_STD_MAX)
        return mean, (nn.functional.softplus(rho) + _SOFTPLUS_STD_MIN).log()

    def get_action_dist_params(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor, dict[str, th.Tensor]]:
        return *self.action_distribution(obs), {}


class ARSSACActor(_TaskActor, Actor):
    """SB3's SAC actor with our options."""


class ARSTQCActor(_TaskActor, TQCActor):
    """sb3-contrib's TQC actor with our options."""


class _TaskCritic(_Network):
    """Mixin for SB3's critics: all values as one tensor."""

    value_scale: th.Tensor | None  # (n_tasks,), with adapters: c_i now over c_i when the base was frozen

    def q_values(self, obs: PyTorchObs, actions: th.Tensor, task_major: bool = False) -> th.Tensor:
        """Return ``(rows, n_critics, n_outputs)``.

        :param obs: ``(rows, obs_dim)``
        :param actions: ``(rows, action_dim)``
        :param task_major: whether the rows are task-major with equal counts, as in training batches
        """
        assert isinstance(self, (ContinuousCritic, QuantileCritic))
        with th.set_grad_enabled(th.is_grad_enabled() and not self.share_features_extractor):
            features = self.extract_features(obs, self.features_extractor)
        x = th.cat([features, actions], dim=1)
        with self._told_of_tasks(obs, task_major):
            values = [net(x, task_major) if isinstance(net, ByTask) else net(x) for net in self.q_networks]
        if self.value_scale is not None:
            of_row = (self._task(obs) * self.value_scale).sum(dim=1, keepdim=True)
            values = [value * of_row for value in values]
        return self._stacked(values)

    def _stacked(self, values: list[th.Tensor]) -> th.Tensor:
        raise AssertionError(
            "a subclass stacks as its parent does, for the order of sums is seen in the last bit"
        )


class ARSSACCritic(_TaskCritic, ContinuousCritic):
    """SB3's critics, whose values can also be had as one tensor."""

    def _stacked(self, values: list[th.Tensor]) -> th.Tensor:
        # critic by critic, so that each critic's gradient is contiguous and sums in SB3's order
        return th.stack(values, dim=0).transpose(0, 1)

    def forward(self, obs: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        """Return each critic's values, ``(rows, 1)``, as SB3 does."""
        return self.q_values(obs, actions).unbind(dim=1)

    def q1_forward(self, obs: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """Return the first critic's values, ``(rows, 1)``, as SB3 does."""
        return self.q_values(obs, actions)[:, 0]


class ARSTQCCritic(_TaskCritic, QuantileCritic):
    """sb3-contrib's quantile critics under the name the update knows."""

    def _stacked(self, values: list[th.Tensor]) -> th.Tensor:
        return th.stack(values, dim=1)

    def forward(self, obs: PyTorchObs, action: th.Tensor) -> th.Tensor:
        """Return ``(rows, n_critics, n_quantiles)``, as sb3-contrib does."""
        return self.q_values(obs, action)


def _set_training_(network: nn.Module, mode: bool) -> None:
    """Do ``network.train(mode)``; a module that does this in its own way, such as a scripted one, still does."""
    train, assign = nn.Module.train, nn.Module.__setattr__
    modules: list[nn.Module | None] = [network]
    for module in modules:  # it grows meanwhile
        if module is None:
            continue
        kind = type(module)
        if kind.train is not train or kind.__setattr__ is not assign or "train" in module.__dict__:
            module.train(mode)
            continue
        if module.training is not mode:
            # not through Module.__setattr__, which first asks whether a bool is a parameter, a module or a buffer
            object.__setattr__(module, "training", mode)
        modules += module._modules.values()


class _PolicyOptions:
    """The options both policies share, on top of SB3's own.

    :param observation_space: observation space
    :param action_space: action space
    :param lr_schedule: learning rate schedule
    :param net_arch: hidden layers, SB3's meaning; ``None`` is the paper's ``[400, 400, 400, 400]``, or the body's own
    :param activation_fn: of actor and critics, SB3's meaning; ``None`` is the paper's ReLU actor and Tanh critics
    :param critic_activation_fn: of the critics alone
    :param critic_layer_norm: LayerNorm on the input and hidden layers of the critics (ARS-LN)
    :param std: ``"exp"`` of a clipped log standard deviation (SB3) or ``"softplus"`` (the authors' code)
    :param weight_init: ``"torch"`` or ``"xavier"`` (the authors' code)
    :param body: a multi-task network in the place of the plain one, such as ``{"name": "moore", "n_experts": 4}``; see
        :mod:`sb3_ars.nets.bodies`
    :param critic_body: the same for the critics; ``"same"`` is ``body``, ``None`` the plain network
    :param n_tasks: how many of an observation's last entries are the one-hot; the algorithm sets it
    :param lora: adapters on frozen networks, :class:`~sb3_ars.nets.lora.LoRAConfig`'s fields; the algorithm sets it
        once they are enabled, so that a saved model loads with them
    :param kwargs: SB3's remaining policy options

    Source: paper, Table 8 and section 4.3.
    """

    actor_class: type[Actor]
    critic_class: type[nn.Module]

    # SB3's, which __init__ makes
    actor: Any
    critic: Any
    critic_target: Any
    optimizer_class: type[th.optim.Optimizer]
    optimizer_kwargs: dict[str, Any]

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] | None = None,
        critic_activation_fn: type[nn.Module] | None = None,
        critic_layer_norm: bool = False,
        std: StdParametrization = "exp",
        weight_init: WeightInit = "torch",
        body: dict[str, Any] | None = None,
        critic_body: dict[str, Any] | Literal["same"] | None = "same",
        n_tasks: int = 1,
        lora: Mapping[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        for option, value, allowed in (
            ("std", std, ("exp", "softplus")),
            ("weight_init", weight_init, ("torch", "xavier")),
        ):
            if value not in allowed:
                raise ConfigError(
                    f"policy option {option}={value!r} is unknown; choose one of {list(allowed)}."
                )
        check_flag("policy option critic_layer_norm", critic_layer_norm)
        for option, activation in (
            ("activation_fn", activation_fn),
            ("critic_activation_fn", critic_activation_fn),
        ):
            if activation is not None and not (
                isinstance(activation, type) and issubclass(activation, nn.Module)
            ):
                raise ConfigError(
                    f"policy option {option}={activation!r} must be a class of torch.nn, such as nn.ReLU, or None."
                )
        _check_net_arch(net_arch)
        for option in ("n_critics", "n_quantiles"):
            if option in kwargs:
                check_count(f"policy option {option}", kwargs[option])
        # SB3 builds the networks inside __init__, so what they depend on is set first
        self.critic_layer_norm = critic_layer_norm
        self.std: StdParametrization = std
        self.weight_init: WeightInit = weight_init
        self.body, self.n_tasks = body, n_tasks
        self.critic_body: Any = body if critic_body == "same" else critic_body
        if net_arch is None:
            net_arch = [400, 400, 400, 400] if body is None else list(body_config(body).net_arch)
        self.lora: dict[str, Any] | None = None
        _check_bodies(self.body, self.critic_body, lora)
        self._given_activations = (activation_fn, critic_activation_fn)
        self._critic_activation_fn = critic_activation_fn or activation_fn or nn.Tanh
        try:
            super().__init__(
                observation_space,  # type: ignore[call-arg]  # SB3's policy comes next in the order of classes
                action_space,
                lr_schedule,
                net_arch=net_arch,
                activation_fn=activation_fn or nn.ReLU,
                **kwargs,
            )
        except TypeError as error:  # a name that is no option, of the policy, its optimizer or its extractor
            raise ConfigError(f"policy_kwargs={kwargs!r} make no policy: {error}.") from error
        if lora is not None:
            self.enable_lora(lora)

    def enable_lora(self, options: Mapping[str, Any]) -> None:
        """Freeze actor, critics and target critics, add adapters, and give new optimizers those alone.

        Outputs stay as they are. The target critics start with the critics' A, for B A moves slowly only from one A.

        :param options: fields of :class:`~sb3_ars.nets.lora.LoRAConfig`
        :raises ConfigError: for wrong options, networks other than the plain one, or adapters that are there already
        """
        config = LoRAConfig.of(options)
        _check_bodies(self.body, self.critic_body, options)
        for network in (self.actor, self.critic, self.critic_target):
            network.add_adapters(config, self.n_tasks)
        for critic in (self.critic, self.critic_target):
            if config.rescale_critic:
                critic.value_scale = th.ones(self.n_tasks, device=self.device)  # type: ignore[attr-defined]  # SB3's
        self.lora = dict(options)
        self._share_adapters()
        for network in (self.actor, self.critic):
            lr = float(network.optimizer.param_groups[0]["lr"])
            network.optimizer = self.optimizer_class(adapters(network), lr=lr, **self.optimizer_kwargs)  # type: ignore[call-arg]  # every optimizer but the base class has lr

    def renew_lora(self) -> None:
        """Give the adapters fresh values in place: the networks are their frozen base again."""
        for network in (self.actor, self.critic, self.critic_target):
            renew_adapters(network)
        self._share_adapters()

    @th.no_grad()
    def _share_adapters(self) -> None:
        """Give the target critics the critics' A."""
        pairs = zip(self.critic.modules(), self.critic_target.modules(), strict=True)
        for layer, target in pairs:
            if isinstance(layer, LoRALinear):
                target.lora_a.copy_(layer.lora_a)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)  # type: ignore[attr-defined]
        actor: Any = self.actor_class(**kwargs)
        actor.std = self.std
        if self.body is None:
            actor.latent_pi = MLP(*actor.latent_pi)
        else:
            actor.latent_pi = self._by_task(self.body, actor, 2 * self._action_dim())
            actor.mu, actor.log_std = nn.Identity(), nn.Identity()
        if self.weight_init == "xavier":
            xavier_(actor)
        return actor.to(self.device)  # type: ignore[attr-defined]

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)  # type: ignore[attr-defined]
        critic: Any = self.critic_class(**{**kwargs, "activation_fn": self._critic_activation_fn})
        critic.q_networks = [self._critic_network(critic, net) for net in critic.q_networks]
        critic.register_buffer("value_scale", None)
        for index, net in enumerate(critic.q_networks):
            setattr(critic, f"qf{index}", net)
        if self.weight_init == "xavier":
            xavier_(critic)
        return critic.to(self.device)  # type: ignore[attr-defined]

    def _critic_network(self, critic: Any, net: nn.Sequential) -> nn.Module:
        if self.critic_body is not None:
            return self._by_task(self.critic_body, critic, net[-1].out_features)  # type: ignore[arg-type]
        return with_layer_norm(net) if self.critic_layer_norm else MLP(*net)

    def _action_dim(self) -> int:
        return get_action_dim(self.action_space)  # type: ignore[attr-defined]

    def _by_task(self, body: dict[str, Any], owner: Any, out_features: int) -> ByTask:
        """Return a body in the place of a plain network of SB3's actor or critics."""
        is_actor = isinstance(owner, self.actor_class)
        obs_dim = owner.features_extractor.features_dim - self.n_tasks
        n_actions = 0 if is_actor else self._action_dim()
        actor_arch, critic_arch = get_actor_critic_arch(self.net_arch)  # type: ignore[attr-defined]
        network = build_body(
            body,
            obs_dim + n_actions,
            out_features,
            self.n_tasks,
            actor_arch if is_actor else critic_arch,
            self.activation_fn if is_actor else self._critic_activation_fn,  # type: ignore[attr-defined]
            layer_norm=self.critic_layer_norm and not is_actor,
        )
        return ByTask(network, obs_dim, self.n_tasks)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data: dict[str, Any] = super()._get_constructor_parameters()  # type: ignore[misc]
        activation_fn, critic_activation_fn = self._given_activations
        data.update(
            activation_fn=activation_fn,
            critic_activation_fn=critic_activation_fn,
            critic_layer_norm=self.critic_layer_norm,
            std=self.std,
            weight_init=self.weight_init,
            body=self.body,
            critic_body=self.critic_body,
            n_tasks=self.n_tasks,
            lora=self.lora,
        )
        return data


def _check_net_arch(net_arch: Any) -> None:
    """Refuse what is neither None, a list of widths, nor one for each of actor (pi) and critics (qf)."""
    arches = net_arch.values() if isinstance(net_arch, Mapping) else [net_arch]
    if isinstance(net_arch, Mapping) and set(net_arch) != {"pi", "qf"}:
        raise ConfigError(
            f"policy option net_arch={net_arch!r} must have the keys 'pi' and 'qf', or be a list."
        )
    for arch in arches:
        if arch is not None and not isinstance(arch, list if arch is net_arch else list | tuple):
            raise ConfigError(
                f"policy option net_arch={net_arch!r} must be a list of widths, such as [400, 400]."
            )
        for width in arch or ():
            check_count("policy option net_arch entry", width)


def _check_bodies(
    body: Mapping[str, Any] | None, critic_body: Mapping[str, Any] | None, lora: Mapping[str, Any] | None
) -> None:
    for given in (body, critic_body):
        if given is not None:
            body_config(given)
    if body is not None and body.get("name") == "popart":
        raise ConfigError(
            "body='popart' is an output layer of critics; give it as critic_body, and leave body None."
        )
    if lora is not None and (body is not None or critic_body is not None):
        raise ConfigError(
            f"lora adapts the plain network's linear layers, but body={body!r} and critic_body={critic_body!r} have "
            "parameters of other kinds, which would stay frozen. Use lora with the plain network."
        )


class ARSSACPolicy(_PolicyOptions, SACPolicy):
    """SB3's SAC policy with the paper's networks."""

    __doc__ = f"{__doc__}\n{_PolicyOptions.__doc__}"
    actor_class = ARSSACActor
    critic_class = ARSSACCritic


class ARSTQCPolicy(_PolicyOptions, TQCPolicy):
    """sb3-contrib's TQC policy with the paper's networks."""

    __doc__ = f"{__doc__}\n{_PolicyOptions.__doc__}"
    actor_class = ARSTQCActor  # type: ignore[assignment]  # contrib repeats SB3's Actor instead of sharing it
    critic_class = ARSTQCCritic


class SACCnnPolicy(ARSSACPolicy):
    """For images, one task only."""

    def __init__(self, *args: Any, features_extractor_class: Any = NatureCNN, **kwargs: Any) -> None:
        super().__init__(*args, features_extractor_class=features_extractor_class, **kwargs)


class SACMultiInputPolicy(ARSSACPolicy):
    """For dictionaries of observations, one task only."""

    def __init__(self, *args: Any, features_extractor_class: Any = CombinedExtractor, **kwargs: Any) -> None:
        super().__init__(*args, features_extractor_class=features_extractor_class, **kwargs)


class TQCCnnPolicy(ARSTQCPolicy):
    """For images, one task only."""

    def __init__(self, *args: Any, features_extractor_class: Any = NatureCNN, **kwargs: Any) -> None:
        super().__init__(*args, features_extractor_class=features_extractor_class, **kwargs)


class TQCMultiInputPolicy(ARSTQCPolicy):
    """For dictionaries of observations, one task only."""

    def __init__(self, *args: Any, features_extractor_class: Any = CombinedExtractor, **kwargs: Any) -> None:
        super().__init__(*args, features_extractor_class=features_extractor_class, **kwargs)
