"""How updates are executed changes nothing but rounding: fused, bfloat16, compiled, overlapped."""

import contextlib
import dataclasses
import itertools
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn

from sb3_ars import ARSSAC, ARSTQC, ConfigError, WorkerError, make_multitask_env, make_toy_env
from sb3_ars.algorithms.execution import CapturedActor
from sb3_ars.config import ExecutionConfig
from sb3_ars.core.runner import CapturedCalls, prepare_optimizer_
from sb3_ars.envs.toy import PointTask
from sb3_ars.nets.mlp import MLP, set_arithmetic, with_layer_norm
from sb3_ars.profiling import PARTS, PartTimer

OPTIONS = {
    "batch_size": 16,
    "buffer_size": 2000,
    "n_reset": 0,
    "seed": 0,
    "learning_starts": 200,
    "device": "cpu",
}
BOTH = pytest.mark.parametrize("algorithm", [ARSSAC, ARSTQC])


def make(algorithm=ARSSAC, env=None, layer_norm=False, **options):
    policy = {"net_arch": [24, 24, 24], "critic_layer_norm": layer_norm}
    env = make_toy_env(seed=0) if env is None else env
    return algorithm("MlpPolicy", env, policy_kwargs=policy, **{**OPTIONS, **options})


def filled(algorithm=ARSSAC, **options):
    """A model at the end of its random phase: data, no update yet."""
    model = make(algorithm, **options)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*leaves no updates.*")
        model.learn(200)
    assert model._n_updates == 0
    return model


def parameters(model):
    return th.cat([p.detach().flatten() for p in model.policy.parameters()])


def after_updates(n, algorithm=ARSSAC, **options):
    model = filled(algorithm, **options)
    th.manual_seed(1)
    model.train(gradient_steps=n, batch_size=16)
    return parameters(model)


# ---------------------------------------------------------------------- layers


def nets():
    th.manual_seed(0)
    for activation in (nn.ReLU, nn.Tanh, nn.SiLU):
        plain = nn.Sequential(
            nn.Linear(7, 24), activation(), nn.Linear(24, 32), activation(), nn.Linear(32, 3)
        )
        yield plain, MLP(*plain)
        headless = plain[:4]
        yield headless, MLP(*headless)
    normalised = with_layer_norm(plain)
    yield nn.Sequential(*normalised), normalised


@pytest.mark.parametrize(("plain", "ours"), list(nets()))
def test_an_mlp_is_its_sequential_until_told_otherwise(plain, ours):
    x = th.randn(11, 7)
    assert th.equal(plain(x), ours(x)) and plain.state_dict().keys() == ours.state_dict().keys()


@pytest.mark.parametrize(("plain", "ours"), list(nets()))
@pytest.mark.parametrize(
    ("fused", "precision", "tolerance"), [(True, "fp32", 1e-5), (False, "bf16", 0.1), (True, "bf16", 0.1)]
)
def test_values_and_gradients_are_those_of_the_sequential(plain, ours, fused, precision, tolerance):
    set_arithmetic(ours, fused, precision)
    th.manual_seed(1)
    x = th.randn(500, 7, requires_grad=True)
    weights = th.randn_like(plain(x))
    inputs = [x, *plain.parameters()]
    wanted = [plain(x), *th.autograd.grad((plain(x) * weights).sum(), inputs)]
    found = [ours(x), *th.autograd.grad((ours(x) * weights).sum(), inputs)]
    set_arithmetic(ours, False, "fp32")
    for a, b in zip(wanted, found, strict=True):
        assert b.dtype == th.float32 and b.shape == a.shape
        assert (a - b).norm() <= tolerance * a.norm() + 1e-6, (a - b).norm() / a.norm()
    if precision == "bf16":
        assert not th.equal(wanted[0], found[0])


def test_frozen_layers_get_no_gradient_and_inputs_still_do():
    net = MLP(nn.Linear(3, 8), nn.Tanh(), nn.Linear(8, 1)).requires_grad_(False)
    x = th.randn(5, 3, requires_grad=True)
    wanted = th.autograd.grad(net(x).sum(), x)[0]
    set_arithmetic(net, fused=True, precision="fp32")
    assert th.allclose(th.autograd.grad(net(x).sum(), x)[0], wanted, atol=1e-6)


# ---------------------------------------------------------------------- updates


