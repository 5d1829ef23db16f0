"""Every preset, brought to the toy tasks: it trains, resets, saves, loads, goes on and predicts, as SAC and as TQC."""

import dataclasses

import numpy as np
import pytest
import torch as th

from benchmarks.toy_methods import toy_config
from sb3_ars import ARSSAC, ARSTQC
from sb3_ars.experiments import preset_names
from sb3_ars.experiments.config import load_preset
from sb3_ars.experiments.runner import build_model, make_env, method_callbacks

ALGORITHMS = {"ARSSAC": ARSSAC, "ARSTQC": ARSTQC}
STEPS = 400
PAPERS = [name for name in preset_names() if name not in ("toy", "demo")]


def small(name, algorithm):
    config = toy_config(name, seed=0, total_timesteps=STEPS)
    return dataclasses.replace(
        config,
        algorithm=dataclasses.replace(
            config.algorithm, algorithm=algorithm, batch_size=8, buffer_size=400, device="cpu"
        ),
        ars=dataclasses.replace(config.ars, updates_after_reset=2),
    )


def distinct():
    """One preset of each that are the same on the toy tasks: MT10's and MT50's, say."""
    seen = {}
    for name in PAPERS:
        for algorithm in ALGORITHMS:
            seen.setdefault(repr(small(name, algorithm)), (name, algorithm))
    return list(seen.values())


@pytest.mark.parametrize(("name", "algorithm"), distinct())
def test_it_trains_resets_saves_loads_goes_on_and_predicts(name, algorithm, tmp_path):
    config = small(name, algorithm)
    env = make_env(config)
    model = build_model(config, env)
    before = parameters(model)
    model.learn(STEPS, callback=method_callbacks(config))
    assert STEPS <= model.num_timesteps < STEPS + 4 * config.algorithm.train_freq
    assert model._n_updates > STEPS / 4 / config.algorithm.train_freq / 2
    resets = load_preset(name).ars.reset_times(20_000_000, n_tasks=10)
    if config.schedule.name == "none":  # a schedule resets when it takes new tasks
        assert (model.n_resets > 0) is bool(resets)
    assert model.lora_is_enabled is (config.ars.lora is not None)
    assert th.isfinite(parameters(model)).all() and not th.equal(parameters(model)[: len(before)], before)
    obs = env.reset()
    actions, _ = model.predict(obs, deterministic=True)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = ALGORITHMS[algorithm].load(tmp_path / "model", env=make_env(config))
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert np.allclose(loaded.predict(obs, deterministic=True)[0], actions, atol=1e-6)
    before, steps = parameters(loaded), loaded.num_timesteps
    loaded.learn(40, callback=method_callbacks(config), reset_num_timesteps=False)
    assert loaded.num_timesteps >= steps + 40 and not th.equal(parameters(loaded), before)


def parameters(model):
    return th.cat([p.detach().flatten() for p in model.policy.parameters()])
