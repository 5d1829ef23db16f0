"""The method's formulas against numbers worked out by hand, and properties any correct version has."""

import math

import numpy as np
import pytest
import torch as th
from sb3_contrib.common.utils import quantile_huber_loss as contrib_quantile_huber_loss
from torch import nn

from sb3_ars.core.objectives import SACObjective, TQCObjective, quantile_huber_loss
from sb3_ars.core.reset import reset_module_, reset_optimizer_
from sb3_ars.core.reward_scale import RewardScale, RewardStatistics, mean_reward_scale, parse_reward_scaling
from sb3_ars.core.targets import soft_target
from sb3_ars.core.temperature import per_row, temperature_loss
from sb3_ars.core.update import squashed_gaussian
from sb3_ars.errors import ConfigError


def statistics(mean, std=None, names=None):
    mean = th.tensor(mean, dtype=th.float64)
    std = th.ones_like(mean) if std is None else th.tensor(std, dtype=th.float64)
    return RewardStatistics(mean, std, tuple(names or (f"t{i}" for i in range(len(mean)))))


def scale_of(rule, stats, floor=0.01):
    names = stats.task_names
    scale, shift = parse_reward_scaling(rule, names)(stats, floor)
    return scale.tolist(), shift.tolist()


# ---------------------------------------------------------------- reward scale (Eq. 6, Table 5)


def test_reward_scale_is_the_largest_mean_over_the_tasks_own():
    # means 2, 0.5, 0.1: 2/2, 2/0.5, 2/0.1
    assert mean_reward_scale(th.tensor([2.0, 0.5, 0.1])).tolist() == pytest.approx([1.0, 4.0, 20.0])


def test_reward_floor_bounds_the_scale():
    assert mean_reward_scale(th.tensor([3.0, 0.001]), reward_floor=0.01).tolist() == pytest.approx(
        [1.0, 300.0]
    )


def test_scaled_means_are_equal_above_the_floor():
    mean = th.tensor([5.0, 0.7, 0.02, 1.3])
    assert (mean_reward_scale(mean) * mean).tolist() == pytest.approx([5.0] * 4)


def test_one_task_is_never_scaled_by_its_own_mean():
    for mean in (5.0, 0.0, -3.0):
        assert scale_of("mean", statistics([mean])) == ([1.0], [0.0])


def test_standard_deviation_and_normalization_scale_as_in_table_5():
    stats = statistics([4.0, 1.0], std=[2.0, 0.25])
    assert scale_of("std", stats) == ([0.5, 4.0], [0.0, 0.0])
    assert scale_of("normalization", stats) == ([0.5, 4.0], [4.0, 1.0])


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (None, [1, 1]),
        ("none", [1, 1]),
        (100, [100, 100]),
        ([1, 7.5], [1, 7.5]),
        ({"push": 100}, [1, 100]),
    ],
)
def test_fixed_scales_are_taken_as_given(given, expected):
    scale, shift = scale_of(given, statistics([3.0, 0.2], names=["reach", "push"]))
    assert scale == expected and shift == [0, 0]


def test_reward_scale_acts_per_task_and_in_place():
    scale = RewardScale(2)
    address = scale.scale.data_ptr()
    scale.update_(th.tensor([1.0, 10.0]), th.tensor([0.0, 2.0]))
    reward = th.tensor([[1.0], [2.0], [3.0], [4.0]])
    assert scale(reward).flatten().tolist() == [1.0, 2.0, 10.0, 20.0]
    assert scale.scale.data_ptr() == address


def test_scaling_is_linear_in_the_scale():
    reward, scale = th.randn(6, 1), RewardScale(3)
    scale.update_(th.tensor([1.0, 2.0, 4.0]))
    once = scale(reward)
    scale.update_(3 * th.tensor([1.0, 2.0, 4.0]))
    assert th.allclose(scale(reward), 3 * once)


@pytest.mark.parametrize(
    ("mean", "named"),
    [
        ([1.0, -0.5], "push"),
        ([-1.0, -0.5], "reach"),
        ([0.0, 0.0], "reward_floor"),
        ([1.0, float("nan")], "push"),
    ],
)
def test_means_without_a_meaning_are_refused_by_name(mean, named):
    with pytest.raises(ConfigError, match=named):
        scale_of("mean", statistics(mean, names=["reach", "push"]))


def test_a_task_without_any_reward_yet_is_floored():
    assert scale_of("mean", statistics([2.0, 0.0]))[0] == [1.0, 200.0]