@BOTH
@pytest.mark.parametrize("layer_norm", [False, True])
def test_a_hundred_fused_updates_are_the_eager_ones_within_a_thousandth(algorithm, layer_norm):
    eager, fused = (
        after_updates(100, algorithm, layer_norm=layer_norm, execution=execution)
        for execution in ("eager", "fused")
    )
    before = parameters(filled(algorithm, layer_norm=layer_norm))
    assert (eager - before).norm() > 0.5  # a hundred updates did something
    assert (eager - fused).norm() < 1e-3 * (eager - before).norm()


@BOTH
def test_bf16_updates_go_where_the_others_go(algorithm):
    exact, rounded = (after_updates(50, algorithm, precision=precision) for precision in ("fp32", "bf16"))
    before = parameters(filled(algorithm))
    assert not th.equal(exact, rounded)
    assert (exact - rounded).norm() < 0.3 * (exact - before).norm()


@pytest.mark.filterwarnings("ignore")  # torch's about itself
@BOTH
def test_compiled_updates_are_the_eager_ones(algorithm):
    eager, compiled = (after_updates(5, algorithm, execution=execution) for execution in ("eager", "compile"))
    assert th.allclose(eager, compiled, atol=1e-5)


def test_auto_is_sb3s_arithmetic_for_a_plain_environment_and_fused_for_tasks():
    assert ARSSAC("MlpPolicy", "Pendulum-v1", device="cpu")._plan.execution == "eager"
    assert make()._plan.execution == "fused" and not make()._plan.overlap


def test_what_this_machine_cannot_do_runs_eagerly_and_says_so(monkeypatch):
    with pytest.warns(UserWarning, match="execution='cudagraph' needs a CUDA device; updates run eagerly"):
        assert make(execution="cudagraph")._plan.execution == "eager"
    with pytest.warns(UserWarning, match="precision='tf32' is CUDA's"):
        assert not make(precision="tf32")._plan.tf32

    def no_compiler(function):
        raise RuntimeError("no C++ compiler found\nlong story")

    monkeypatch.setattr(th, "compile", no_compiler)
    with pytest.warns(UserWarning, match=r"needs what torch.compile needs \(no C\+\+ compiler found\)"):
        assert make(execution="compile")._plan.execution == "eager"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"precision": "fp16"}, "precision='fp16' is unknown; choose one of .*'bf16'"),
        ({"execution": "fuse"}, "execution='fuse' is unknown.*Did you mean 'fused'"),
        ({"overlap": "yes"}, "overlap='yes' must be True, False or None"),
    ],
)
def test_wrong_options_are_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        ExecutionConfig(**options)
    with pytest.raises(ConfigError, match=message):
        make(**options)


def test_overlap_needs_updates_counted_in_steps():
    with pytest.raises(ConfigError, match="overlap=True needs train_freq in steps"):
        ARSSAC("MlpPolicy", "Pendulum-v1", train_freq=(1, "episode"), overlap=True, device="cpu")


def test_a_saved_model_goes_on_with_another_execution(tmp_path):
    model = make(execution="fused", precision="bf16").learn(400)
    model.save(tmp_path / "model")
    env = make_toy_env(seed=0)
    same = ARSSAC.load(tmp_path / "model", env=env)
    assert same._plan == model._plan and th.equal(parameters(same), parameters(model))
    assert same.actor.latent_pi.fused and same.actor.optimizer.param_groups[0]["fused"]
    eager = ARSSAC.load(tmp_path / "model", env=env, execution="eager", precision="fp32")
    assert not eager.actor.latent_pi.fused and not eager.actor.optimizer.param_groups[0]["fused"]
    for loaded in (same, eager):
        loaded.replay_buffer = model.replay_buffer
        loaded.learn(400, reset_num_timesteps=False)
        assert th.isfinite(parameters(loaded)).all()


def test_preparing_an_optimizer_keeps_its_steps_and_its_next_one():
    results = []
    for prepared in (False, True):
        parameter = nn.Parameter(th.ones(3))
        optimizer = th.optim.Adam([parameter], lr=0.1)
        for step in range(3):
            if prepared and step == 1:
                prepare_optimizer_(optimizer, fused=True, capturable=False)
            parameter.grad = th.tensor([1.0, -2.0, 3.0]) * (step + 1)
            optimizer.step()
        results.append(parameter.detach())
    assert th.allclose(*results, atol=1e-6)
    assert optimizer.state[parameter]["step"] == 3


# ---------------------------------------------------------------------- overlap


