"""Meta-World's envs without the waste around MuJoCo: same numbers; must not know who resets them.

The fifty reward functions stay Meta-World's own. Each class gets a subclass whose methods are the stock ones with
other globals: where they say ``np``, ``reward_utils`` or ``Rotation`` they find the stand-ins of this module,
which compute the same for the scalars and short vectors they are used on. What surrounds the rewards (the step,
the reset, the observation) is written anew. Nothing of Meta-World or NumPy is changed for anybody else.
"""

from __future__ import annotations

import dis
import math
import types
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt
from metaworld.utils import reward_utils
from scipy.spatial.transform import Rotation

__all__ = ["fast_class"]

Vector = npt.NDArray[np.float64]


@cache
def fast_class(stock: type[Any]) -> type[Any]:
    """Return a subclass of a stock env class, under the same name, that gives the same numbers sooner.

    It keeps the stock constructor and attributes; ``place`` and ``remember`` come on top. Observations and physics
    equal the stock ones to the bit, rewards but for the rounding of the last operations.

    :param stock: such as ``metaworld.envs.SawyerReachEnvV3``
    """
    fast: type[Any] = type(stock.__name__, (_FastEnv, stock), {"__module__": __name__})
    own_names = set(vars(_FastEnv))
    copies = _MethodCopies({id(stock): fast})
    for cls in reversed([cls for cls in stock.__mro__ if cls.__module__.startswith("metaworld.")]):
        for name, member in vars(cls).items():
            # The class's own methods precede ours, its bases' do not; constructors stay as they are.
            if name.startswith("__") or (cls is not stock and name in own_names):
                continue
            copy = copies.of_member(member, fast if cls is stock else None)
            if copy is not None:
                setattr(fast, name, copy)
    fast._assigned = frozenset(_assigned_attributes(stock)) | {"init_tcp", "_prev_obs"}
    return fast


class _Outcome(NamedTuple):
    """All that a reset leaves behind."""

    state: Vector
    body_pos: Vector
    site_pos: Vector
    attributes: dict[str, Any]
    obs: Vector


_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
_FLOAT32, _FLOAT64 = np.dtype(np.float32), np.dtype(np.float64)
_POINTING_DOWN = np.array([1.0, 0.0, 1.0, 0.0])
"""The mocap body's quaternion (w, x, y, z) in every step."""


def _looked_up_once(kind: str) -> Callable[[Any, Any], Any]:
    stock = getattr(mujoco.MjData, kind)

    def look_up(self: Any, name: Any) -> Any:
        try:
            return self._named[kind, name]
        except KeyError:
            return self._named.setdefault((kind, name), stock(self, name))

    return look_up


class _NamedData(mujoco.MjData):  # type: ignore[misc]  # MuJoCo is untyped
    """MuJoCo's data that looks up each name once."""

    def __init__(self, model: Any) -> None:
        super().__init__(model)
        self._named: dict[tuple[str, Any], Any] = {}

    body, geom, site, joint = map(_looked_up_once, ("body", "geom", "site", "joint"))


