"""What must hold on a CUDA device; run with ``pytest -m gpu`` on a machine that has one."""

import pickle

import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_ars import ARSSAC, ARSTQC, RunCheckpoint, make_toy_env
from sb3_ars.algorithms.execution import CapturedActor
from sb3_ars.core.update import Noise

pytestmark = [pytest.mark.gpu, pytest.mark.filterwarnings("ignore:.*leaves no updates")]
SMALL = {
    "policy_kwargs": {"net_arch": [32, 32]},
    "batch_size": 16,
    "buffer_size": 1000,
    "updates_after_reset": 5,
    "seed": 0,
}


@pytest.mark.parametrize("algorithm", [ARSSAC, ARSTQC])
def test_training_on_cuda_keeps_everything_there_and_loads_on_the_cpu(algorithm, tmp_path):
    model = algorithm("MlpPolicy", make_toy_env(seed=0), device="cuda", n_reset=2, **SMALL).learn(800)
    tensors = [
        *model.policy.parameters(),
        model.log_ent_coef,
        model.reward_scale.scale,
        model.replay_buffer.rewards,
    ]
    assert {tensor.device.type for tensor in tensors} == {"cuda"} and model.n_resets == 2
    assert all(th.isfinite(tensor).all() for tensor in model.policy.parameters())
    model.save(tmp_path / "model")
    on_cpu = algorithm.load(tmp_path / "model", env=make_toy_env(seed=0), device="cpu")
    obs = model.env.reset()
    assert (
        abs(on_cpu.predict(obs, deterministic=True)[0] - model.predict(obs, deterministic=True)[0]).max()
        < 1e-4
    )
    on_cpu.learn(200)


def test_an_update_on_cuda_is_the_update_on_the_cpu_up_to_rounding():
    models = [
        ARSSAC("MlpPolicy", make_toy_env(seed=0), device=d, n_reset=0, **SMALL) for d in ("cpu", "cuda")
    ]
    cpu, cuda = (model.learn(64) for model in models)  # the random phase alone
    cuda.policy.load_state_dict(cpu.policy.state_dict())
    slots = cpu.replay_buffer.draw_slots(16)
    noise = th.randn(64, 2), th.randn(64, 2)
    for model in (cpu, cuda):
        model.replay_buffer.draw_slots = lambda n, d=model.device: slots.to(d)
        model._draw_noise = lambda actions, d=model.device: Noise(*(n.to(d) for n in noise))
        model.train(gradient_steps=3, batch_size=16)
    for a, b in zip(cpu.policy.parameters(), cuda.policy.parameters(), strict=True):
        assert th.allclose(a, b.cpu(), atol=1e-4)


def untrained(algorithm=ARSSAC, layer_norm=False, **options):
    options = {
        "n_reset": 2,
        "learning_starts": 200,
        "precision": "fp32",
        "overlap": False,
        **SMALL,
        **options,
    }
    options["policy_kwargs"] = {"net_arch": [32, 32], "critic_layer_norm": layer_norm}
    return algorithm("MlpPolicy", make_toy_env(seed=0), device="cuda", **options)


def trained(algorithm=ARSSAC, steps=1200, layer_norm=False, **options):
    return untrained(algorithm, layer_norm, **options).learn(steps)


def replayed(execution, n_updates, algorithm=ARSSAC, layer_norm=False, precision="fp32"):
    """Updates on the data and the random numbers of the eager run."""
    model = trained(algorithm, 200, layer_norm, n_reset=0, execution=execution, precision=precision)
    th.cuda.manual_seed(7)
    model.train(gradient_steps=n_updates, batch_size=16)
    return th.cat([p.detach().flatten().cpu() for p in model.policy.parameters()])


@pytest.mark.filterwarnings("ignore")  # torch.compile's about torch
@pytest.mark.parametrize("algorithm", [ARSSAC, ARSTQC])
@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("execution", ["cudagraph", "compile"])
def test_captured_and_compiled_updates_are_the_eager_ones(algorithm, layer_norm, execution):
    # three warm-up updates, then the graph; the same generators, so the same batches and noise
    before, eager = (replayed("eager", n, algorithm, layer_norm) for n in (0, 40))
    found = replayed(execution, 40, algorithm, layer_norm)
    assert (eager - found).norm() < 1e-2 * (eager - before).norm()


METHODS = {
    "pcgrad": ({}, {"gradient": "pcgrad"}),
    "multi_head": ({"body": {"name": "multi_head"}}, {}),
    "soft_modules": ({"body": {"name": "soft_modules"}}, {"task_weighting": "temperature"}),
    "moore": ({"body": {"name": "moore"}}, {}),
    "paco": ({"body": {"name": "paco"}}, {"max_task_loss": 0.85}),
    "popart": ({"critic_body": {"name": "popart", "update_period": 3}}, {"reward_scaling": "none"}),
    "lora": (
        {},
        {"lora": {"rank": 4, "start": 0.5, "min_success": 0}, "param_resets": [160], "n_reset": None},
    ),
}


@pytest.mark.filterwarnings("ignore")  # torch.compile's about torch
@pytest.mark.parametrize("algorithm", [ARSSAC, ARSTQC])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("execution", ["cudagraph", "compile"])
def test_every_method_is_captured_and_compiled_as_it_runs_eagerly(execution, method, algorithm):
    policy, options = METHODS[method]
    results = []
    for how, n_updates in (("eager", 0), ("eager", 40), (execution, 40)):
        model = _model(algorithm, how, policy, options)
        model.learn(200)
        th.cuda.manual_seed(7)
        model.train(gradient_steps=n_updates, batch_size=16)
        results.append(th.cat([p.detach().flatten().cpu() for p in model.policy.parameters()]))
    before, eager, found = results
    assert (eager - found).norm() < 1e-2 * (eager - before).norm()