def test_a_floor_above_every_mean_is_refused():
    with pytest.raises(ConfigError, match=r"reward_floor=0\.01"):
        scale_of("mean", statistics([1e-3, 1e-5]))


def test_constant_rewards_are_refused_for_standard_deviation():
    with pytest.raises(ConfigError, match="push"):
        scale_of("std", statistics([1.0, 1.0], std=[1.0, 0.0], names=["reach", "push"]))


@pytest.mark.parametrize(
    "given", ["maen", [1.0], [1.0, 0.0], -3, True, {"pusch": 2.0}, float("nan"), [1.0, float("inf")]]
)
def test_bad_reward_scaling_is_refused(given):
    with pytest.raises(ConfigError, match="reward_scaling"):
        parse_reward_scaling(given, ["reach", "push"])


def test_unknown_rule_suggests_the_nearest():
    with pytest.raises(ConfigError, match="Did you mean 'mean'"):
        parse_reward_scaling("maen", ["reach"])


# ---------------------------------------------------------------- targets (Eq. 7)


def test_target_by_hand():
    # two tasks, one row each: c = 1 and 10, gamma 0.5, the second row terminal
    scale = RewardScale(2)
    scale.update_(th.tensor([1.0, 10.0]))
    target = soft_target(
        reward=th.tensor([[2.0], [3.0]]),
        done=th.tensor([[0.0], [1.0]]),
        discount=0.5,
        next_value=th.tensor([[8.0], [100.0]]),
        ent_coef=th.tensor([[0.1], [0.1]]),
        next_log_prob=th.tensor([[-20.0], [-20.0]]),
        reward_scale=scale,
    )
    # 1*2 + 0.5*(8 + 0.1*20) = 7;  10*3 + 0 = 30
    assert target.flatten().tolist() == pytest.approx([7.0, 30.0])


def test_scaling_one_task_changes_its_rows_only_and_never_the_entropy_term():
    reward = th.zeros(4, 1)  # all that is left of the target is bootstrap and entropy
    rest = (th.zeros(4, 1), 0.9, th.randn(4, 1), th.ones(1), th.randn(4, 1))
    plain, scaled = RewardScale(2), RewardScale(2)
    scaled.update_(th.tensor([1.0, 50.0]))
    assert th.equal(soft_target(reward, *rest, plain), soft_target(reward, *rest, scaled))
    reward = th.ones(4, 1)
    change = soft_target(reward, *rest, scaled) - soft_target(reward, *rest, plain)
    assert change.flatten().tolist() == pytest.approx([0, 0, 49, 49], abs=1e-5)


# ---------------------------------------------------------------- objectives


def test_sac_objective_by_hand():
    q = th.tensor([[[1.0], [3.0]], [[5.0], [4.0]]])  # two rows, two critics
    assert SACObjective().next_value(q).flatten().tolist() == [1.0, 4.0]
    assert SACObjective().actor_value(q).flatten().tolist() == [1.0, 4.0]
    assert SACObjective("first").actor_value(q).flatten().tolist() == [1.0, 5.0]
    # row 1: 0.5*((1-2)^2 + (3-2)^2) = 1; row 2: 0.5*(25 + 16) = 20.5
    assert SACObjective().loss(q, th.tensor([[2.0], [0.0]])).flatten().tolist() == [1.0, 20.5]


def test_quantile_huber_loss_by_hand():
    # one row, one critic, two quantiles at midpoints 0.25 and 0.75, one target at 1
    loss = quantile_huber_loss(th.tensor([[[0.5, 3.0]]]), th.tensor([[1.0]]))
    # error 0.5 -> huber 0.125 times 0.25; error -2 -> huber 1.5 times |0.75 - 1|
    assert loss.flatten().tolist() == pytest.approx([0.03125, 0.375])


@pytest.mark.parametrize("rows", [1, 7, 450])  # more than are computed at once
def test_the_fused_quantile_loss_and_its_gradient_are_the_plain_ones(rows):
    generator = th.Generator().manual_seed(rows)
    quantiles = (2 * th.randn(rows, 2, 5, generator=generator)).requires_grad_()
    target, weight = 2 * th.randn(rows, 8, generator=generator), th.rand(rows, 1, generator=generator)
    plain, fused = (TQCObjective(2, fused=fused).loss(quantiles, target) for fused in (False, True))
    by_row = plain.mean(dim=(1, 2, 3)).unsqueeze(1)
    assert fused.shape == (rows, 1) and th.allclose(by_row, fused, rtol=1e-5)
    expected, found = (th.autograd.grad((loss * weight).sum(), quantiles)[0] for loss in (by_row, fused))
    assert th.allclose(expected, found, rtol=1e-4, atol=1e-7)