@BOTH
def test_overlap_is_deterministic_and_does_one_update_fewer(algorithm):
    serial = make(algorithm, overlap=False).learn(600)
    first, second = (make(algorithm, overlap=True).learn(600) for _ in range(2))
    assert th.equal(parameters(first), parameters(second))
    assert first._n_updates == second._n_updates == serial._n_updates - 1 > 50
    assert not th.equal(parameters(first), parameters(serial))


def test_overlap_gives_the_same_with_and_without_workers():
    runs = [make(env=make_toy_env(seed=0, n_workers=n), overlap=True).learn(500) for n in (0, 2)]
    assert th.equal(*map(parameters, runs))
    runs[1].env.close()


def test_with_overlap_updates_run_between_sending_actions_and_awaiting_them(monkeypatch):
    model = make(overlap=True, updates_after_reset=3, param_resets=[400], n_reset=None)
    events = []

    def note(target, name, event):
        original = getattr(target, name)
        monkeypatch.setattr(target, name, lambda *a, **k: (events.append(event), original(*a, **k))[1])

    note(model.env, "step_async", "send")
    note(model.env, "step_wait", "wait")
    note(model, "_sample_and_update", "update")
    note(model, "reset_networks", "reset")
    model.learn(600)
    after = events[events.index("update") - 1 :]
    steady = [key for key, _ in itertools.groupby(after)]
    assert steady[:6] == ["send", "update", "wait"] * 2
    at = after.index("reset")  # between two steps, its updates at once
    assert after[at - 1 : at + 6] == ["wait", "reset", "update", "update", "update", "send", "update"]
    assert after[-1] == "wait"


def test_a_failing_update_leaves_no_step_under_way():
    model = make(overlap=True)

    def fail(*args):
        raise RuntimeError("the update failed")

    model._sample_and_update = fail
    with pytest.raises(RuntimeError, match="the update failed"):
        model.learn(600)
    assert model.env.reset().shape == (4, 10)


def test_a_failing_environment_is_reported_although_an_update_ran():
    class Failing(PointTask):
        def step(self, action):
            if self.np_random.random() < 0.01:
                raise ValueError("the simulator failed")
            return super().step(action)

    model = make(env=make_multitask_env({"a": Failing, "b": PointTask}, seed=0, n_workers=0), overlap=True)
    with pytest.raises(WorkerError, match="task 'a' raised ValueError"):
        model.learn(5000)


@pytest.mark.parametrize("steps", [200, 400])  # the first ends with the random phase
@pytest.mark.filterwarnings("ignore:.*leaves no updates")
def test_train_called_by_the_user_trains_whatever_overlap_is(steps):
    model = make(overlap=True).learn(steps)
    n_updates = model._n_updates
    model.train(gradient_steps=2, batch_size=16)
    assert model._n_updates == n_updates + 2


@pytest.mark.parametrize(("gradient_steps", "train_freq", "per_rollout"), [(-1, 1, 4), (3, 2, 3)])
def test_overlap_does_a_rollouts_updates(gradient_steps, train_freq, per_rollout):
    models = [
        make(overlap=overlap, gradient_steps=gradient_steps, train_freq=train_freq).learn(400)
        for overlap in (False, True)
    ]
    assert models[0]._n_updates - models[1]._n_updates == per_rollout


# ---------------------------------------------------------------------- on a GPU, as far as it goes without one


@pytest.fixture
def without_a_gpu(monkeypatch):
    """Let what is captured run at once; the list says what was waited for."""
    events = []
    event = SimpleNamespace(
        record=lambda: events.append("chosen"), synchronize=lambda: events.append("actions")
    )
    monkeypatch.setattr(th.cuda, "Event", lambda: event)
    monkeypatch.setattr(CapturedCalls, "__call__", lambda self, function, *args, **kwargs: function())
    return events


def test_the_captured_actor_computes_what_the_policy_does(without_a_gpu):
    model = make()
    actor = CapturedActor(model.actor, (4, 10, 2), th.device("cpu"))
    obs = model.env.reset()
    assert np.allclose(actor(obs, deterministic=True), model.predict(obs, deterministic=True)[0], atol=1e-6)
    sampled = [actor(obs, deterministic=False) for _ in range(2)]
    assert not np.allclose(*sampled) and np.abs(sampled).max() <= 1


def captured(**options):
    model = make(overlap=True, **options)
    model._plan = dataclasses.replace(model._plan, execution="cudagraph")
    return model


