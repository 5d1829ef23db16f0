"""What a run is: nested frozen dataclasses that presets (YAML) and the command line both build; runs nothing."""

from __future__ import annotations

import dataclasses
import math
import types
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import tyro
import yaml

from sb3_ars.config import ARSConfig, CheckpointConfig, Execution, Precision
from sb3_ars.core.schedule import SMTConfig
from sb3_ars.envs.metaworld import metaworld_task_names
from sb3_ars.envs.toy import TOY_TASKS
from sb3_ars.errors import ConfigError, check_count, check_path, nearest
from sb3_ars.experiments.catalogue import preset_values

__all__ = [
    "NO_PART_OF_A_METHOD",
    "AlgorithmConfig",
    "EnvConfig",
    "EvaluationConfig",
    "PolicyConfig",
    "RunConfig",
    "ScheduleConfig",
    "admits",
    "build",
    "describe",
    "load_config",
    "load_preset",
    "plain_values",
    "read_yaml",
    "save_config",
    "with_options",
]

Activation = Literal["relu", "tanh"]
Body = Literal["plain", "multi_head", "soft_modules", "moore", "paco"]
CriticBody = Literal["same", "plain", "multi_head", "soft_modules", "moore", "paco", "popart"]
BodyOptions = dict[str, int | float | bool]
Config = TypeVar("Config")

NO_PART_OF_A_METHOD = (
    "seed",
    "output",
    "scale",
    "log_interval",
    "verbose",
    "profile",
    "env.n_workers",
    "env.restart_workers",
    "evaluation.every",
    "checkpoint.every",
    "checkpoint.every_minutes",
    "checkpoint.keep",
)
"""Options in which runs of one method may differ: which run it is, where it goes, how often it is looked at, and by
how many processes its environments are stepped."""


@dataclass(frozen=True)
class EnvConfig:
    """The training environments."""

    tasks: str | tuple[str, ...] = "MT10"
    """Meta-World benchmark ("MT10", "MT25", "MT50"), task names, "toy", or some of the toy's tasks by name."""
    n_envs_per_task: int = 1
    """Environments of each task that step together."""
    goals: Literal["random", "stored"] = "random"
    """Goals drawn anew each episode, or one of 50 stored ones."""
    max_episode_steps: int = 500
    """Horizon in steps."""
    n_workers: int | Literal["auto"] = "auto"
    """Worker processes; 0 steps in this process."""
    restart_workers: bool = False
    """Start a worker anew that dies or hangs, or whose environment raises, instead of ending the run."""

    @property
    def is_toy(self) -> bool:
        """Whether the tasks are the toy's."""
        names = (self.tasks,) if isinstance(self.tasks, str) else self.tasks
        return any(name in ("toy", *TOY_TASKS) for name in names)

    @property
    def task_names(self) -> tuple[str, ...]:
        """The tasks by their full names, in order.

        :raises ConfigError: for a name that no task has
        """
        if not self.is_toy:
            return metaworld_task_names(self.tasks)
        if self.tasks == "toy":
            return TOY_TASKS
        return (self.tasks,) if isinstance(self.tasks, str) else self.tasks


@dataclass(frozen=True)
class AlgorithmConfig:
    """SB3's options, and where they differ ours."""

    algorithm: Literal["ARSSAC", "ARSTQC"] = "ARSSAC"
    """Soft actor-critic, or truncated quantile critics."""
    total_timesteps: int = 20_000_000
    """Length of the run in environment steps, summed over tasks."""
    learning_rate: float = 3e-4
    """Step size of Adam for actor, critics and temperatures."""
    buffer_size: int = 1_000_000
    """Transitions per task."""
    batch_size: int = 100
    """Rows per task in each update."""
    learning_starts: int | Literal["auto"] = "auto"
    """Environment steps before the first update; auto is 1.25 % of the run and at least one batch per task."""
    train_freq: int = 1
    """Joint steps of all environments between updates."""
    gradient_steps: int = 1
    """Updates after every train_freq joint steps."""
    gamma: float = 0.99
    """Discount."""
    tau: float = 0.005
    """Weight of the new critics in the target critics, per update."""
    stats_window_size: int = 100
    """Latest episodes of each task that the log's success and return average over."""
    optimize_memory_usage: bool = False
    """Store each observation once instead of twice: about half the memory, exact, somewhat slower."""
    device: str = "auto"
    """Where networks and buffers live: auto, cpu or cuda."""
    precision: Precision = "auto"
    """fp32, tf32 (CUDA) or bf16 between hidden layers; auto is fp32 on CPU and tf32 on CUDA."""
    execution: Execution = "auto"
    """How updates run: eager, fused (CPU), compile or cudagraph; auto is the fastest for the device."""
    overlap: bool | None = None
    """Update while the environments step; None is yes on CUDA, no on CPU."""

    def __post_init__(self) -> None:
        check_count("algorithm.train_freq", self.train_freq)  # with 0, SB3 would collect nothing for ever


