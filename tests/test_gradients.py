"""Gradient combiners against numbers by hand, the plain backward and a plain loop of the published algorithm."""

import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from sb3_ars.core.gradients import MeanGradient, PCGrad, projected_weights
from sb3_ars.errors import ConfigError
from sb3_ars.nets.bodies import build_body
from sb3_ars.nets.mlp import MLP


def uniforms(n_tasks, seed=0):
    return th.rand(n_tasks, n_tasks, generator=th.Generator().manual_seed(seed))


def combined(gradients, order=None, aggregate="mean"):
    """What PCGrad makes of tasks whose gradients are the given rows."""
    gradients = th.as_tensor(gradients)
    parameter = th.zeros(gradients.shape[1], dtype=gradients.dtype, requires_grad=True)
    losses = [(row * parameter).sum() for row in gradients]
    order = uniforms(len(gradients)) if order is None else order
    (gradient,) = PCGrad(aggregate).combine(losses, [parameter], order)
    return gradient


def plain_loop(gradients, order):
    projected = []
    for i, gradient in enumerate(gradients):
        others = [j for j in order[i].argsort().tolist() if j != i]
        for j in others:
            dot = gradient @ gradients[j]
            if dot < 0:
                gradient = gradient - dot / (gradients[j] @ gradients[j]) * gradients[j]
        projected.append(gradient)
    return th.stack(projected)


# ---------------------------------------------------------------- PCGrad


def test_two_conflicting_tasks_by_hand():
    # g1 = (1, 0), g2 = (-1, 1): g1.g2 = -1; v1 = g1 + g2 / 2 = (.5, .5); v2 = g2 + g1 = (0, 1)
    assert combined([[1.0, 0.0], [-1.0, 1.0]]).tolist() == pytest.approx([0.25, 0.75])
    assert combined([[1.0, 0.0], [-1.0, 1.0]], aggregate="sum").tolist() == pytest.approx([0.5, 1.5])


def test_the_order_decides_between_three_tasks_by_hand():
    # g1 = (1, 0) against g2 = (-1, 1) and g3 = (-1, -2)
    gradients = th.tensor([[1.0, 0.0], [-1.0, 1.0], [-1.0, -2.0]])
    gram = gradients @ gradients.t()
    first_2, first_3 = th.tensor([[0.0, 0.1, 0.2]] * 3), th.tensor([[0.0, 0.2, 0.1]] * 3)
    # 2 first: v = (.5, .5), v.g3 = -1.5, v = (.5, .5) + .3 (-1, -2) = (.2, -.1)
    assert (projected_weights(gram, first_2)[0] @ gradients).tolist() == pytest.approx([0.2, -0.1])
    # 3 first: v = (1, 0) + (-1, -2) / 5 = (.8, -.4), v.g2 = -1.2, v = (.8, -.4) + .6 (-1, 1) = (.2, .2)
    assert (projected_weights(gram, first_3)[0] @ gradients).tolist() == pytest.approx([0.2, 0.2])


def test_two_projected_gradients_are_orthogonal_to_the_other_original():
    gradients = th.tensor([[1.0, 2.0, -0.5], [-3.0, 0.4, 1.0]], dtype=th.float64)
    assert gradients[0] @ gradients[1] < 0
    projected = projected_weights(gradients @ gradients.t(), uniforms(2)) @ gradients
    assert (projected[0] @ gradients[1]).item() == pytest.approx(0, abs=1e-12)
    assert (projected[1] @ gradients[0]).item() == pytest.approx(0, abs=1e-12)


@settings(max_examples=40, deadline=None)
@given(n_tasks=st.integers(2, 7), width=st.integers(1, 9), seed=st.integers(0, 9999))
def test_coefficients_are_the_published_loop(n_tasks, width, seed):
    generator = th.Generator().manual_seed(seed)
    gradients = th.randn(n_tasks, width, generator=generator, dtype=th.float64)
    order = uniforms(n_tasks, seed)
    projected = projected_weights(gradients @ gradients.t(), order) @ gradients
    assert th.allclose(projected, plain_loop(gradients, order), atol=1e-9)
    assert th.allclose(combined(gradients, order), plain_loop(gradients, order).mean(dim=0), atol=1e-9)


def test_fifty_tasks_are_the_published_loop_in_float32():
    gradients = th.randn(50, 300, generator=th.Generator().manual_seed(0))
    expected = plain_loop(gradients.double(), uniforms(50)).mean(dim=0)
    assert (combined(gradients, uniforms(50)) - expected).abs().max() < 1e-5 * expected.abs().max()


def test_long_gradients_are_summed_in_pieces():
    gradients = th.randn(3, 70_000, generator=th.Generator().manual_seed(0)) - 0.01
    gradients[1] = -gradients[0] + 0.1 * gradients[1]
    expected = plain_loop(gradients.double(), uniforms(3)).mean(dim=0)
    assert th.allclose(combined(gradients, uniforms(3)).double(), expected, atol=1e-5)


