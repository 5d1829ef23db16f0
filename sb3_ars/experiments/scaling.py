"""The paper's presets at other sizes: what a scale is, as data, and what it makes of a preset; trains nothing."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

from sb3_ars.config import ARSConfig
from sb3_ars.errors import ConfigError, check_count, check_number, check_path, nearest
from sb3_ars.experiments.config import (
    EnvConfig,
    PolicyConfig,
    RunConfig,
    ScheduleConfig,
    build,
    read_yaml,
    with_options,
)
from sb3_ars.nets.bodies import BODIES, body_config
from sb3_ars.nets.lora import LoRAConfig

__all__ = ["CAPS", "Scale", "load_scale", "scale_names", "scaled"]

Number = TypeVar("Number", int, float)

SCALES = resources.files("sb3_ars.experiments") / "scales"
"""Folder of the scales that ship with the package, one YAML file each."""

CAPS = {
    "hidden_width": "width of a hidden layer",
    "hidden_layers": "number of hidden layers",
    "max_episode_steps": "horizon",
    "train_freq": "joint steps of all environments between updates",
    "pool_size": "tasks that a schedule trains at the same time",
}
"""What ``at_most`` may hold beside numeric options of bodies and adapters."""

_COUNTS = ("random_steps", "updates_after_reset", "schedule_interval")
"""Options of a scale that grow with its length."""

_EXAMPLES = {
    "stands_for": "{push-v3: door-close-v3}",
    "at_most": "{hidden_width: 64}",
    "options": "{env: {n_workers: 0}}",
}

_NOT_A_SCALES = {  # what makes a preset what it is, what a scale has a field for, and what belongs to one run
    "": ("seed", "output", "log_interval", "scale"),
    "env": ("tasks", "max_episode_steps"),
    "algorithm": ("algorithm", "total_timesteps", "learning_starts", "train_freq"),
    "ars": tuple(
        f.name for f in dataclasses.fields(ARSConfig) if f.name not in ("actor_value", "reward_floor")
    ),
    "policy": ("net_arch", "critic_layer_norm", "body", "body_options", "critic_body", "critic_body_options"),
    "schedule": tuple(f.name for f in dataclasses.fields(ScheduleConfig)),
    "evaluation": ("every",),
}


@dataclass(frozen=True)
class Scale:
    """A size to train presets at; what is not given stays the preset's.

    :raises ConfigError: naming the option, what was given and what is allowed
    """

    name: str
    """What reports call it."""
    description: str = ""
    """One line, which reports print."""
    tasks: str | tuple[str, ...] | None = None
    """Tasks of every preset that trains on several, as in ``env.tasks``."""
    stands_for: Mapping[str, str] = field(default_factory=dict)
    """By task of the paper, the one of ``tasks`` that takes its place in fixed scales, alone and in figures."""
    steps_per_task: int | None = None
    """Environment steps of each task."""
    random_steps: int | None = None
    """Environment steps of each task before the first update; None leaves the preset's."""
    resets_at: tuple[float, ...] | None = None
    """Shares of the run at which every preset that resets does so, however often it resets at full size."""
    resets_until: float = 1.0
    """Share of the run into which the preset's own resets are drawn together; their number stays."""
    updates_after_reset: int | None = None
    """Gradient steps right after a reset."""
    schedule_interval: int | None = None
    """Environment steps, all tasks together, between two decisions of a schedule."""
    log_episodes: int | None = None
    """Episodes of each task between two rows of progress.csv."""
    evaluations: int | None = None
    """Evaluations during training, evenly spaced; 0 makes none, None leaves the preset's."""
    at_most: Mapping[str, float] = field(default_factory=dict)
    """Caps by name: the sizes in ``CAPS``, and numeric options of bodies and adapters."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options that are no part of a method, as a preset's file has them."""

    def __post_init__(self) -> None:
        for option in (*_COUNTS, "steps_per_task", "log_episodes", "evaluations"):
            if getattr(self, option) is not None:
                minimum = 0 if option in ("evaluations", "updates_after_reset") else 1
                check_count(f"scale {self.name}: {option}", getattr(self, option), minimum)
        for option in ("stands_for", "at_most", "options"):
            if not isinstance(getattr(self, option), Mapping):
                raise ConfigError(
                    f"scale {self.name}: {option}={getattr(self, option)!r} must be a mapping, such as "
                    f"{_EXAMPLES[option]}."
                )
        if not isinstance(self.description, str):
            raise ConfigError(f"scale {self.name}: description={self.description!r} must be a line of text.")
        _check_tasks(self)
        _check_resets(self)
        _check_caps(self)
        _check_options(self)

    def lasting(self, steps_per_task: int) -> Scale:
        """Return the scale with another length; whatever counts steps or updates changes in proportion.

        :param steps_per_task: environment steps of each task
        :raises ConfigError: if the scale has no length of its own
        """
        own = self.steps_per_task
        if own is None:
            raise ConfigError(
                f"scale {self.name} has no steps_per_task that others could be in proportion to."
            )
        counts = {
            option: max(1, getattr(self, option) * steps_per_task // own)
            for option in _COUNTS
            if getattr(self, option) is not None
        }
        return dataclasses.replace(self, steps_per_task=steps_per_task, **counts)


def scale_names() -> list[str]:
    """Return the names of the scales that ship with the package, the paper's own size first."""
    names = [path.name.removesuffix(".yaml") for path in SCALES.iterdir() if path.name.endswith(".yaml")]
    return sorted(names, key=lambda name: (name != "full", name))


def load_scale(name: str) -> Scale:
    """Return a scale.

    :param name: one of :func:`scale_names`, or the path of a YAML file of your own, which gives it its name
    :raises ConfigError: if there is none of that name, or its file holds what no scale can have
    """
    path = check_path("scale", name)
    if path.suffix in (".yaml", ".yml") and path.is_file():
        return _read(path.stem, path, str(path))
    names = scale_names()
    if name not in names:
        raise ConfigError(
            f"There is no scale {name!r}; there are {', '.join(names)}, or give the path of a YAML file of your own."
            + nearest(name, names)
        )
    return _read(name, (SCALES / f"{name}.yaml").read_text(encoding="utf-8"), f"scale {name}")


def scaled(config: RunConfig, scale: Scale) -> RunConfig:
    """Return the same method at another size.

    What makes a preset what it is stays: algorithm, bodies and their counts of experts, LayerNorm in the critics,
    combiner, weighting, loss limit, adapters, schedule, what is scaled, and what a reset renews.

    :param config: of a preset
    :param scale: the size
    :raises ConfigError: if the preset names a task that nothing stands for
    """
    sized = with_options(config, scale.options, f"scale {scale.name}")
    env = dataclasses.replace(
        sized.env,
        tasks=_tasks(config, scale),
        max_episode_steps=_capped(scale, "max_episode_steps", sized.env.max_episode_steps),
    )
    n_tasks = len(env.task_names)
    total = sized.algorithm.total_timesteps
    if scale.steps_per_task is not None:
        total = scale.steps_per_task * n_tasks
    starts = sized.algorithm.learning_starts
    if scale.random_steps is not None:
        starts = scale.random_steps * n_tasks
    algorithm = dataclasses.replace(
        sized.algorithm,
        total_timesteps=total,
        train_freq=_capped(scale, "train_freq", sized.algorithm.train_freq),
        learning_starts=starts,
    )
    evaluation = sized.evaluation
    if scale.evaluations is not None:
        every = max(1, total // scale.evaluations) if scale.evaluations else None
        evaluation = dataclasses.replace(evaluation, every=every)
    return dataclasses.replace(
        sized,
        scale=scale.name,
        log_interval=sized.log_interval if scale.log_episodes is None else scale.log_episodes * n_tasks,
        env=env,
        algorithm=algorithm,
        ars=_ars(sized, scale, total),
        policy=_policy(sized.policy, scale),
        schedule=_schedule(sized.schedule, scale),
        evaluation=evaluation,
    )


# ---------------------------------------------------------------------- the parts of a configuration


def _tasks(config: RunConfig, scale: Scale) -> str | tuple[str, ...]:
    if scale.tasks is None:
        return config.env.tasks
    names = config.env.task_names
    return scale.tasks if len(names) > 1 else _stand_in(scale, names[0])


def _stand_in(scale: Scale, task: str) -> str:
    if task not in scale.stands_for:
        raise ConfigError(
            f"scale {scale.name}: stands_for has no task for {task!r}, which the preset names; it has "
            f"{', '.join(scale.stands_for) or 'none'}. Add it."
        )
    return scale.stands_for[task]


def _ars(config: RunConfig, scale: Scale, total: int) -> ARSConfig:
    ars, changes = config.ars, dict[str, Any]()
    if scale.updates_after_reset is not None:
        changes["updates_after_reset"] = scale.updates_after_reset
    if isinstance(ars.reward_scaling, Mapping) and scale.tasks is not None:
        changes["reward_scaling"] = {_stand_in(scale, task): c for task, c in ars.reward_scaling.items()}
    if ars.lora is not None and scale.at_most:
        changes["lora"] = _reduced(dataclasses.asdict(LoRAConfig.of(ars.lora)), scale)
    old = ars.reset_times(config.algorithm.total_timesteps, len(config.env.task_names))
    new = _reset_times(old, config.algorithm.total_timesteps, total, scale)
    start = math.ceil(LoRAConfig.of(ars.lora).start * total) if ars.lora is not None else 0
    if new and new[-1] < start:
        new.append(start)  # adapters start at a reset
    if new != old:
        changes |= {"n_reset": None, "param_resets": new}
    return dataclasses.replace(ars, **changes)


def _reset_times(old: list[int], old_total: int, total: int, scale: Scale) -> list[int]:
    """Return when a run that resets does so, in environment steps."""
    shares = [time / old_total * scale.resets_until for time in old]
    if old and scale.resets_at is not None:
        shares = list(scale.resets_at)
    return [
        int(round(share * total, 3)) for share in shares
    ]  # rounded first: 0.3 * 10 is a little less than 3


def _policy(policy: PolicyConfig, scale: Scale) -> PolicyConfig:
    widths = policy.net_arch[: _capped(scale, "hidden_layers", len(policy.net_arch))]
    return dataclasses.replace(
        policy,
        net_arch=tuple(_capped(scale, "hidden_width", width) for width in widths),
        body_options=_body_options(policy.body, policy.body_options, scale),
        critic_body_options=_body_options(policy.critic_body, policy.critic_body_options, scale),
    )


def _schedule(schedule: ScheduleConfig, scale: Scale) -> ScheduleConfig:
    if schedule.name == "none":
        return schedule
    interval = schedule.interval if scale.schedule_interval is None else scale.schedule_interval
    return dataclasses.replace(
        schedule, pool_size=_capped(scale, "pool_size", schedule.pool_size), interval=interval
    )


def _body_options(body: str, options: dict[str, Any] | None, scale: Scale) -> dict[str, Any] | None:
    if body not in BODIES or not scale.at_most:
        return options
    return _reduced(dataclasses.asdict(body_config({"name": body, **(options or {})})), scale)


def _reduced(options: dict[str, Any], scale: Scale) -> dict[str, Any]:
    return {name: _capped(scale, name, value) for name, value in options.items()}


def _capped(scale: Scale, name: str, value: Any) -> Any:
    return min(value, scale.at_most[name]) if name in scale.at_most else value


# ---------------------------------------------------------------------- reading and checking


def _read(name: str, source: Path | str, where: str) -> Scale:
    values = read_yaml(source, where)
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where} must be a mapping of a scale's options, not {values!r}.")
    return build(Scale, {"name": name, **values}, where)


def _check_tasks(scale: Scale) -> None:
    if scale.tasks is None:
        if scale.stands_for:
            raise ConfigError(f"scale {scale.name}: stands_for goes with tasks; name them, or drop it.")
        return
    given: Any = scale.tasks  # of whatever type a file gives
    if not all(isinstance(task, str) for task in (given if isinstance(given, tuple) else (given,))):
        raise ConfigError(
            f"scale {scale.name}: tasks={scale.tasks!r} must be a benchmark's name or a list of tasks."
        )
    tasks = EnvConfig(tasks=scale.tasks).task_names
    for task, stand_in in scale.stands_for.items():
        if stand_in not in tasks:
            raise ConfigError(
                f"scale {scale.name}: stands_for {task!r} is {stand_in!r}, which is not one of its tasks "
                f"{', '.join(tasks)}.{nearest(str(stand_in), tasks)}"
            )


def _check_resets(scale: Scale) -> None:
    at = scale.resets_at
    is_tuple = isinstance(at, tuple) and all(isinstance(share, int | float) for share in at)
    if at is not None and not (is_tuple and list(at) == sorted(set(at))):
        raise ConfigError(
            f"scale {scale.name}: resets_at={at!r} must be a list of increasing shares of the run, such as [0.25]."
        )
    for option, share in [
        ("resets_until", scale.resets_until),
        *(("resets_at entry", each) for each in at or ()),
    ]:
        if isinstance(share, bool) or not isinstance(share, int | float) or not 0 < share <= 1:
            raise ConfigError(
                f"scale {scale.name}: {option}={share!r} must be a share of the run, above 0 and at most 1."
            )


def _check_caps(scale: Scale) -> None:
    options = [f for config in (*BODIES.values(), LoRAConfig) for f in dataclasses.fields(config)]
    shares = {f.name for f in options if isinstance(f.default, float)}
    counts = {f.name for f in options if isinstance(f.default, int) and not isinstance(f.default, bool)}
    allowed = [*CAPS, *sorted(shares | counts)]
    for name, value in scale.at_most.items():
        if name not in allowed:
            raise ConfigError(
                f"scale {scale.name}: at_most has no cap {name!r}; there are {', '.join(allowed)}."
                + nearest(str(name), allowed)
            )
        option = f"scale {scale.name}: at_most {name}"
        if name in shares:
            check_number(option, value, maximum=1)
        else:
            check_count(option, value, minimum=0 if name == "hidden_layers" else 1)


def _check_options(scale: Scale) -> None:
    where = f"scale {scale.name}"
    with_options(RunConfig(), scale.options, where)  # unknown names and values
    for part, names in _NOT_A_SCALES.items():
        given = scale.options if not part else scale.options.get(part) or {}
        for name in names:
            if name in given:
                raise ConfigError(
                    f"{where}: {'.'.join(filter(None, (part, name)))} is no scale's to set, since it belongs to the "
                    "preset or the run, or the scale has an option of its own for it: "
                    f"{', '.join(f.name for f in dataclasses.fields(Scale))}."
                )
