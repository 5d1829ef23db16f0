"""ARSSAC: SB3's SAC with the multi-task shell; names an objective and aliases, nothing else."""

from __future__ import annotations

from typing import ClassVar

from stable_baselines3 import SAC
from stable_baselines3.common.policies import BasePolicy

from sb3_ars.algorithms.multi_task import MultiTaskOffPolicyAlgorithm
from sb3_ars.core.objectives import Objective, SACObjective
from sb3_ars.policies import ARSSACPolicy, SACCnnPolicy, SACMultiInputPolicy

__all__ = ["ARSSAC"]


class ARSSAC(MultiTaskOffPolicyAlgorithm, SAC):
    """Soft Actor-Critic with adaptive reward scaling for several tasks (not Augmented Random Search).

    Arguments: :class:`~sb3_ars.algorithms.multi_task.MultiTaskOffPolicyAlgorithm`.

    Source: ARS: Adaptive Reward Scaling for Multi-Task RL (ICML 2025), Algorithm 1.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": ARSSACPolicy,
        "CnnPolicy": SACCnnPolicy,
        "MultiInputPolicy": SACMultiInputPolicy,
    }

    def _make_objective(self) -> Objective:
        return SACObjective(self.actor_value)