class _FastEnv:
    """What replaces the stock base classes' methods; mixed into a stock env class by `fast_class`.

    The forward pass behind the substeps looks superfluous, and is not: the solver's next warm start comes from it.
    Without it some tasks are off by more than 1e-3 within an episode.
    """

    remember = False
    """Whether a reset to a frozen vector is simulated once and restored from then on."""
    _simulates_hand = True
    _tcp: Vector | None = None
    _known_qpos: bytes | None = None

    def _initialize_simulation(self: Any) -> tuple[Any, Any]:
        model, _ = super()._initialize_simulation()  # type: ignore[misc]  # of the class mixed with
        data = _NamedData(model)
        self._outcomes: dict[bytes, _Outcome] = {}
        self._hand_start: bytes | None = None
        self._hand_end = np.empty(mujoco.mj_stateSize(model, _STATE))
        self._mocap_pos, self._mocap_quat = data.mocap_pos[0], data.mocap_quat[0]
        self._mocap_bounds = self.mocap_low.tolist(), self.mocap_high.tolist()
        self._scale_single = np.full(3, self.action_scale, np.float32)
        self._hand = data.body("hand").xpos
        self._fingers = data.body("rightclaw").xpos, data.body("leftclaw").xpos
        self._ends = data.site("rightEndEffector").xpos, data.site("leftEndEffector").xpos
        self._pad_geoms = data.geom("leftpad_geom").id, data.geom("rightpad_geom").id
        self._pads = data.body("leftpad").xpos, data.body("rightpad").xpos
        self._resumes = _can_resume(model)
        return model, data

    def get_endeff_pos(self: Any) -> Any:
        return self._hand

    @property
    def tcp_center(self: Any) -> Any:
        if self._tcp is not None:
            return self._tcp
        right, left = self._ends
        return (right + left) / 2.0

    def set_xyz_action(self: Any, action: npt.NDArray[Any]) -> None:
        x, y, z = action.tolist()
        if not (-1.0 <= x <= 1.0 and -1.0 <= y <= 1.0 and -1.0 <= z <= 1.0):
            action = np.clip(action, -1, 1)
        # The product has the action's precision, as in the stock env; an array times a float takes far longer.
        scale = self._scale_single if action.dtype == _FLOAT32 else self.action_scale
        pos = self._mocap_pos
        moved = zip(pos.tolist(), (action * scale).tolist(), *self._mocap_bounds, strict=True)
        for axis, (start, delta, low, high) in enumerate(moved):
            end = start + delta
            pos[axis] = low if end < low else high if end > high else end
        self._mocap_quat[:] = _POINTING_DOWN

    def do_simulation(self: Any, ctrl: Any, n_frames: int) -> None:
        self._known_qpos = None
        self.data.ctrl[:] = ctrl
        mujoco.mj_step(self.model, self.data, n_frames)

    def touching_object(self: Any, object_geom_id: int) -> bool:
        contact = self.data.contact
        forces = [0.0, 0.0]
        for row, pair in enumerate(contact.geom.tolist()):
            if object_geom_id in pair:
                for side, pad in enumerate(self._pad_geoms):
                    if pad in pair:
                        forces[side] += self.data.efc_force[contact.efc_address[row]]
        return min(forces) > 0

    def _get_curr_obs_combined_no_goal(self: Any) -> Vector:
        obs = np.zeros(4 + self._obs_obj_max_len)
        self._look(obs)
        return obs

    def _look(self: Any, obs: Vector) -> None:
        """Write hand, opening and objects into the first 18 elements of zeros."""
        obs[:3] = self._hand
        right, left = self._fingers
        obs[3] = _clip(_norm(right - left) / 0.1, 0.0, 1.0)
        positions, quats = self._get_pos_objects(), self._get_quat_objects()
        for n in range(len(positions) // 3):
            at = 4 + 7 * n
            obs[at : at + 3] = positions[3 * n : 3 * n + 3]
            obs[at + 3 : at + 7] = quats[4 * n : 4 * n + 4]

    def _get_obs(self: Any) -> Vector:
        obs = np.zeros(39)
        self._look(obs)
        obs[18:36] = self._prev_obs
        if not self._partially_observable:
            obs[36:] = self._get_pos_goal()
        self._prev_obs = obs[:18].copy()
        return obs

    def step(self: Any, action: npt.NDArray[Any]) -> tuple[Vector, float, bool, bool, dict[str, Any]]:
        if len(action) != 4:
            raise ValueError(f"action must have 4 elements, got {len(action)}.")
        if self.curr_path_length >= self.max_path_length:
            raise ValueError("step() after the episode was truncated: call reset() first.")
        model, data = self.model, self.data
        self.set_xyz_action(action[:3])
        effort = float(action[3])
        data.ctrl[:] = effort, -effort
        n_substeps = self.frame_skip
        if self._known_qpos == data.qpos.tobytes():
            # All that depends on the pose alone is known from the last forward pass, but for the mocap body.
            # Collision detection, a third of a substep, is saved; the outcome is the same to the bit.
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_makeConstraint(model, data)
            mujoco.mj_projectConstraint(model, data)
            mujoco.mj_fwdVelocity(model, data)
            mujoco.mj_step2(model, data)
            n_substeps -= 1
        mujoco.mj_step(model, data, n_substeps)
        mujoco.mj_forward(model, data)
        if self._resumes:
            self._known_qpos = data.qpos.tobytes()
        self.curr_path_length += 1
        obs = self._get_obs()
        low, high = self._bounds
        np.maximum(obs, low, out=obs)
        np.minimum(obs, high, out=obs)
        self._tcp = self.tcp_center
        reward, info = self.evaluate_state(obs, action)
        self._tcp = None
        return obs, reward, False, self.curr_path_length == self.max_path_length, info

    def place(self: Any) -> None:
        """Draw the vector (unless it is frozen) and put the goal and the objects there, the hand aside."""
        self._simulates_hand = False
        try:
            self.reset_model()
        finally:
            self._simulates_hand = True

    def reset(self: Any, seed: int | None = None, options: Any = None) -> tuple[Vector, dict[str, Any]]:
        self.curr_path_length = 0
        self._tcp = self._known_qpos = None
        self._bounds = self.sawyer_observation_space.low, self.sawyer_observation_space.high
        key = self._last_rand_vec.tobytes() if self.remember and self._freeze_rand_vec else None
        obs = self._recall(key) if key in self._outcomes else self._simulated_reset(key)
        if self.render_mode == "human":
            self.render()
        return obs, {}

    def _simulated_reset(self: Any, key: bytes | None) -> Vector:
        # The hand passes where the model's bodies stand, so these must be in place before.
        self.place()
        mujoco.mj_resetData(self.model, self.data)
        obs: Vector = self.reset_model()
        obs[18:36] = self._prev_obs
        if key is not None:
            state = np.empty_like(self._hand_end)
            mujoco.mj_getState(self.model, self.data, state, _STATE)
            attributes = {name: getattr(self, name) for name in self._assigned if hasattr(self, name)}
            self._outcomes[key] = _Outcome(
                state, self.model.body_pos.copy(), self.model.site_pos.copy(), attributes, obs.copy()
            )
        return obs

    def _recall(self: Any, key: bytes) -> Vector:
        outcome = self._outcomes[key]
        self.model.body_pos[:] = outcome.body_pos
        self.model.site_pos[:] = outcome.site_pos
        mujoco.mj_setState(self.model, self.data, outcome.state, _STATE)
        mujoco.mj_forward(self.model, self.data)  # some attributes are views of what it computes
        mujoco.mj_setState(self.model, self.data, outcome.state, _STATE)  # it changed the warm start
        vars(self).update(outcome.attributes)
        obs: Vector = outcome.obs.copy()
        return obs

    def _reset_hand(self: Any, steps: int = 50) -> None:
        if self._simulates_hand:
            self._move_hand(steps)
        self.init_tcp = self.tcp_center

    def _move_hand(self: Any, steps: int) -> None:
        model, data = self.model, self.data
        self._mocap_pos[:] = self.hand_init_pos
        self._mocap_quat[:] = _POINTING_DOWN
        data.ctrl[:] = -1.0, 1.0
        state = np.empty_like(self._hand_end)
        mujoco.mj_getState(model, data, state, _STATE)
        start = state.tobytes() + model.body_pos.tobytes() + str(steps).encode()
        # The same start among the same bodies has the same end. The last substep is always done, because
        # positions that are read next, of sites too, are those it starts from.
        if start == self._hand_start:
            mujoco.mj_setState(model, data, self._hand_end, _STATE)
        else:
            mujoco.mj_step(model, data, steps * self.frame_skip - 1)
            mujoco.mj_getState(model, data, self._hand_end, _STATE)
            self._hand_start = start
        mujoco.mj_step(model, data, 1)

    def _gripper_caging_reward(
        self: Any,
        action: npt.NDArray[Any],
        obj_pos: Vector,
        obj_radius: float,
        pad_success_thresh: float,
        object_reach_radius: float,
        xz_thresh: float,
        desired_gripper_effort: float = 1.0,
        high_density: bool = False,
        medium_density: bool = False,
    ) -> float:
        if high_density and medium_density:
            raise ValueError("high_density and medium_density exclude each other.")
        x, y, z = obj_pos.tolist()
        start = self.obj_init_pos
        between = 1.0
        for pad in self._pads:
            pad_y = float(pad[1])
            margin = abs(abs(pad_y - float(start[1])) - pad_success_thresh)
            bounds = (obj_radius, pad_success_thresh)
            one_side = _tolerance(abs(pad_y - y), bounds, margin, "long_tail")
            between = _hamacher_product(between, one_side)
        tcp, init_tcp = self.tcp_center, self.init_tcp
        tcp_x, tcp_y, tcp_z = tcp.tolist()
        margin = (
            _length(float(start[0]) - float(init_tcp[0]), float(start[2]) - float(init_tcp[2])) - xz_thresh
        )
        above = _tolerance(_length(tcp_x - x, tcp_z - z), (0, xz_thresh), margin, "long_tail")
        caging = _hamacher_product(between, above)
        reward: float = 0.0
        if caging > 0.97:
            # In the action's precision, which is what the stock reward has.
            effort = min(max(0, action[-1]), desired_gripper_effort) / desired_gripper_effort
            reward = _hamacher_product(caging, effort)
        if high_density:
            reward = (reward + caging) / 2
        if medium_density:
            margin = abs(_norm(start - init_tcp) - object_reach_radius)
            distance = _length(x - tcp_x, y - tcp_y, z - tcp_z)
            reach = _tolerance(distance, (0, object_reach_radius), margin, "long_tail")
            reward = (reward + reach) / 2
        return reward


def _can_resume(model: Any) -> bool:
    """Return whether a substep may reuse the last forward pass's contacts after the mocap body has moved."""
    with_mocap = model.body_mocapid[model.body_rootid[model.geom_bodyid]] >= 0
    collides = (model.geom_contype | model.geom_conaffinity) != 0
    plain = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER and model.nsensor == model.npair == 0
    return bool(plain and not (with_mocap & collides).any())


class _MethodCopies:
    """Copies of methods that see the stand-ins of this module as their globals.

    :param replaced: more objects to replace among the globals, by their id
    """

    def __init__(self, replaced: dict[int, Any]) -> None:
        self._replaced = _stand_ins() | replaced
        self._globals: dict[int, dict[str, Any]] = {}

    def of_member(self, member: Any, owner: type[Any] | None) -> Any:
        """Return the copy of a method, property or static method; None of anything else.

        :param owner: the class that ``super()`` in it starts from; None refuses methods that say ``super()``
        """
        if isinstance(member, property):
            return property(
                *(f and self._function(f, owner) for f in (member.fget, member.fset, member.fdel))
            )
        if isinstance(member, staticmethod):
            return staticmethod(self._function(member.__func__, owner))
        if isinstance(member, types.FunctionType) and (
            owner or "__class__" not in member.__code__.co_freevars
        ):
            return self._function(member, owner)
        return None

    def _function(self, function: Any, owner: type[Any] | None) -> Any:
        cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
        closure = tuple(self._cell(name, cell, owner) for name, cell in cells)
        copy = types.FunctionType(
            function.__code__,
            self._of(function.__globals__),
            function.__name__,
            function.__defaults__,
            closure,
        )
        copy.__kwdefaults__ = function.__kwdefaults__
        copy.__doc__ = function.__doc__
        return copy

    def _cell(self, name: str, cell: types.CellType, owner: type[Any] | None) -> types.CellType:
        if name == "__class__" and owner is not None:
            return types.CellType(owner)
        inside = cell.cell_contents
        # What a decorator wraps.
        return (
            types.CellType(self._function(inside, owner)) if isinstance(inside, types.FunctionType) else cell
        )

    def _of(self, stock: dict[str, Any]) -> dict[str, Any]:
        if id(stock) not in self._globals:
            self._globals[id(stock)] = {name: self._replaced.get(id(v), v) for name, v in stock.items()}
        return self._globals[id(stock)]


def _assigned_attributes(cls: type[Any]) -> Iterator[str]:
    """Yield the name of each attribute that a method of the class, its constructor apart, assigns."""
    functions = [member for name, member in vars(cls).items() if name != "__init__"]
    while functions:
        function = functions.pop()
        if isinstance(function, types.FunctionType):
            functions += [cell.cell_contents for cell in function.__closure__ or ()]  # what a decorator wraps
            yield from (i.argval for i in dis.get_instructions(function) if i.opname == "STORE_ATTR")


@cache
def _stand_ins() -> dict[int, Any]:
    """Return what replaces an object of that id among the globals of a stock method."""
    numpy = types.SimpleNamespace(**vars(np))
    numpy.linalg = types.SimpleNamespace(**vars(np.linalg) | {"norm": _norm})
    numpy.clip, numpy.abs = _clip, abs
    rewards = types.SimpleNamespace(**vars(reward_utils))
    rewards.hamacher_product, rewards.rect_prism_tolerance = _hamacher_product, _rect_prism_tolerance
    rewards.tolerance = _tolerance
    return {
        id(np): numpy,
        id(reward_utils): rewards,
        id(reward_utils.tolerance): _tolerance,
        id(Rotation): _Rotation,
    }


def _norm(x: Any, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Any:
    if (
        axis is None
        and type(x) is np.ndarray
        and x.ndim == 1
        and x.dtype == _FLOAT64
        and (ord is None or ord == 2)
    ):
        return np.float64(math.sqrt(x.dot(x)))
    return np.linalg.norm(x, ord, axis, keepdims)


def _clip(x: Any, *bounds: Any, **options: Any) -> Any:
    if isinstance(x, float | np.floating) and len(bounds) == 2:
        low, high = bounds
        return low if x < low else high if x > high else x
    return np.clip(x, *bounds, **options)


def _length(x: float, y: float, z: float = 0.0) -> float:
    return math.sqrt(x * x + y * y + z * z)


def _hamacher_product(a: float, b: float) -> float:
    # a b / (a + b - a b)
    if not (0.0 <= a <= 1.0 and 0.0 <= b <= 1.0):
        raise ValueError(f"a={a} and b={b} must be within [0, 1].")
    product = a * b
    either = a + b - product
    return product / either if either > 0 else 0.0


def _rect_prism_tolerance(curr: Vector, zero: Vector, one: Vector) -> Any:
    # The product of how far each coordinate has come from zero to one; 1 outside.
    product = np.float64(1.0)  # which decides the precision of what it meets, as in the stock function
    for x, start, end in zip(curr.tolist(), zero.tolist(), one.tolist(), strict=True):
        if not min(start, end) <= x <= max(start, end):
            return 1.0
        product *= (x - start) / (end - start)
    return product


def _tolerance(
    x: Any,
    bounds: tuple[float, float] = (0.0, 0.0),
    margin: Any = 0.0,
    sigmoid: str = "gaussian",
    value_at_margin: float = 0.1,
) -> Any:
    # 1 within the bounds, s(distance / margin) outside, where s(0) = 1 and s(1) = value_at_margin.
    lower, upper = bounds
    if lower > upper or margin < 0:
        raise ValueError(f"bounds={bounds} must not decrease, margin={margin} must not be negative.")
    if lower <= x <= upper:
        return 1.0
    if margin == 0:
        return 0.0
    distance = float((lower - x if x < lower else x - upper) / margin)
    shape, scale = _sigmoid(sigmoid, value_at_margin)
    return shape(distance * scale)


_SIGMOIDS: dict[str, tuple[Callable[[float], float], Callable[[float], float]]] = {
    "gaussian": (lambda u: math.exp(-0.5 * u * u), lambda v: math.sqrt(-2 * math.log(v))),
    "hyperbolic": (lambda u: 1 / math.cosh(u), lambda v: math.acosh(1 / v)),
    "long_tail": (lambda u: 1 / (u * u + 1), lambda v: math.sqrt(1 / v - 1)),
    "reciprocal": (lambda u: 1 / (abs(u) + 1), lambda v: 1 / v - 1),
    "cosine": (
        lambda u: (1 + math.cos(math.pi * u)) / 2 if abs(u) < 1 else 0.0,
        lambda v: math.acos(2 * v - 1) / math.pi,
    ),
    "linear": (lambda u: 1 - u if abs(u) < 1 else 0.0, lambda v: 1 - v),
    "quadratic": (lambda u: 1 - u * u if abs(u) < 1 else 0.0, lambda v: math.sqrt(1 - v)),
    "tanh_squared": (lambda u: 1 - math.tanh(u) ** 2, lambda v: math.atanh(math.sqrt(1 - v))),
}
"""Each falls from 1 at 0 to v at 1: the curve, and the scale of its argument that makes it so."""


@cache
def _sigmoid(name: str, value_at_margin: float) -> tuple[Callable[[float], float], float]:
    if name not in _SIGMOIDS:
        raise ValueError(f"sigmoid={name!r} is not one of {', '.join(_SIGMOIDS)}.")
    ends_at_zero = name in ("cosine", "linear", "quadratic")
    if not 0 <= value_at_margin < 1 or (value_at_margin == 0 and not ends_at_zero):
        raise ValueError(f"value_at_margin={value_at_margin} is not possible with sigmoid={name!r}.")
    curve, scale = _SIGMOIDS[name]
    return curve, scale(value_at_margin)


class _Rotation:
    """As much of SciPy's Rotation as Meta-World's observations need.

    :param matrix: ``(3, 3)``, orthogonal
    """

    __slots__ = ("_matrix",)

    def __init__(self, matrix: Vector) -> None:
        self._matrix = matrix

    @classmethod
    def from_matrix(cls, matrix: Vector) -> _Rotation:
        """Return the rotation."""
        return cls(matrix)

    def as_quat(self) -> Vector:
        """Return (x, y, z, w) with SciPy's sign: the element largest by the matrix's diagonal is positive."""
        (a, b, c), (d, e, f), (g, h, i) = self._matrix.tolist()
        trace = a + e + i
        largest = max(a, e, i, trace)
        if largest == a:
            q = (1 - trace + 2 * a, d + b, g + c, h - f)
        elif largest == e:
            q = (b + d, 1 - trace + 2 * e, h + f, c - g)
        elif largest == i:
            q = (c + g, f + h, 1 - trace + 2 * i, d - b)
        else:
            q = (h - f, c - g, d - b, 1 + trace)
        norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
        return np.array([q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm])
