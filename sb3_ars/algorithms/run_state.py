"""All that a running model is, as plain values and tensors, and back; when and where it is written is not known here.

Exact at one moment alone: between two rollouts (``on_rollout_start``), where the newest transition is stored, all
updates are done and no step is under way.
"""

from __future__ import annotations

import importlib
import inspect
import random
import warnings
from collections.abc import Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecMonitor, VecNormalize

from sb3_ars.buffers import TaskReplayBuffer
from sb3_ars.errors import CheckpointError, ConfigError, EnvContractError, WorkerError
from sb3_ars.plain import pack, unpack

if TYPE_CHECKING:
    from sb3_ars.algorithms.multi_task import MultiTaskOffPolicyAlgorithm

__all__ = [
    "capture",
    "check_can_be_captured",
    "check_same_options",
    "constructor_arguments",
    "restore",
    "restore_pending",
]

COUNTERS = (
    "num_timesteps",
    "learning_starts",
    "n_resets",
    "resets_looked_for_until",
    "active_tasks",
    "schedule_state",
    "scaled_by",
    "reward_scale_history",
    "ep_info_buffer",
    "ep_success_buffer",
    "task_episodes",
    "_n_updates",
    "_episode_num",
    "_total_timesteps",
    "_num_timesteps_at_start",
    "_current_progress_remaining",
    "_auto_learning_starts",
    "_warned_of_waiting",
    "_last_obs",
    "_last_original_obs",
    "_last_episode_starts",
)
"""Attributes that change while a model learns, and are plain values or arrays."""

REBUILT = (
    *("policy", "actor", "critic", "critic_target", "replay_buffer", "reward_scale", "log_ent_coef"),
    *("ent_coef_optimizer", "ent_coef_tensor", "action_noise", "env", "action_space", "_task_log", "_logger"),
    *("batch_norm_stats", "batch_norm_stats_target", "lr_schedule", "start_time", "timer", "is_multi_task"),
    *("observation_space", "n_envs", "task_names", "task_of_env", "_vec_normalize_env", "_custom_logger"),
    *("_captured_actor", "_captured_updates", "_combiner", "_is_stepping", "_plan", "_stepping_env"),
    *("_update_state", "_updates_are_done", "_after_learn", "_to_restore", "rows_on_disk", "_last_dump_at"),
)
"""The others, options apart: captured below piece by piece, or made anew."""

_SESSION = (
    *("policy_class", "_stats_window_size", "device", "verbose", "tensorboard_log", "last_checkpoint"),
    *("use_sde", "sde_sample_freq", "use_sde_at_warmup"),
)
"""Those that are options under another name, of one session alone, or refused."""

_SAFE_MODULES = ("torch.nn.", "torch.optim.", "stable_baselines3.", "sb3_contrib.", "sb3_ars.")
_BUFFERS = (ReplayBuffer, DictReplayBuffer, NStepReplayBuffer)


# ---------------------------------------------------------------------- the whole


def check_can_be_captured(model: MultiTaskOffPolicyAlgorithm) -> None:
    """Raise if an exact checkpoint of the model is impossible; warn of what its environments lose.

    :param model: set up, with its environment
    :raises ConfigError: naming the option and the remedy
    """
    buffer = model.replay_buffer
    if type(buffer) not in (TaskReplayBuffer, *_BUFFERS):
        raise ConfigError(
            f"replay_buffer_class={type(buffer).__name__} has memory that a checkpoint does not know; leave it out, or "
            "save with model.save and model.save_replay_buffer instead."
        )
    if model.action_noise is not None:
        pack(_noise_state(model.action_noise), "action_noise")
    own = sorted(set(vars(model)) - {*COUNTERS, *REBUILT, *_SESSION, *_option_names(type(model))})
    attributes = f"{', '.join(own)} of {type(model).__name__} is not saved" if own else ""
    lost = [words for words in (_what_envs_lose(model.env), attributes) if words]
    if lost:
        warnings.warn(
            f"Checkpoints of this run are not exact: {'; '.join(lost)}. Everything else goes on where it stood.",
            stacklevel=3,
        )


