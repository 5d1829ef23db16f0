"""Actor and critics of the paper behind SB3's policy classes and attribute names; knows nothing of tasks or scales."""

from __future__ import annotations

from typing import Any, Literal

import torch as th
from gymnasium import spaces
from sb3_contrib.tqc.policies import Actor as TQCActor
from sb3_contrib.tqc.policies import Critic as QuantileCritic
from sb3_contrib.tqc.policies import TQCPolicy
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, NatureCNN
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch import nn

from sb3_ars.errors import ConfigError
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


class _SoftplusStd:
    """Mixin for SB3's actors: the second head gives softplus(rho) + 1e-5 as standard deviation."""

    std: StdParametrization = "exp"

    def get_action_dist_params(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor, dict[str, th.Tensor]]:
        if self.std == "exp":
            return super().get_action_dist_params(obs)  # type: ignore[misc,no-any-return]  # SB3's Actor comes next
        assert isinstance(self, (Actor, TQCActor)) and callable(self.log_std)
        latent = self.latent_pi(self.extract_features(obs, self.features_extractor))
        std = nn.functional.softplus(self.log_std(latent)) + _SOFTPLUS_STD_MIN
        return self.mu(latent), std.log(), {}


class ARSSACActor(_SoftplusStd, Actor):
    """SB3's SAC actor with a choice of how the standard deviation is parametrised."""


class ARSTQCActor(_SoftplusStd, TQCActor):
    """sb3-contrib's TQC actor with a choice of how the standard deviation is parametrised."""


class ARSSACCritic(ContinuousCritic):
    """SB3's critics, whose values can also be had as one tensor."""

    def q_values(self, obs: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """Return ``(rows, n_critics, 1)``."""
        # stacked critic by critic, so that each critic's gradient is contiguous and sums in SB3's order, to the bit
        return th.stack(self(obs, actions), dim=0).transpose(0, 1)


class ARSTQCCritic(QuantileCritic):
    """sb3-contrib's quantile critics under the name the update knows."""

    def q_values(self, obs: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """Return ``(rows, n_critics, n_quantiles)``."""
        quantiles: th.Tensor = self(obs, actions)
        return quantiles


class _PolicyOptions:
    """The options both policies share, on top of SB3's own.

    :param observation_space: observation space
    :param action_space: action space
    :param lr_schedule: learning rate schedule
    :param net_arch: hidden layers, SB3's meaning; ``None`` is the paper's ``[400, 400, 400, 400]``
    :param activation_fn: of actor and critics, SB3's meaning; ``None`` is the paper's ReLU actor and Tanh critics
    :param critic_activation_fn: of the critics alone
    :param critic_layer_norm: LayerNorm on the input and hidden layers of the critics (ARS-LN)
    :param std: ``"exp"`` of a clipped log standard deviation (SB3) or ``"softplus"`` (the authors' code)
    :param weight_init: ``"torch"`` or ``"xavier"`` (the authors' code)
    :param kwargs: SB3's remaining policy options

    Source: paper, Table 8 and section 4.3.
    """

    actor_class: type[Actor]
    critic_class: type[nn.Module]

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
        **kwargs: Any,
    ) -> None:
        for option, value, allowed in (
            ("std", std, ("exp", "softplus")),
            ("weight_init", weight_init, ("torch", "xavier")),
            ("critic_layer_norm", critic_layer_norm, (False, True)),
        ):
            if value not in allowed:
                raise ConfigError(
                    f"policy option {option}={value!r} is unknown; choose one of {list(allowed)}."
                )
        # SB3 builds the networks inside __init__, so what they depend on is set first
        self.critic_layer_norm = critic_layer_norm
        self.std: StdParametrization = std
        self.weight_init: WeightInit = weight_init
        self._given_activations = (activation_fn, critic_activation_fn)
        self._critic_activation_fn = critic_activation_fn or activation_fn or nn.Tanh
        super().__init__(
            observation_space,  # type: ignore[call-arg]  # SB3's policy comes next in the order of classes
            action_space,
            lr_schedule,
            net_arch=[400, 400, 400, 400] if net_arch is None else net_arch,
            activation_fn=activation_fn or nn.ReLU,
            **kwargs,
        )

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)  # type: ignore[attr-defined]
        actor = self.actor_class(**kwargs)
        actor.std = self.std  # type: ignore[assignment]  # nn.Module's attributes are typed as tensors and modules
        actor.latent_pi = MLP(*actor.latent_pi)
        if self.weight_init == "xavier":
            xavier_(actor)
        return actor.to(self.device)  # type: ignore[attr-defined]

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)  # type: ignore[attr-defined]
        critic: Any = self.critic_class(**{**kwargs, "activation_fn": self._critic_activation_fn})
        critic.q_networks = [
            with_layer_norm(net) if self.critic_layer_norm else MLP(*net) for net in critic.q_networks
        ]
        for index, net in enumerate(critic.q_networks):
            setattr(critic, f"qf{index}", net)
        if self.weight_init == "xavier":
            xavier_(critic)
        return critic.to(self.device)  # type: ignore[attr-defined]

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data: dict[str, Any] = super()._get_constructor_parameters()  # type: ignore[misc]
        activation_fn, critic_activation_fn = self._given_activations
        data.update(
            activation_fn=activation_fn,
            critic_activation_fn=critic_activation_fn,
            critic_layer_norm=self.critic_layer_norm,
            std=self.std,
            weight_init=self.weight_init,
        )
        return data


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
