"""PopArt: statistics by hand, outputs preserved across their updates, and the update period."""

import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_ars.nets.popart import PopArt, update_statistics

N_TASKS, BATCH, WIDTH = 3, 50, 8


def make(n_layers=4, n_outputs=1):
    th.manual_seed(0)
    return [PopArt(WIDTH, N_TASKS, n_outputs) for _ in range(n_layers)]


def rows(n=7, seed=1):
    generator = th.Generator().manual_seed(seed)
    task = th.nn.functional.one_hot(th.randint(N_TASKS, (n,), generator=generator), N_TASKS).float()
    return th.randn(n, WIDTH, generator=generator), task


def targets(mean=(5.0, -300.0, 0.02), std=(100.0, 2.0, 0.01), seed=0, m=1):
    noise = th.randn(N_TASKS, BATCH, m, generator=th.Generator().manual_seed(seed))
    y = th.tensor(mean).view(-1, 1, 1) + th.tensor(std).view(-1, 1, 1) * noise
    return y.flatten(0, 1)


def test_statistics_by_hand():
    layer = PopArt(1, n_tasks=2)
    with th.no_grad():
        layer.linear.weight.fill_(2.0)
        layer.linear.bias.fill_(1.0)
    update_statistics([layer], th.tensor([[4.0], [8.0], [0.0], [0.0]]), rate=0.5)
    # task 0: mu = 0/2 + 6/2 = 3, nu = 1/2 + (16 + 64)/4 = 20.5, sigma = sqrt(20.5 - 9); task 1: mu = 0, nu = 1/2
    sigma = [11.5**0.5, 0.5**0.5]
    assert layer.mean.tolist() == pytest.approx([3.0, 0.0])
    assert layer.std.tolist() == pytest.approx(sigma)
    assert (layer.running_variance + layer.running_mean**2).tolist() == pytest.approx([20.5, 0.5])
    # W = 2 / sigma, b = (1 + 0 - mu) / sigma
    assert layer.linear.weight[:, 0].tolist() == pytest.approx([2 / sigma[0], 2 / sigma[1]])
    assert layer.linear.bias.tolist() == pytest.approx([-2 / sigma[0], 1 / sigma[1]])


def test_a_second_update_continues_from_the_first():
    layer = PopArt(1, n_tasks=1)
    for value in (4.0, 10.0):
        update_statistics([layer], th.tensor([[value]]), rate=0.5)
    # mu: 2, 6; nu: (1 + 16) / 2 = 8.5, (8.5 + 100) / 2 = 54.25
    assert layer.mean.item() == pytest.approx(6.0)
    assert layer.std.item() == pytest.approx((54.25 - 36) ** 0.5)


def test_values_are_scaled_by_the_rows_own_task():
    (layer,) = make(1)
    layer.mean.copy_(th.tensor([1.0, 20.0, 300.0]))
    layer.std.copy_(th.tensor([2.0, 3.0, 4.0]))
    task = th.eye(3)[[2, 0]]
    assert layer.denormalize(th.ones(2, 2), task).tolist() == [[304.0, 304.0], [3.0, 3.0]]
    assert layer.normalize(th.tensor([[304.0], [3.0]]), task).tolist() == [[1.0], [1.0]]
    features, _ = rows(2)
    assert th.equal(layer(features, task), layer.denormalize(layer.normalized(features, task), task))