def capture(model: MultiTaskOffPolicyAlgorithm, callback: BaseCallback | None) -> dict[str, Any]:
    """Return the state of a model between two rollouts, all but the rows of its task buffer; packed.

    :param model: whose tensors are not copied: write them before going on
    :param callback: of ``learn()``, whose state goes along
    """
    state = {
        "algorithm": type(model).__name__,
        "options": _options_of(model),
        "tasks": model.task_names,
        "counters": {name: getattr(model, name) for name in COUNTERS},
        "lora_is_enabled": model.lora_is_enabled,
        "networks": model.policy.state_dict(),
        "optimizers": [optimizer.state_dict() for optimizer in model._optimizers()],
        "log_ent_coef": model.log_ent_coef,
        "reward_scale": [model.reward_scale.scale, model.reward_scale.shift],
        "task_log": model._task_log.checkpoint_state(),
        "log": _log_state(model.logger) if hasattr(model, "_logger") else None,
        "action_noise": None if model.action_noise is None else _noise_state(model.action_noise),
        "callbacks": {key: found.checkpoint_state() for key, found in _stateful_callbacks(callback)},
        "replay": _replay_state(model.replay_buffer),
        "env": _env_state(model.env),
        "generators": _generator_states(model),
        "device": model.device.type,
    }
    packed: dict[str, Any] = pack(state, "state")
    return packed


def restore(
    model: MultiTaskOffPolicyAlgorithm, packed: Mapping[str, Any], given: Collection[str] = ()
) -> None:
    """Make a model, built with the same options, what it was when :func:`capture` looked; the task buffer is filled.

    :param model: with an environment made like the one before
    :param packed: what :func:`capture` returned
    :param given: options that were given anew, and stay
    :raises CheckpointError: if it does not fit this model
    """
    try:
        state = unpack(packed)
        _check_fits(model, state)
        _restore_learned(model, state)
        for name, value in state["counters"].items():
            if name.removeprefix("_auto_") in given:
                continue
            if name == "task_episodes":  # the log holds these very deques
                for episodes, saved in zip(model.task_episodes, value, strict=True):
                    episodes.extend(saved)
            else:
                setattr(model, name, value)
        _restore_replay(model.replay_buffer, state["replay"])
        model._to_restore = {key: state[key] for key in ("log", "callbacks", "action_noise")}
        _restore_env(model, state["env"])
        if state["device"] != model.device.type:
            warnings.warn(
                f"A run of a {state['device']} goes on on a {model.device.type}: with everything it learned, but its "
                "random numbers differ from here on.",
                stacklevel=3,
            )
        _restore_generators(model, state["generators"])  # last: all that came before may draw
    except (ConfigError, EnvContractError, WorkerError):
        raise
    except Exception as error:  # torch, NumPy and Python each have their own for values that do not fit
        raise CheckpointError(
            f"The checkpoint does not fit this model ({type(error).__name__}: {error}). Resume with the options, "
            "tasks and versions that it was made with."
        ) from error


def _check_fits(model: MultiTaskOffPolicyAlgorithm, state: Mapping[str, Any]) -> None:
    if state["algorithm"] != type(model).__name__:
        raise CheckpointError(f"This is a checkpoint of {state['algorithm']}; resume it with that class.")
    if state["tasks"] != model.task_names:
        raise CheckpointError(
            f"The checkpoint is of the tasks {state['tasks']}, the environment has {model.task_names}; make it with "
            "the same tasks in the same order."
        )


def _restore_learned(model: MultiTaskOffPolicyAlgorithm, state: Mapping[str, Any]) -> None:
    if state["lora_is_enabled"]:
        model.enable_lora()
    model.policy.load_state_dict(state["networks"])
    for optimizer, saved in zip(model._optimizers(), state["optimizers"], strict=True):
        optimizer.load_state_dict(saved)
    model._prepare_execution()  # the optimizers took over options of the machine that saved them
    if model.log_ent_coef is not None:
        with th.no_grad():
            model.log_ent_coef.copy_(state["log_ent_coef"])
    model.reward_scale.update_(*state["reward_scale"])
    model._task_log.restore_checkpoint_state(state["task_log"], model.device)


# ---------------------------------------------------------------------- options


def _options_of(model: MultiTaskOffPolicyAlgorithm) -> dict[str, Any]:
    """Return the constructor's arguments by name, as plain values; ``"missing"`` names those that are none.

    :param model: of ARSSAC or ARSTQC
    """
    found: dict[str, Any] = {"missing": []}
    for name in _option_names(type(model)):
        try:
            found[name] = pack(_encode(_option(model, name)), name)
        except TypeError:
            found["missing"].append(name)
    return found


def _option_names(cls: type[Any]) -> list[str]:
    """Return what a class's constructor takes, base classes' included, but for what is of one session alone."""
    names: dict[str, None] = {}
    for base in cls.__mro__:
        if base.__module__.startswith("sb3_ars.") and "__init__" in vars(base):
            parameters = inspect.signature(vars(base)["__init__"]).parameters.values()
            names |= {p.name: None for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)}
    session = ("self", "env", "device", "_init_setup_model", "verbose", "tensorboard_log")
    return [name for name in names if name not in session]