def test_tasks_without_conflict_give_the_mean():
    gradients = th.rand(6, 20)
    assert th.allclose(combined(gradients), gradients.mean(dim=0), atol=1e-6)


def test_equal_tasks_give_the_single_gradient():
    gradient = th.randn(20)
    assert th.allclose(combined(gradient.expand(5, 20)), gradient, atol=1e-6)


def test_a_zero_gradient_divides_by_nothing():
    assert combined([[0.0, 0.0], [1.0, -1.0], [-2.0, 0.5]]).isfinite().all()
    assert combined(th.zeros(3, 2)).tolist() == [0, 0]


@pytest.mark.parametrize("seed", range(4))
def test_two_tasks_have_one_order(seed):
    gradients = [[1.0, 2.0], [-2.0, 0.3]]
    assert th.equal(combined(gradients, uniforms(2, seed)), combined(gradients, uniforms(2, seed + 1)))


def test_every_task_visits_the_others_in_its_own_order():
    gradients = th.randn(4, 3, generator=th.Generator().manual_seed(1), dtype=th.float64)
    gram, order = gradients @ gradients.t(), uniforms(4, seed=3)
    changed = order.clone()
    changed[2] = changed[2].flip(0)
    before, after = projected_weights(gram, order), projected_weights(gram, changed)
    assert th.equal(before[[0, 1, 3]], after[[0, 1, 3]])


# ---------------------------------------------------------------- on networks


def network_and_batch(n_tasks=3, batch=4):
    th.manual_seed(0)
    net = MLP(nn.Linear(5, 16), nn.ReLU(), nn.Linear(16, 2))
    return net, th.randn(n_tasks * batch, 5), th.randn(n_tasks * batch, 2)


def losses_of(net, x, y, groups):
    return [(net(x[rows]) - y[rows]).square().mean() for rows in groups]


def test_the_mean_gradient_is_the_plain_backward_to_the_bit():
    net, x, y = network_and_batch()
    unused = nn.Parameter(th.zeros(3))
    parameters = [*net.parameters(), unused]
    groups = MeanGradient().rows(len(x), 3)
    ours = MeanGradient().combine(losses_of(net, x, y, groups), parameters)
    (net(x) - y).square().mean().backward()
    assert ours[-1] is None
    for gradient, parameter in zip(ours, net.parameters(), strict=False):
        assert th.equal(gradient, parameter.grad)


def test_groups_are_the_tasks_rows():
    assert PCGrad().rows(12, 3) == [slice(0, 4), slice(4, 8), slice(8, 12)]
    assert MeanGradient().rows(12, 3) == [slice(0, 12)]


@pytest.mark.parametrize("body", [{"name": "multi_head"}, {"name": "paco", "n_parameter_sets": 2}])
def test_a_network_gets_the_loops_gradient_as_one_vector(body):
    th.manual_seed(0)
    net = build_body(body, 5, 2, 3, (16,), nn.ReLU)
    unused = nn.Parameter(th.zeros(3))
    parameters = [*net.parameters(), unused]
    x, task = th.randn(12, 5), th.eye(3).repeat_interleave(4, dim=0)
    y = (task @ th.tensor([9.0, -9.0, 0.5])).unsqueeze(1)  # the first two pull apart

    def losses():
        return [(net(x[rows], task[rows]) - y[rows]).square().mean() for rows in PCGrad().rows(12, 3)]

    flat = th.stack(
        [
            th.cat([g.flatten() for g in th.autograd.grad(loss, parameters, materialize_grads=True)])
            for loss in losses()
        ]
    )
    assert (flat @ flat.t()).min() < 0  # some pair is in conflict
    expected = plain_loop(flat.double(), uniforms(3)).mean(dim=0)
    ours = PCGrad().combine(losses(), parameters, uniforms(3))
    assert [gradient.shape for gradient in ours] == [parameter.shape for parameter in parameters]
    assert th.allclose(th.cat([gradient.flatten() for gradient in ours]).double(), expected, atol=1e-5)
    assert th.equal(ours[-1], th.zeros(3))


def test_the_projection_fits_in_one_graph():
    gram = th.randn(5, 8)
    gram = gram @ gram.t()
    th._dynamo.reset()
    compiled = th.compile(projected_weights, backend="eager", fullgraph=True)
    assert th.equal(compiled(gram, uniforms(5)), projected_weights(gram, uniforms(5)))


def test_what_cannot_work_is_refused():
    with pytest.raises(ConfigError, match="at least two tasks"):
        PCGrad().rows(100, 1)
    with pytest.raises(ConfigError, match=r"aggregate='men' is unknown.*Did you mean 'mean'\?"):
        PCGrad("men")