@pytest.mark.parametrize("n_outputs", [1, 5])
def test_a_fresh_layer_is_the_plain_layer_per_task(n_outputs):
    (layer,) = make(1, n_outputs)
    features, task = rows()
    wide = layer.linear.weight.view(N_TASKS, n_outputs, WIDTH)[task.argmax(1)]
    expected = (wide @ features.unsqueeze(2)).squeeze(2) + layer.linear.bias.view(N_TASKS, -1)[task.argmax(1)]
    assert th.allclose(layer(features, task), expected, atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(
    mean=st.tuples(*[st.floats(-1e3, 1e3, width=32)] * N_TASKS),
    std=st.tuples(*[st.floats(0.0, 1e3, width=32)] * N_TASKS),
    rate=st.sampled_from([3e-4, 0.1, 0.9]),
    n_outputs=st.sampled_from([1, 5]),
)
def test_outputs_are_preserved_by_every_update(mean, std, rate, n_outputs):
    layers = make(4, n_outputs)
    features, task = rows()
    for seed in range(3):
        before = [layer(features, task) for layer in layers]
        update_statistics(layers, targets(mean, std, seed), rate)
        scale = max(1.0, layers[0].std.max().item(), layers[0].mean.abs().max().item())
        for layer, old in zip(layers, before, strict=True):
            assert (layer(features, task) - old).abs().max() < 1e-4 * scale


def test_all_layers_share_the_statistics():
    layers = make()
    update_statistics(layers, targets(), rate=0.3)
    for layer in layers[1:]:
        for name, buffer in layers[0].named_buffers():
            assert th.equal(buffer, dict(layer.named_buffers())[name])


def test_statistics_reach_those_of_stationary_targets():
    layers = make(1)
    for step in range(400):
        update_statistics(layers, targets(seed=step), rate=0.03)
    assert layers[0].mean.tolist() == pytest.approx([5.0, -300.0, 0.02], abs=8)
    assert layers[0].mean.tolist()[1:] == pytest.approx([-300.0, 0.02], rel=0.1)
    assert layers[0].std.tolist() == pytest.approx([100.0, 2.0, 0.01], rel=0.1)


def test_the_loss_on_large_targets_is_of_order_one():
    layers = make(1)
    for step in range(600):
        update_statistics(layers, targets(seed=step), rate=0.03)
    task = th.eye(N_TASKS).repeat_interleave(BATCH, dim=0)
    y = targets(seed=999)
    normalized = layers[0].normalize(y, task).view(N_TASKS, BATCH)
    assert (0.5 < normalized.square().mean(dim=1)).all() and (normalized.square().mean(dim=1) < 2).all()


def test_a_small_spread_around_a_large_mean_is_not_lost_to_rounding():
    layers = make(1)
    for step in range(400):
        update_statistics(layers, targets(mean=(1e4,) * 3, std=(0.5,) * 3, seed=step), rate=0.1)
    assert layers[0].std.tolist() == pytest.approx([0.5] * 3, rel=0.2)


def test_sigma_stays_in_its_bounds():
    layers = make(1)
    for _ in range(30):
        update_statistics(layers, th.zeros(N_TASKS * BATCH, 1), rate=0.9)
    assert layers[0].std.tolist() == pytest.approx([1e-4] * N_TASKS)
    update_statistics(layers, targets(std=(1e9,) * 3), rate=0.9)
    assert layers[0].std.tolist() == pytest.approx([1e6] * N_TASKS)


@pytest.mark.parametrize("period", [1, 10, 50])
def test_statistics_of_any_period_coincide_whenever_they_are_put_to_use(period):
    every, kth = make(2), make(2)
    features, task = rows()
    for step in range(1, 101):
        y = targets(seed=step)
        update_statistics(every, y, rate=0.05)
        parameters = [p.clone() for layer in kth for p in (layer.linear.weight, layer.linear.bias)]
        used = kth[0].mean.clone(), kth[0].std.clone()
        refresh = step % period == 0
        update_statistics(kth, y, rate=0.05, refresh=refresh)
        assert th.equal(kth[0].running_mean, every[0].running_mean)
        if refresh:
            assert th.equal(kth[0].mean, every[0].mean) and th.equal(kth[0].std, every[0].std)
            for a, b in zip(kth, every, strict=True):
                assert th.allclose(a(features, task), b(features, task), atol=0.02)
        else:  # nothing in use moves by a bit
            assert th.equal(kth[0].mean, used[0]) and th.equal(kth[0].std, used[1])
            after = [p for layer in kth for p in (layer.linear.weight, layer.linear.bias)]
            assert all(map(th.equal, parameters, after))


def test_updates_are_in_place_and_fit_in_one_graph():
    layers, reference = make(2), make(2)
    addresses = [value.data_ptr() for layer in layers for value in layer.state_dict().values()]
    th._dynamo.reset()
    compiled = th.compile(update_statistics, backend="eager", fullgraph=True)
    compiled(layers, targets(), 0.1)
    update_statistics(reference, targets(), 0.1)
    assert addresses == [value.data_ptr() for layer in layers for value in layer.state_dict().values()]
    for layer, other in zip(layers, reference, strict=True):
        for value, expected in zip(layer.state_dict().values(), other.state_dict().values(), strict=True):
            assert th.equal(value, expected)


def test_other_tasks_do_not_move():
    layers = make(1)
    y = targets()
    update_statistics(layers, y, rate=0.1)
    scaled = make(1)
    changed = y.clone()
    changed[:BATCH] *= 7
    update_statistics(scaled, changed, rate=0.1)
    for name, value in layers[0].state_dict().items():
        assert th.equal(value[1:], scaled[0].state_dict()[name][1:]), name
        assert not th.equal(value[0], scaled[0].state_dict()[name][0]), name