def check_same_options(model: MultiTaskOffPolicyAlgorithm, options: Mapping[str, Any]) -> None:
    """Raise unless a model was built with the options that were saved.

    :param model: built for the run
    :param options: of :func:`capture`, packed
    :raises CheckpointError: naming an option that differs
    """
    now = _options_of(model)
    for name in sorted({*options, *now} - {"missing"}):
        before, after = unpack(options.get(name)), unpack(now.get(name))
        if _listed(before) != _listed(after):
            raise CheckpointError(
                f"The run was trained with {name}={before!r}, and is now to go on with {after!r}; put its config.yaml "
                "back as it was."
            )


def _listed(value: Any) -> Any:
    """Return a value with its tuples as lists: a configuration's file knows no tuples."""
    if isinstance(value, Mapping):
        return {key: _listed(item) for key, item in value.items()}
    return [_listed(item) for item in value] if isinstance(value, list | tuple) else value


def constructor_arguments(options: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return what to construct a model with: saved options, replaced by those given now.

    :param options: of :func:`capture`, packed
    :param given: by the caller
    :raises ConfigError: if an option that cannot be saved is not given
    """
    missing = [name for name in options["missing"] if name not in given]
    if missing:
        raise CheckpointError(
            f"{', '.join(missing)} of this run {'is an object' if len(missing) == 1 else 'are objects'} that no "
            f"checkpoint can hold; give {'it' if len(missing) == 1 else 'them'} to resume() as to the constructor."
        )
    saved = {name: _decode(unpack(value)) for name, value in options.items() if name != "missing"}
    return {**saved, **given}


def _option(model: MultiTaskOffPolicyAlgorithm, name: str) -> Any:
    attributes: dict[str, Any] = vars(model)
    if name == "policy":
        aliases = {cls: alias for alias, cls in model.policy_aliases.items()}
        return aliases.get(model.policy_class, model.policy_class)
    if name == "stats_window_size":
        return model._stats_window_size
    if name == "train_freq":
        train_freq: Any = model.train_freq
        return (train_freq.frequency, train_freq.unit.value)
    if name == "learning_starts" and model.learning_starts == model._auto_learning_starts:
        return "auto"
    if name == "replay_buffer_class" and model.replay_buffer_class in (TaskReplayBuffer, *_BUFFERS):
        return None  # what it comes to by itself
    if name == "policy_kwargs":
        ours = ("use_sde", "n_tasks", "lora")  # SB3 and we put these in
        return {key: value for key, value in model.policy_kwargs.items() if key not in ours}
    return attributes[name]


def _encode(value: Any) -> Any:
    if isinstance(value, type):
        path = f"{value.__module__}:{value.__qualname__}"
        if not path.startswith(_SAFE_MODULES):
            raise TypeError(path)
        return {"__class__": path}
    if isinstance(value, Mapping):
        return {key: _encode(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_encode(item) for item in value)
    return value


def _decode(value: Any) -> Any:
    if isinstance(value, dict):
        if set(value) == {"__class__"}:
            module, _, name = str(value["__class__"]).partition(":")
            if not module.startswith(_SAFE_MODULES):
                raise CheckpointError(
                    f"The checkpoint names a class of {module!r}, which is not loaded from there."
                )
            found = getattr(importlib.import_module(module), name)
            if not isinstance(found, type) or not f"{found.__module__}.".startswith(_SAFE_MODULES):
                raise CheckpointError(
                    f"The checkpoint names {value['__class__']!r} as a class, which is none."
                )
            return found
        return {key: _decode(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_decode(item) for item in value)
    return value


# ---------------------------------------------------------------------- the parts


def _replay_state(buffer: ReplayBuffer | None) -> dict[str, Any]:
    if isinstance(buffer, TaskReplayBuffer):
        return buffer.checkpoint_state()
    assert buffer is not None
    arrays = {name: value for name, value in vars(buffer).items() if _is_storage(value)}
    # with optimize_memory_usage the newest next observation lies one further
    n = buffer.size() + int(buffer.optimize_memory_usage)
    filled = {
        name: {key: item[:n] for key, item in value.items()} if isinstance(value, dict) else value[:n]
        for name, value in arrays.items()
    }
    return {"arrays": filled, "pos": buffer.pos, "full": buffer.full}


def _is_storage(value: Any) -> bool:
    """Return whether an attribute of SB3's buffer is storage: an array, or one per part of the observation."""
    if isinstance(value, dict):
        return bool(value) and all(map(_is_storage, value.values()))
    return isinstance(value, np.ndarray)


def _restore_replay(buffer: ReplayBuffer | None, state: Mapping[str, Any]) -> None:
    if isinstance(buffer, TaskReplayBuffer):
        return  # its rows come from files of their own
    assert buffer is not None
    for name, value in state["arrays"].items():
        storage = getattr(buffer, name)
        for target, source in (
            [(storage[key], item) for key, item in value.items()]
            if isinstance(value, dict)
            else [(storage, value)]
        ):
            target[: len(source)] = source
    buffer.pos, buffer.full = state["pos"], state["full"]


def _generator_states(model: MultiTaskOffPolicyAlgorithm) -> dict[str, Any]:
    space: spaces.Space[Any] = model.action_space
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(legacy=False),
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state(model.device) if model.device.type == "cuda" else None,
        "action_space": space.np_random.bit_generator.state,
    }