def _model(algorithm, execution, policy, options):
    defaults = {"n_reset": 0, "learning_starts": 100, "precision": "fp32", "overlap": False}
    return algorithm(
        "MlpPolicy",
        make_toy_env(seed=0),
        device="cuda",
        execution=execution,
        **{**SMALL, **defaults, **options, "policy_kwargs": {"net_arch": [32, 32], **policy}},
    )


def test_a_captured_run_updates_resets_and_logs_as_an_eager_one(tmp_path):
    models = [trained(execution=execution) for execution in ("eager", "cudagraph")]
    assert models[1]._plan.execution == "cudagraph" and models[1]._captured_updates._captured
    assert models[0]._n_updates == models[1]._n_updates and models[1].n_resets == 2
    assert all(th.isfinite(p).all() for p in models[1].policy.parameters())
    models[1].save(tmp_path / "model")
    loaded = ARSSAC.load(tmp_path / "model", env=make_toy_env(seed=0), device="cuda")
    loaded.replay_buffer = models[1].replay_buffer
    loaded.learn(200, reset_num_timesteps=False)
    assert loaded._captured_updates._captured


def test_a_learning_rate_schedule_reaches_the_captured_update():
    model = trained(steps=400, n_reset=0, execution="cudagraph")
    model.lr_schedule = lambda progress: 0.0
    before = [p.clone() for p in model.policy.actor.parameters()]
    model.train(gradient_steps=3, batch_size=16)
    assert all(th.equal(a, b) for a, b in zip(before, model.policy.actor.parameters(), strict=True))


def test_the_captured_actor_acts_as_the_policy_does():
    model = trained(steps=400, n_reset=0, execution="cudagraph")
    obs = model._last_obs
    for _ in range(5):  # warm-up, capture, replay
        captured, _ = model.predict(obs, deterministic=True)
    eager, _ = model.policy.predict(obs, deterministic=True)
    assert abs(captured - eager).max() < 1e-5
    sampled = [model.predict(obs)[0] for _ in range(6)]
    assert abs(sampled[4] - sampled[5]).max() > 1e-3


@pytest.mark.parametrize("execution", ["eager", "cudagraph"])
def test_overlap_on_cuda_is_the_default_and_deterministic(execution):
    assert trained(steps=400, n_reset=0, overlap=None)._plan.overlap
    runs = [trained(execution=execution, overlap=True) for _ in range(2)]
    for a, b in zip(*(run.policy.parameters() for run in runs), strict=True):
        assert th.equal(a, b)


def test_when_a_captured_update_is_queued_changes_no_bit_on_cuda(monkeypatch):
    early = trained(execution="cudagraph", overlap=True)
    choose = CapturedActor.__call__
    monkeypatch.setattr(CapturedActor, "__call__", lambda self, obs, how, _: choose(self, obs, how))
    late = trained(execution="cudagraph", overlap=True)
    for a, b in zip(early.policy.parameters(), late.policy.parameters(), strict=True):
        assert th.equal(a, b)


@pytest.mark.parametrize("precision", ["tf32", "bf16"])
def test_reduced_precision_on_cuda_stays_near(precision):
    before, exact = (replayed("eager", n) for n in (0, 40))
    rounded = replayed("cudagraph", 40, precision=precision)
    assert (exact - rounded).norm() < 0.3 * (exact - before).norm()


def test_growing_the_terminal_frames_captures_anew():
    model = ARSSAC(
        "MlpPolicy", make_toy_env(seed=0), device="cuda", n_reset=0, optimize_memory_usage=True, **SMALL
    )
    model.learn(4000)
    assert model._captured_updates._key[-1] == model.replay_buffer.storage_version > 0


def test_a_buffer_pickled_on_cuda_draws_the_same_rows_again():
    model = ARSSAC("MlpPolicy", make_toy_env(seed=0), device="cuda", n_reset=0, **SMALL).learn(200)
    copy = pickle.loads(pickle.dumps(model.replay_buffer))
    copy.device = "cuda"
    assert th.equal(copy.draw_slots(8), model.replay_buffer.draw_slots(8))


@pytest.mark.parametrize("execution", ["eager", "cudagraph"])
@pytest.mark.parametrize("overlap", [False, True])
def test_a_resumed_run_on_cuda_is_the_whole_run(execution, overlap, tmp_path):
    class Stop(BaseCallback):
        def _on_step(self):
            return self.num_timesteps < 1003

    options = {"execution": execution, "overlap": overlap}
    whole = trained(**options)
    untrained(**options).learn(
        1200, callback=[RunCheckpoint(tmp_path, every=100, every_minutes=None), Stop()]
    )
    th.cuda.manual_seed(9)
    resumed = ARSSAC.resume(tmp_path, make_toy_env(seed=0), device="cuda")
    assert resumed.num_timesteps == 1000
    resumed.learn(resumed.remaining_timesteps, reset_num_timesteps=False)
    for a, b in zip(whole.policy.parameters(), resumed.policy.parameters(), strict=True):
        assert th.equal(a, b)
    assert th.equal(whole.replay_buffer.sample(16).rewards, resumed.replay_buffer.sample(16).rewards)