def test_quantile_huber_loss_has_sb3_contribs_mean():
    quantiles, target = th.randn(7, 2, 5), th.randn(7, 8)
    expected = contrib_quantile_huber_loss(quantiles, target[:, None], sum_over_quantiles=False)
    assert th.equal(quantile_huber_loss(quantiles, target).mean(), expected)


def test_tqc_drops_the_largest_pooled_quantiles():
    q = th.tensor([[[4.0, 1.0], [3.0, 2.0]]])
    assert TQCObjective(1).next_value(q).tolist() == [[1.0, 2.0, 3.0]]
    assert TQCObjective(0).actor_value(q).tolist() == [[2.5]]
    assert TQCObjective(0, "first").actor_value(q).tolist() == [[2.5]]


# ---------------------------------------------------------------- temperature


def test_temperature_gradient_by_hand_and_per_task():
    log_ent_coef = th.tensor([0.3, -0.7], requires_grad=True)
    log_prob = th.tensor([[1.0], [3.0], [10.0], [20.0]])
    temperature_loss(log_ent_coef, log_prob, target_entropy=-2.0).backward()
    # -(mean of (1-2, 3-2)) / 2 tasks = 0;  -(mean of (8, 18)) / 2 = -6.5
    assert log_ent_coef.grad.tolist() == pytest.approx([0.0, -6.5])


def test_rows_get_their_own_tasks_temperature():
    assert per_row(th.tensor([1.0, 2.0]), 4).flatten().tolist() == [1, 1, 2, 2]
    assert per_row(th.tensor([5.0]), 3).flatten().tolist() == [5, 5, 5]


# ---------------------------------------------------------------- the policy's density


def test_log_density_of_the_squashed_gaussian_by_hand():
    actions, log_prob = squashed_gaussian(
        th.tensor([[0.2]]), th.tensor([[math.log(0.5)]]), th.tensor([[1.0]])
    )
    u = 0.2 + 0.5  # mean + std * noise
    density = -0.5 - math.log(0.5) - 0.5 * math.log(2 * math.pi)  # noise of 1 is one std away
    assert actions.item() == pytest.approx(math.tanh(u))
    assert log_prob.item() == pytest.approx(density - math.log(1 - math.tanh(u) ** 2 + 1e-6), rel=1e-5)


def test_density_of_the_squashed_gaussian_integrates_to_one():
    noise = th.linspace(-8, 8, 200_001).reshape(-1, 1)
    actions, log_prob = squashed_gaussian(th.tensor([[0.3]]), th.tensor([[-0.5]]), noise)
    assert np.trapezoid(log_prob.exp().flatten(), actions.flatten()) == pytest.approx(1.0, abs=1e-3)


# ---------------------------------------------------------------- reset


def test_reset_copies_in_place_and_clears_the_optimizer():
    live, fresh = nn.Linear(3, 2), nn.Linear(3, 2)
    optimizer = th.optim.Adam(live.parameters(), lr=0.1)
    live(th.ones(1, 3)).sum().backward()
    optimizer.step()
    addresses = [p.data_ptr() for p in live.parameters()]
    reset_module_(live, fresh)
    reset_optimizer_(optimizer)
    assert all(th.equal(a, b) for a, b in zip(live.parameters(), fresh.parameters(), strict=True))
    assert [p.data_ptr() for p in live.parameters()] == addresses
    assert all(not value.any() for state in optimizer.state.values() for value in state.values())
    assert optimizer.param_groups[0]["lr"] == 0.1


def test_an_optimizer_after_reset_steps_like_a_new_one():
    def step(optimizer, layer):
        optimizer.zero_grad()
        layer(th.ones(1, 3)).sum().backward()
        optimizer.step()

    live, fresh = nn.Linear(3, 2), nn.Linear(3, 2)
    used = th.optim.Adam(live.parameters(), lr=0.1)
    for _ in range(5):
        step(used, live)
    reset_module_(live, fresh)
    reset_optimizer_(used)
    step(used, live)
    step(th.optim.Adam(fresh.parameters(), lr=0.1), fresh)
    assert all(th.equal(a, b) for a, b in zip(live.parameters(), fresh.parameters(), strict=True))