@dataclass(frozen=True)
class PolicyConfig:
    """The networks."""

    net_arch: tuple[int, ...] = (400, 400, 400, 400)
    """Widths of the hidden layers of actor and critics."""
    actor_activation: Activation = "relu"
    """Activation of the actor's hidden layers."""
    critic_activation: Activation = "tanh"
    """Activation of the critics' hidden layers."""
    critic_layer_norm: bool = False
    """LayerNorm on the input and hidden layers of the critics (ARS-LN)."""
    std: Literal["exp", "softplus"] = "exp"
    """How the policy's standard deviation is parametrised."""
    weight_init: Literal["torch", "xavier"] = "torch"
    """Initial weights."""
    body: Body = "plain"
    """Network of the actor: plain, or one that treats tasks differently."""
    body_options: BodyOptions | None = None
    """Options of the body by name, such as n_experts 6; those not given have the paper's value for MT10."""
    critic_body: CriticBody = "same"
    """Network of the critics; same is the actor's, options included."""
    critic_body_options: BodyOptions | None = None
    """Options of a critic_body of its own, such as update_period 10 of popart."""

    def __post_init__(self) -> None:
        widths: Any = self.net_arch  # of whatever type a file gives
        if not isinstance(widths, tuple):
            raise ConfigError(f"policy.net_arch={widths!r} must be a list of widths, such as [400, 400].")
        for width in self.net_arch:
            check_count("policy.net_arch entry", width)
        for option in ("body_options", "critic_body_options"):
            options = getattr(self, option)
            if options is not None and (not isinstance(options, Mapping) or "name" in options):
                raise ConfigError(
                    f"policy.{option}={options!r} must be a mapping of a body's options, its name not among them."
                )
        if self.body_options and self.body == "plain":
            raise ConfigError(
                f"policy.body_options={self.body_options} go with a body, but policy.body is plain; name one, such as "
                "moore, or drop them."
            )
        if self.critic_body_options and self.critic_body in ("same", "plain"):
            raise ConfigError(
                f"policy.critic_body_options={self.critic_body_options} go with a body of the critics' own, but "
                f"policy.critic_body is {self.critic_body}; name one, such as popart, or drop them."
            )


@dataclass(frozen=True)
class ScheduleConfig(SMTConfig):
    """Which tasks collect data, and when."""

    name: Literal["none", "smt"] = "none"
    """none: all tasks, always; smt: hard tasks first, with the options here."""

    def __post_init__(self) -> None:
        super().__post_init__()
        given = [f.name for f in dataclasses.fields(self) if getattr(self, f.name) != f.default]
        if self.name == "none" and given:
            raise ConfigError(
                f"schedule.{given[0]}={getattr(self, given[0])!r} goes with a schedule, but schedule.name is none; "
                "name it smt, or drop the option."
            )


@dataclass(frozen=True)
class EvaluationConfig:
    """Evaluation during and after training, on environments of its own."""

    protocol: str = "paper"
    """Named protocol: paper, metaworld or h150."""
    n_episodes: int | None = None
    """Episodes per task, instead of the protocol's."""
    every: int | None = None
    """Environment steps between evaluations during training; None evaluates at the end only."""

    def __post_init__(self) -> None:
        for option in ("n_episodes", "every"):
            value = getattr(self, option)
            if value is not None:
                check_count(f"evaluation.{option}", value)


@dataclass(frozen=True)
class RunConfig:
    """One training run."""

    seed: int = 0
    """Seed of everything random."""
    output: Path = Path("runs")
    """Folder in which the run makes its own folder."""
    log_interval: int = 10
    """Episodes between two rows of progress.csv."""
    verbose: int = 0
    """1 also prints SB3's log table."""
    profile: bool = False
    """Also print where the training time went, by part."""
    scale: Annotated[str, tyro.conf.Suppress] = "full"
    """Name of the scale that sized the run; see sb3_ars.experiments.scaling."""
    env: EnvConfig = field(default_factory=EnvConfig)
    algorithm: AlgorithmConfig = field(default_factory=AlgorithmConfig)
    ars: ARSConfig = field(default_factory=ARSConfig)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)


def load_preset(name: str) -> RunConfig:
    """Return the configuration of a preset.

    :param name: one of :func:`~sb3_ars.experiments.preset_names`
    :raises ConfigError: if there is none of that name, or its file holds an unknown key
    """
    return build(RunConfig, preset_values(name), f"preset {name!r}")


def load_config(path: Path) -> RunConfig:
    """Return the configuration a run wrote.

    :param path: its ``config.yaml``
    :raises ConfigError: if the file is missing, is no mapping, or holds an unknown key
    """
    path = check_path("path", path)
    if not path.is_file():
        raise ConfigError(f"{path} does not exist; the folder of a run holds one, config.yaml.")
    values = read_yaml(path, str(path))
    if not isinstance(values, Mapping):
        raise ConfigError(f"{path} is not the configuration of a run.")
    return build(RunConfig, values, str(path))


