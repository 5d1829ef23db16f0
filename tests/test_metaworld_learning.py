"""The method on real Meta-World: the scales after the random phase."""

import pytest

from sb3_ars import ARSSAC, make_metaworld_env


@pytest.mark.metaworld
def test_scales_after_the_random_phase_rank_the_papers_hard_tasks_first():
    # paper, section 5.2 and Figure 5: pick-place, peg-insert-side and push start with the largest scales
    episodes, horizon = 6, 500
    env = make_metaworld_env("MT10", seed=0, max_episode_steps=horizon)
    try:
        random_phase = 10 * horizon * episodes
        model = ARSSAC(
            "MlpPolicy",
            env,
            policy_kwargs={"net_arch": [8]},
            buffer_size=horizon * episodes + 1,
            learning_starts=random_phase,
            gradient_steps=0,
            n_reset=0,
            seed=0,
        ).learn(random_phase + 10)
        scale = dict(zip(model.task_names, model.reward_scale.scale.tolist(), strict=True))
    finally:
        env.close()
    hardest = sorted(scale, key=scale.get, reverse=True)[:3]
    assert set(hardest) == {"pick-place-v3", "peg-insert-side-v3", "push-v3"}
    assert all(scale[name] > 20 for name in hardest), scale
    assert min(scale.values()) == 1.0
