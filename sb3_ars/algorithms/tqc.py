"""ARSTQC: sb3-contrib's TQC with the multi-task shell; names an objective, aliases and one argument more."""

from __future__ import annotations

from typing import Any, ClassVar

from sb3_contrib import TQC
from stable_baselines3.common.policies import BasePolicy

from sb3_ars.algorithms.multi_task import MultiTaskOffPolicyAlgorithm
from sb3_ars.core.objectives import Objective, TQCObjective
from sb3_ars.errors import ConfigError, check_count
from sb3_ars.policies import ARSTQCPolicy, TQCCnnPolicy, TQCMultiInputPolicy

__all__ = ["ARSTQC"]


class ARSTQC(MultiTaskOffPolicyAlgorithm, TQC):
    """Truncated Quantile Critics with adaptive reward scaling for several tasks.

    Arguments: :class:`~sb3_ars.algorithms.multi_task.MultiTaskOffPolicyAlgorithm`, and

    :param top_quantiles_to_drop_per_net: how many of the largest target quantiles each critic gives up

    Source: TQC (Kuznetsov et al. 2020) as in sb3-contrib; ARS (ICML 2025), Algorithm 1.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": ARSTQCPolicy,
        "CnnPolicy": TQCCnnPolicy,
        "MultiInputPolicy": TQCMultiInputPolicy,
    }

    def __init__(
        self,
        *args: Any,
        top_quantiles_to_drop_per_net: int = 2,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **{**kwargs, "_init_setup_model": False})
        self.top_quantiles_to_drop_per_net = top_quantiles_to_drop_per_net
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        super()._setup_model()
        n_quantiles, n_drop = self.critic.n_quantiles, self.top_quantiles_to_drop_per_net
        if check_count("top_quantiles_to_drop_per_net", n_drop, minimum=0) >= n_quantiles:
            raise ConfigError(
                f"top_quantiles_to_drop_per_net={n_drop} must be less than n_quantiles={n_quantiles}"
            )

    def _make_objective(self) -> Objective:
        n_drop = self.top_quantiles_to_drop_per_net * self.critic.n_critics
        return TQCObjective(n_drop, self.actor_value, fused=self._plan.execution == "fused")