def read_yaml(source: Path | str, where: str) -> Any:
    """Return what a YAML file or text holds.

    :param source: path of the file, or the text itself
    :param where: it comes from, for messages
    :raises ConfigError: in one line, if it cannot be read, is not UTF-8 or not YAML
    """
    try:
        return yaml.safe_load(source.read_text(encoding="utf-8") if isinstance(source, Path) else source)
    except OSError as error:
        raise ConfigError(f"{where} cannot be read ({error.strerror}).") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{where} is no text in UTF-8; save it as that.") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{where} is not valid YAML: {' '.join(str(error).split())}") from error


def with_options(config: RunConfig, options: Mapping[str, Any], where: str) -> RunConfig:
    """Return the configuration with some options changed.

    :param config: of the run
    :param options: as in a preset: those of the run by name, and mappings of the parts' options
    :param where: they come from, for messages
    :raises ConfigError: for an unknown option, or a value that cannot work
    """
    values = _fields(config)
    for key, value in options.items():
        part = _fields(values[key]) if dataclasses.is_dataclass(values.get(key)) else None
        values[key] = {**part, **value} if part is not None and isinstance(value, Mapping) else value
    return build(
        RunConfig, {k: _fields(v) if dataclasses.is_dataclass(v) else v for k, v in values.items()}, where
    )


def save_config(config: RunConfig, path: Path) -> None:
    """Write the effective configuration as YAML.

    :param config: of the run
    :param path: file to write
    """
    path.write_text(yaml.safe_dump(plain_values(config), sort_keys=False), encoding="utf-8")


def plain_values(config: RunConfig) -> dict[str, Any]:
    """Return a configuration as nested mappings of what YAML and JSON hold; :func:`build` reads it.

    :param config: of the run
    """
    values: dict[str, Any] = _plain(dataclasses.asdict(config))
    return values


def build(cls: type[Config], values: Mapping[str, Any], where: str) -> Config:
    """Return a dataclass, nested ones included, of plain values.

    :param cls: its class
    :param values: fields by name; those not given have their defaults
    :param where: they come from, for messages
    :raises ConfigError: for an unknown key, or a value that cannot work
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where}: {cls.__name__} must be a mapping of options, not {values!r}.")
    hints = get_type_hints(cls)
    kwargs: dict[str, Any] = {}
    for key, value in values.items():
        if key not in hints:
            raise ConfigError(
                f"{where}: {key!r} is no option of {cls.__name__}; it has {', '.join(hints)}."
                + nearest(str(key), hints)
            )
        if get_origin(hints[key]) is Literal and value not in get_args(hints[key]):
            allowed = [str(choice) for choice in get_args(hints[key])]
            raise ConfigError(
                f"{where}: {key}={value!r} is unknown; choose one of {', '.join(allowed)}."
                + nearest(str(value), allowed)
            )
        if dataclasses.is_dataclass(hints[key]):
            kwargs[key] = build(hints[key], {} if value is None else value, where)
        elif hints[key] is Path and isinstance(value, str):
            kwargs[key] = Path(value)
        else:
            kwargs[key] = tuple(value) if isinstance(value, list) else value
    config = cls(**kwargs)  # its own checks first, which say more
    for key, value in kwargs.items():
        if not admits(hints[key], value):
            hint = " (YAML reads 1e-4 as text; write 1.0e-4)" if _is_number_as_text(value) else ""
            raise ConfigError(f"{where}: {key}={value!r} must be {describe(hints[key])}{hint}.")
    return config


def admits(hint: Any, value: Any) -> bool:
    """Return whether an option of this type may be this value, as YAML gives it.

    :param hint: type of the option
    :param value: plain, a list as a list or tuple
    """
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return any(admits(argument, value) for argument in arguments)
    if origin is Literal:
        return value in arguments
    if origin in (tuple, list):
        return isinstance(value, list | tuple) and all(admits(arguments[0], item) for item in value)
    if origin in (dict, Mapping):
        return isinstance(value, Mapping) and all(
            admits(arguments[0], name) and admits(arguments[1], item) for name, item in value.items()
        )
    if hint is types.NoneType:
        return value is None
    if hint in (int, float):
        kind = int if hint is int else int | float
        return isinstance(value, kind) and not isinstance(value, bool)
    return hint is Any or isinstance(value, hint)


def describe(hint: Any) -> str:
    """Return the type of an option in words.

    :param hint: type of the option
    """
    if isinstance(hint, type) and get_origin(hint) is None:
        return hint.__name__
    return str(hint).replace("typing.", "").replace("collections.abc.", "")


def _is_number_as_text(value: Any) -> bool:
    try:
        return isinstance(value, str) and math.isfinite(float(value))
    except ValueError:
        return False


def _fields(config: Any) -> dict[str, Any]:
    return {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value