def _restore_generators(model: MultiTaskOffPolicyAlgorithm, states: Mapping[str, Any]) -> None:
    random.setstate(states["python"])
    np.random.set_state(states["numpy"])
    th.set_rng_state(states["torch"])
    if states["cuda"] is not None and model.device.type == "cuda":
        th.cuda.set_rng_state(states["cuda"], model.device)
    model.action_space.np_random.bit_generator.state = states["action_space"]


def _noise_state(noise: Any) -> dict[str, Any]:
    """Return what an action noise remembers: arrays of its own, and of those it holds."""
    own = {name: value for name, value in vars(noise).items() if isinstance(value, np.ndarray)}
    return {"own": own, "parts": [_noise_state(part) for part in getattr(noise, "noises", [])]}


def _restore_noise(noise: Any, state: Mapping[str, Any]) -> None:
    vars(noise).update(state["own"])
    for part, saved in zip(getattr(noise, "noises", []), state["parts"], strict=True):
        _restore_noise(part, saved)


# ---------------------------------------------------------------------- log and callbacks


def _log_state(logger: Logger) -> dict[str, Any]:
    """Return what was recorded since the last row was written; pictures and videos are left out."""
    values = {}
    for name, value in logger.name_to_value.items():
        if isinstance(value, bool | int | float | str | np.generic):
            values[name] = (value, logger.name_to_count[name], logger.name_to_excluded[name])
    return values


def _restore_log(logger: Logger, state: Mapping[str, Any] | None) -> None:
    """Put back what was recorded and not yet written.

    :param logger: of the model
    :param state: captured; ``None`` where there was no logger yet
    """
    for name, (value, count, excluded) in (state or {}).items():
        logger.name_to_value[name] = value
        logger.name_to_count[name] = count
        logger.name_to_excluded[name] = excluded


def _stateful_callbacks(callback: Any) -> Iterator[tuple[str, Any]]:
    """Yield each callback that has ``checkpoint_state()`` and ``restore_checkpoint_state(state)``, and a key for it.

    :param callback: of ``learn()``, with all that it holds
    """
    seen: dict[str, int] = {}
    for found in _every(callback):
        if hasattr(found, "checkpoint_state") and hasattr(found, "restore_checkpoint_state"):
            name = type(found).__name__
            seen[name] = seen.get(name, -1) + 1
            yield f"{name}-{seen[name]}", found


def _every(callback: Any) -> Iterator[Any]:
    if callback is None:
        return
    yield callback
    for child in getattr(callback, "callbacks", []):
        yield from _every(child)
    for name in ("callback", "callback_on_new_best"):
        yield from _every(getattr(callback, name, None))


def _restore_callbacks(callback: BaseCallback, states: Mapping[str, Any]) -> None:
    """Give each callback what it remembered.

    :param callback: of ``learn()``
    :param states: captured
    """
    found = dict(_stateful_callbacks(callback))
    for key, state in states.items():
        if key in found:
            found[key].restore_checkpoint_state(state)
    gone = [key.rpartition("-")[0] for key in states if key not in found]
    if gone:
        warnings.warn(
            f"The checkpoint was made with the callback {', '.join(gone)}, which learn() was not given now; what it "
            "remembered is not used.",
            stacklevel=4,
        )


