"""Says when the reward scale is computed and when the networks are reset; how is the model's business."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, cast

from stable_baselines3.common.callbacks import BaseCallback

from sb3_ars.errors import ConfigError, check_verbose
from sb3_ars.nets.lora import LoRAConfig

if TYPE_CHECKING:
    from sb3_ars.algorithms.multi_task import MultiTaskOffPolicyAlgorithm

__all__ = ["ARSCallback", "update_scale_and_networks"]


class ARSCallback(BaseCallback):
    """Algorithm 1's bookkeeping, installed by ``learn()`` unless a callback of this class is passed.

    After the random phase it has c_i computed; at each reset time it has c_i recomputed from the whole buffers, the
    networks reset, and ``updates_after_reset`` gradient steps done. Everything happens between two rollouts, where the
    newest transition is stored. What it remembers lives on the model, so it survives saving.

    To change the schedule, subclass it and override :meth:`reset_is_due` or :meth:`reset`.

    :param verbose: 1 prints each reset and the scales
    """

    def __init__(self, verbose: int = 0) -> None:
        super().__init__(check_verbose("verbose", verbose))
        self.reset_times: list[int] = []

    @property
    def algorithm(self) -> MultiTaskOffPolicyAlgorithm:
        """The model, typed."""
        return cast("MultiTaskOffPolicyAlgorithm", self.model)

    def _init_callback(self) -> None:
        if not hasattr(self.model, "reward_scale_history"):
            raise ConfigError(
                f"{type(self).__name__} is the bookkeeping of ARSSAC and ARSTQC; a {type(self.model).__name__} scales "
                "no rewards and has no resets. Leave it out, or train one of those."
            )

    def _on_training_start(self) -> None:
        model = self.algorithm
        self.verbose = max(self.verbose, model.verbose)
        if model.num_timesteps == 0:
            model.resets_looked_for_until = 0
            model.reward_scale_history = model.reward_scale_history[-1:] and [
                (0, model.reward_scale_history[-1][1])
            ]
        self.reset_times = model.config.reset_times(model._total_timesteps, model.n_tasks)
        self._check_reset_times()

    def _check_reset_times(self) -> None:
        model, times = self.algorithm, self.reset_times
        if model.lora is not None and not model.lora_is_enabled:
            start = self._lora_start(LoRAConfig.of(model.lora))
            if not times or times[-1] < start:
                raise ConfigError(
                    f"lora adds its adapters at the first reset from step {start} on (lora option start), but the "
                    f"resets are at {times}. Lower start, reset more often, or name the steps with param_resets."
                )
        if not times:
            return
        if times[0] <= model.learning_starts or len(set(times)) < len(times):
            option, never = ("n_reset", "0") if model.param_resets is None else ("param_resets", "[]")
            raise ConfigError(
                f"{option} asks for {len(times)} resets in {model._total_timesteps} steps, the first at step "
                f"{times[0]}, but the random phase alone takes {model.learning_starts} steps (learning_starts). "
                f"Train longer, reset less often ({option}={never} for never), or set learning_starts."
            )
        if times[-1] >= model._total_timesteps:
            warnings.warn(
                f"param_resets={times} reaches beyond this call's {model._total_timesteps} steps; those resets do not "
                "happen in it.",
                stacklevel=2,
            )

    def _on_rollout_start(self) -> None:
        model = self.algorithm
        due = self.reset_is_due()
        model.resets_looked_for_until = model.num_timesteps
        if due and not model.has_batch():
            warnings.warn(
                f"The reset due at step {model.num_timesteps} is left out: without the replay buffer, fresh networks "
                "would have nothing to learn from. Load it with load_replay_buffer.",
                stacklevel=2,
            )
        elif due:
            self.reset()

    def _on_rollout_end(self) -> None:
        model = self.algorithm
        has_scale = model.scaled_by == repr(model.reward_scaling)
        if not has_scale and model.num_timesteps > model.learning_starts and model.has_batch():
            model.update_reward_scale()  # Algorithm 1, line 8
            self._print_scale("after the random phase")

    def _on_step(self) -> bool:
        return True

    def reset_is_due(self) -> bool:
        """Return whether a reset time has come since this was last asked.

        Times that passed unasked are left: a run continued over a longer total has its times spaced anew, and some
        of them may lie in its past.
        """
        model = self.algorithm
        return any(model.resets_looked_for_until < time <= model.num_timesteps for time in self.reset_times)

    def lora_is_due(self) -> bool:
        """Return whether this reset adds adapters instead: late enough, and with enough training success.

        Deviation: the authors' code asks the latest evaluation, which a run here need not have.
        """
        model = self.algorithm
        if model.lora is None or model.lora_is_enabled:
            return False
        config = LoRAConfig.of(model.lora)
        if model.num_timesteps < self._lora_start(config):
            return False
        success = model.mean_success()
        if config.min_success == 0 or success >= config.min_success:
            return True
        is_last = model.num_timesteps >= self.reset_times[-1]
        then = "no reset is left, so there will be none" if is_last else "the networks are reset instead"
        warnings.warn(
            f"The adapters of lora are due at step {model.num_timesteps}, but the mean training success is "
            f"{success:.2f}, not min_success={config.min_success}: {then}. Tasks that report no success need "
            "min_success=0.",
            stacklevel=3,
        )
        return False

    def _lora_start(self, config: LoRAConfig) -> int:
        return int(config.start * self.algorithm._total_timesteps)

    def reset(self) -> None:
        """Reset the networks, recompute c_i, do the extra updates (Algorithm 1, lines 14 to 17).

        Late in a run with ``lora`` the networks are not reset but adapted: adapters are added the first time, and start
        afresh every time after.
        """
        model = self.algorithm
        if self.lora_is_due():
            model.enable_lora()
            event = "adapters added"
        else:
            event = "adapters renewed" if model.lora_is_enabled else f"reset {model.n_resets + 1}"
            model.reset_networks()
        update_scale_and_networks(model)
        self._print_scale(event)

    def _print_scale(self, event: str) -> None:
        model = self.algorithm
        if self.verbose < 1 or not model.is_multi_task:
            return
        scales = zip(model.task_names or [], model.reward_scale.scale.tolist(), strict=True)
        print(f"Step {model.num_timesteps:,}, {event}: " + ", ".join(f"{n} c={c:.3g}" for n, c in scales))


def update_scale_and_networks(model: MultiTaskOffPolicyAlgorithm) -> None:
    """Do what follows a reset: recompute c_i, then the extra updates.

    :param model: whose networks were just reset
    """
    try:
        model.update_reward_scale()
    except ConfigError as error:  # a day of training is not thrown away because a mean turned negative
        warnings.warn(f"The reward scales stay as they were. {error}", stacklevel=2)
    if model.config.resets() and model.updates_after_reset > 0:
        model.train(gradient_steps=model.updates_after_reset, batch_size=model.batch_size)