def test_a_captured_update_is_queued_before_the_actions_are_awaited(without_a_gpu, monkeypatch):
    model, events = captured(train_freq=2), without_a_gpu

    def note(target, name, event):
        original = getattr(target, name)
        monkeypatch.setattr(target, name, lambda *a, **k: (events.append(event), original(*a, **k))[1])

    note(model.env, "step_async", "send")
    note(model.env, "step_wait", "wait")
    note(model, "_sample_and_update", "update")
    model.learn(600)
    step = ["chosen", "actions", "send", "wait"]
    at = events.index("update") - 1
    assert events[at : at + 18] == [step[0], "update", *step[1:], *step] * 2


def test_when_a_captured_update_is_queued_changes_no_bit(without_a_gpu, monkeypatch):
    early = captured().learn(600)
    choose = CapturedActor.__call__
    monkeypatch.setattr(CapturedActor, "__call__", lambda self, obs, how, _: choose(self, obs, how))
    late = captured().learn(600)
    assert early._n_updates == late._n_updates > 50
    assert th.equal(parameters(early), parameters(late))


def test_predictions_outside_a_rollout_queue_no_update(without_a_gpu):
    class Predict(BaseCallback):
        def _on_rollout_start(self):
            n_updates = self.model._n_updates
            self.model.predict(self.model._last_obs)
            assert self.model._n_updates == n_updates

        def _on_step(self):
            return True

    model = captured().learn(600, callback=Predict())
    assert model._n_updates > 50


def test_a_failing_captured_update_leaves_no_step_under_way(without_a_gpu):
    model = captured()

    def fail(*args):
        raise RuntimeError("the update failed")

    model._sample_and_update = fail
    with pytest.raises(RuntimeError, match="the update failed"):
        model.learn(600)
    assert model.env.reset().shape == (4, 10)


class RecordedGraph:
    """Stands in for a CUDA graph: says what was done to it."""

    def __init__(self):
        self.events = []

    def register_generator_state(self, generator):
        self.events.append(generator)

    def replay(self):
        self.events.append("replay")


def test_calls_are_captured_after_three_and_anew_when_what_was_frozen_changes(monkeypatch):
    stream = SimpleNamespace(wait_stream=lambda other: None)
    fakes = {"Stream": lambda: stream, "current_stream": lambda: stream, "stream": contextlib.nullcontext}
    fakes |= {"CUDAGraph": RecordedGraph, "graph": contextlib.nullcontext, "synchronize": lambda: None}
    for name, fake in fakes.items():
        monkeypatch.setattr(th.cuda, name, fake)
    calls, ran = CapturedCalls(), []

    def call(variant, key):
        return calls(lambda: ran.append((variant, key)) or len(ran), variant, key, ["generator"])

    assert [call("a", 1) for _ in range(6)] == [1, 2, 3, 4, 4, 4]  # three eager, one captured, then replays
    assert call("b", 1) == 5  # another variant needs no new warm-up
    graph, _ = calls._captured["a"]
    assert graph.events == ["generator", "replay", "replay", "replay"]
    assert [call("a", 2) for _ in range(5)] == [6, 7, 8, 9, 9]
    assert ran == [("a", 1)] * 4 + [("b", 1)] + [("a", 2)] * 4


# ---------------------------------------------------------------------- time by part


def test_the_parts_of_a_profile_sum_to_the_time_and_nest(monkeypatch):
    clock = itertools.count()
    monkeypatch.setattr("time.perf_counter", lambda: float(next(clock)))
    timer = PartTimer()  # 0
    with timer("step"):  # 1
        with timer("critic"):  # 2
            pass  # 3
    assert timer.seconds() == {"step": 2.0, "critic": 1.0, "other": 2.0}  # left at 4, read at 5


def test_a_profiled_run_reports_every_part():
    model = make()
    model.timer = PartTimer()
    model.learn(600)
    seconds = model.timer.seconds()
    assert set(seconds) == set(PARTS) - {"update"} and list(seconds) == [p for p in PARTS if p in seconds]
    assert seconds["critic"] > seconds["log"] > 0


def test_a_model_with_a_timer_can_be_saved(tmp_path):
    model = make()
    model.timer = PartTimer()
    model.save(tmp_path / "model")
    assert not isinstance(ARSSAC.load(tmp_path / "model").timer, PartTimer)
