"""The method on real Meta-World: the scales after the random phase."""

import pytest

from sb3_ars import ARSSAC, make_metaworld_env

HARD = {"pick-place-v3", "peg-insert-side-v3", "push-v3"}  # paper, section 5.2 and Figure 5


@pytest.mark.metaworld
def test_scales_after_the_random_phase_rank_the_papers_hard_tasks_first():
    random_phase = 10 * 25_000  # steps of ten tasks, as in the authors' code
    env = make_metaworld_env("MT10", seed=0)
    try:
        model = ARSSAC(
            "MlpPolicy",
            env,
            policy_kwargs={"net_arch": [8]},
            buffer_size=25_001,
            learning_starts=random_phase,
            gradient_steps=0,
            n_reset=0,
            seed=0,
        ).learn(random_phase + 10)
        scale = dict(zip(model.task_names, model.reward_scale.scale.tolist(), strict=True))
    finally:
        env.close()
    assert set(sorted(scale, key=scale.get, reverse=True)[:3]) == HARD, scale
    assert all(scale[name] > 20 for name in HARD), scale
    assert min(scale.values()) == 1.0