def restore_pending(model: MultiTaskOffPolicyAlgorithm, callback: BaseCallback) -> None:
    """Restore what ``learn()`` makes anew when it begins, once.

    :param model: restored, in ``learn()``
    :param callback: of ``learn()``
    """
    pending, model._to_restore = model._to_restore, None
    if pending is None:
        return
    if model.num_timesteps == 0 and model._n_updates > 0:
        warnings.warn(
            "learn() begins a new run with what was resumed; to go on with that run, give "
            "learn(model.remaining_timesteps, reset_num_timesteps=False).",
            stacklevel=4,
        )
    _restore_log(model.logger, pending["log"])
    _restore_callbacks(callback, pending["callbacks"])
    if pending["action_noise"] is not None and model.action_noise is not None:
        _restore_noise(model.action_noise, pending["action_noise"])


# ---------------------------------------------------------------------- environments


def _wrappers(env: Any) -> tuple[list[VecEnvWrapper], VecEnv]:
    """Return SB3's wrappers, outermost first, and what they wrap."""
    wrappers = []
    while isinstance(env, VecEnvWrapper):
        wrappers.append(env)
        env = env.venv
    return wrappers, env


_KNOWN_WRAPPERS = {
    VecNormalize: ("obs_rms", "ret_rms", "returns", "old_reward"),
    VecMonitor: ("episode_count", "episode_returns", "episode_lengths"),
}
_OF_EPISODES = ("returns", "old_reward", "episode_returns", "episode_lengths")
"""Of those, what would be untrue of a new episode."""


def _what_envs_lose(env: Any) -> str:
    wrappers, inner = _wrappers(env)
    if not hasattr(inner, "checkpoint_state"):
        return (
            f"a {type(inner).__name__} cannot be brought back to the middle of an episode, so on resuming every "
            "environment begins a new one (make_metaworld_env and make_multitask_env(functions) give environments "
            "that can)"
        )
    unknown = [type(wrapper).__name__ for wrapper in wrappers if type(wrapper) not in _KNOWN_WRAPPERS]
    return f"what {', '.join(unknown)} remembers is not saved" if unknown else ""


def _env_state(env: Any) -> dict[str, Any]:
    wrappers, inner = _wrappers(env)
    return {
        "wrappers": [
            {
                name: _rms_state(getattr(wrapper, name, None))
                for name in _KNOWN_WRAPPERS.get(type(wrapper), ())
            }
            for wrapper in wrappers
        ],
        "inner": inner.checkpoint_state() if hasattr(inner, "checkpoint_state") else None,
    }


def _restore_env(model: MultiTaskOffPolicyAlgorithm, state: Mapping[str, Any]) -> None:
    """Bring the environments back; where they begin new episodes, the model acts on what these show."""
    env: Any = model.env
    wrappers, inner = _wrappers(env)
    resumable: Any = inner
    is_exact = state["inner"] is not None and hasattr(inner, "checkpoint_state")
    if is_exact:
        obs = resumable.restore_checkpoint_state(state["inner"])
    else:
        env.seed(int(np.random.SeedSequence([model.seed or 0, model.num_timesteps]).generate_state(1)[0]))
        obs = env.reset()
        warnings.warn(f"This run does not go on to the bit: {_what_envs_lose(env)}.", stacklevel=4)
    for wrapper, saved in zip(wrappers, state["wrappers"], strict=True):
        for name, value in saved.items():
            if value is not None and (is_exact or name not in _OF_EPISODES):
                setattr(wrapper, name, _restored_rms(getattr(wrapper, name, None), value))
    normalizer = model._vec_normalize_env
    if is_exact and any(type(wrapper) not in _KNOWN_WRAPPERS for wrapper in wrappers):
        return  # what this wrapper made of the observation stands in ``_last_obs``
    if normalizer is not None:
        model._last_original_obs = obs if is_exact else normalizer.get_original_obs()
        normalizer.old_obs = model._last_original_obs
        obs = normalizer.normalize_obs(model._last_original_obs)
    model._last_obs = obs


def _rms_state(value: Any) -> Any:
    if isinstance(value, RunningMeanStd):
        return {"mean": value.mean, "var": value.var, "count": value.count}
    if isinstance(value, dict):
        return {key: _rms_state(item) for key, item in value.items()}
    return value if isinstance(value, np.ndarray | int | float) else None


def _restored_rms(into: Any, value: Any) -> Any:
    if isinstance(into, RunningMeanStd):
        into.mean, into.var, into.count = value["mean"], value["var"], value["count"]
        return into
    if isinstance(into, dict):
        return {key: _restored_rms(item, value[key]) for key, item in into.items()}
    return value
