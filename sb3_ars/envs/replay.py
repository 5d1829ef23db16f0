"""Brings an env back to the middle of an episode by playing the episode again; knows no simulator and no algorithm.

An episode is determined by what its env held when it began and by its actions. So these are kept, and restoring is a
reset and the same steps, through every wrapper: exact for any env that draws its random numbers from NumPy generators
of its own, whatever it simulates with, and checked by comparing the last observation.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

__all__ = [
    "LONGEST_REPLAY",
    "Episode",
    "EpisodeStart",
    "SavedEpisode",
    "layers",
    "remember_start",
    "restore_start",
]

LONGEST_REPLAY = 10_000
"""Steps of an episode up to which its actions are kept; a longer one cannot be brought back."""

_LARGEST = 10_000
"""Elements of an array that is kept from one episode to the next."""

Generator = np.random.Generator | np.random.RandomState
Layer = dict[str, Any]


@dataclass(frozen=True)
class EpisodeStart:
    """What an env held when an episode began.

    :param layers: of each wrapper and the env itself, outermost first: plain values (numbers, text, small arrays,
        lists of these) and generators' states by attribute
    :param seed: that its reset was given
    :param options: likewise
    """

    layers: list[tuple[Layer, Layer]]
    seed: int | None
    options: dict[str, Any] | None


@dataclass(frozen=True)
class SavedEpisode:
    """A running episode, to be brought back.

    :param start: where it began
    :param actions: ``(steps, action_dim)``, as the env got them; ``None`` if there were too many to keep
    :param obs: the observation it has come to, ``(obs_dim,)`` float32
    :param episode_return: sum of its rewards
    """

    start: EpisodeStart
    actions: npt.NDArray[Any] | None
    obs: npt.NDArray[np.float32]
    episode_return: float

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> SavedEpisode:
        """Return the episode that ``dataclasses.asdict`` made these values of.

        :param values: nested mappings
        """
        start = EpisodeStart(
            **{**values["start"], "layers": [tuple(pair) for pair in values["start"]["layers"]]}
        )
        return cls(**{**values, "start": start})


class Episode:
    """A running episode, noted as it goes.

    :param start: where it begins
    """

    def __init__(self, start: EpisodeStart) -> None:
        self._start = start
        self._actions: list[npt.NDArray[Any]] | None = []

    def add(self, action: npt.NDArray[Any]) -> None:
        """Note a step.

        :param action: that was taken; kept, not copied
        """
        if self._actions is not None:
            self._actions.append(action)
            if len(self._actions) > LONGEST_REPLAY:
                self._actions = None

    def saved(self, obs: npt.NDArray[np.float32], episode_return: float) -> SavedEpisode:
        """Return what brings the episode back.

        :param obs: the observation it has come to
        :param episode_return: so far
        """
        actions = None if self._actions is None else np.array(self._actions)
        return SavedEpisode(self._start, actions, obs, episode_return)


def layers(env: gym.Env[Any, Any]) -> Iterator[gym.Env[Any, Any]]:
    """Yield an env and everything it wraps, outermost first.

    :param env: with any number of wrappers
    """
    yield env
    while isinstance(env, gym.Wrapper):
        env = env.env
        yield env


def remember_start(env: gym.Env[Any, Any], seed: int | None, options: dict[str, Any] | None) -> EpisodeStart:
    """Return what has to be put back before the reset that is about to happen.

    :param env: about to be reset
    :param seed: of the reset
    :param options: of the reset
    """
    return EpisodeStart([(_plain(layer), _generator_states(layer)) for layer in layers(env)], seed, options)


def restore_start(env: gym.Env[Any, Any], start: EpisodeStart) -> None:
    """Put an env of the same kind where it was when an episode began; the caller resets it next.

    :param env: which is reset on the way, so that it has made the generators it makes on first use
    :param start: of :func:`remember_start`
    :raises ValueError: if the env has other wrappers
    """
    found = list(layers(env))
    if len(found) != len(start.layers):
        raise ValueError(f"{len(found) - 1} wrappers instead of {len(start.layers) - 1}")
    env.reset(seed=0)
    for layer, (values, states) in zip(found, start.layers, strict=True):
        _put(layer, values)
        for name, state in states.items():
            generator = vars(layer).get(name)
            if not isinstance(generator, Generator):
                generator = vars(layer)[name] = np.random.Generator(_new_bits(state["bit_generator"]))
            _set_state(generator, state)


def _plain(layer: gym.Env[Any, Any]) -> Layer:
    return {name: copy.deepcopy(value) for name, value in vars(layer).items() if _is_plain(value)}


def _is_plain(value: Any) -> bool:
    if type(value) in (tuple, list):
        return all(map(_is_plain, value))
    if type(value) is np.ndarray:  # not a view, such as one of a simulator's memory
        is_own = value.flags.owndata and value.flags.writeable
        return is_own and value.dtype.kind in "biuf" and value.size <= _LARGEST
    return value is None or type(value) in (bool, int, float, str) or isinstance(value, np.number | np.bool_)


def _put(layer: gym.Env[Any, Any], values: Layer) -> None:
    """Give attributes their values back, arrays in place: others may hold them too."""
    for name, value in values.items():
        before: Any = vars(layer).get(name)
        if type(value) is np.ndarray and _is_plain(before) and np.shape(before) == value.shape:
            before[...] = value
        else:
            vars(layer)[name] = copy.deepcopy(value)


def _generator_states(layer: gym.Env[Any, Any]) -> Layer:
    return {name: _state(value) for name, value in vars(layer).items() if isinstance(value, Generator)}


def _state(generator: Generator) -> Mapping[str, Any]:
    if isinstance(generator, np.random.RandomState):
        legacy: Any = generator.get_state(legacy=False)
        return dict(legacy)
    return generator.bit_generator.state


def _set_state(generator: Generator, state: Mapping[str, Any]) -> None:
    if isinstance(generator, np.random.RandomState):
        generator.set_state(dict(state))
    else:
        generator.bit_generator.state = state


def _new_bits(name: str) -> np.random.BitGenerator:
    kind = getattr(np.random, name)
    if not (isinstance(kind, type) and issubclass(kind, np.random.BitGenerator)):
        raise ValueError(f"{name!r} is no bit generator of NumPy")
    return kind()
