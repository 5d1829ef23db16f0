"""What must hold on a CUDA device; run with ``pytest -m gpu`` on a machine that has one."""

import pickle

import pytest
import torch as th

from sb3_ars import ARSSAC, ARSTQC, make_toy_env

pytestmark = pytest.mark.gpu
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
        model._draw_noise = lambda actions, d=model.device: tuple(n.to(d) for n in noise)
        model.train(gradient_steps=3, batch_size=16)
    for a, b in zip(cpu.policy.parameters(), cuda.policy.parameters(), strict=True):
        assert th.allclose(a, b.cpu(), atol=1e-4)


def test_a_buffer_pickled_on_cuda_draws_the_same_rows_again():
    model = ARSSAC("MlpPolicy", make_toy_env(seed=0), device="cuda", n_reset=0, **SMALL).learn(200)
    copy = pickle.loads(pickle.dumps(model.replay_buffer))
    copy.device = "cuda"
    assert th.equal(copy.draw_slots(8), model.replay_buffer.draw_slots(8))
