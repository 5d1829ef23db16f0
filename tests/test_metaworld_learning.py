"""The method on real Meta-World: the scales after the random phase."""

import pytest

from sb3_ars import ARSSAC, make_metaworld_env


def scales_after_the_random_phase(episodes, horizon=500):
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
        return dict(zip(model.task_names, model.reward_scale.scale.tolist(), strict=True))
    finally:
        env.close()


HARD = {"pick-place-v3", "peg-insert-side-v3", "push-v3"}  # paper, section 5.2 and Figure 5


@pytest.mark.metaworld
def test_scales_after_a_short_random_phase_rank_the_papers_hard_tasks_first():
    scale = scales_after_the_random_phase(episodes=12)
    assert set(sorted(scale, key=scale.get, reverse=True)[:3]) == HARD, scale
    assert min(scale.values()) == 1.0


@pytest.mark.slow
@pytest.mark.metaworld
def test_scales_after_the_papers_random_phase_are_over_twenty_for_the_hard_tasks():
    scale = scales_after_the_random_phase(episodes=50)  # 25,000 steps a task, as the authors' code
    assert set(sorted(scale, key=scale.get, reverse=True)[:3]) == HARD, scale
    assert all(scale[name] > 20 for name in HARD), scale
