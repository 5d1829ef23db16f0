"""The multi-task bodies: parameter counts, properties that any correct version has, and what is refused."""

import copy

import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from sb3_ars.errors import ConfigError
from sb3_ars.nets.bodies import BODIES, body_config, build_body
from sb3_ars.nets.layers import StackedLayerNorm, StackedLinear, TaskLinear
from sb3_ars.nets.mlp import fused_layers_are_available
from sb3_ars.nets.moore import orthonormal
from sb3_ars.nets.paco import PaCo
from sb3_ars.nets.popart import PopArt

N_TASKS, BATCH, IN, OUT = 3, 5, 7, 4
SMALL = {
    "multi_head": {},
    "soft_modules": {"n_layers": 3, "n_modules": 2, "module_width": 6, "gate_width": 5},
    "moore": {"n_experts": 3},
    "paco": {"n_parameter_sets": 2},
    "popart": {},
}
needs_onednn = pytest.mark.skipif(not fused_layers_are_available(), reason="this torch has no oneDNN layers")
every_body = pytest.mark.parametrize("name", list(BODIES))


def build(name, n_tasks=N_TASKS, hidden=(16, 16), activation=nn.ReLU, layer_norm=False, out=OUT, **options):
    th.manual_seed(0)
    return build_body(
        {"name": name, **SMALL[name], **options}, IN, out, n_tasks, hidden, activation, layer_norm
    )


def task_major_rows(n_tasks=N_TASKS, batch=BATCH, seed=1):
    """``x (n_tasks, batch, IN)`` and its one-hot."""
    x = th.randn(n_tasks, batch, IN, generator=th.Generator().manual_seed(seed))
    return x, th.eye(n_tasks).unsqueeze(1).expand(n_tasks, batch, n_tasks)


def flat_rows(**kwargs):
    x, task = task_major_rows(**kwargs)
    return x.flatten(0, 1), task.flatten(0, 1)


@th.no_grad()
def enlarged(body):
    """Weights of a trained network's size: freshly drawn, a deep body hardly shows what its input was."""
    for parameter in body.parameters():
        parameter.mul_(3)
    return body


def gradients(body, out):
    return th.autograd.grad(out.square().sum(), list(body.parameters()))


# ---------------------------------------------------------------- every body


@pytest.mark.parametrize(
    ("options", "in_features", "out_features", "n_tasks", "count"),
    [
        ({"name": "multi_head"}, 39, 8, 10, 533_280),
        ({"name": "multi_head"}, 39, 8, 50, 677_600),
        ({"name": "multi_head"}, 43, 1, 10, 506_810),
        ({"name": "multi_head"}, 43, 1, 50, 538_850),
        ({"name": "soft_modules"}, 39, 8, 10, 792_444),
        ({"name": "soft_modules"}, 39, 8, 50, 808_444),
        ({"name": "soft_modules", "n_layers": 2, "n_modules": 2, "module_width": 256}, 39, 8, 10, 691_022),
        ({"name": "moore"}, 39, 8, 10, 1_395_320),
        ({"name": "moore", "task_in_input": False}, 39, 8, 10, 1_379_320),
        ({"name": "moore", "n_experts": 6}, 39, 8, 50, 2_301_500),
        ({"name": "moore", "n_experts": 6, "task_in_input": False}, 39, 8, 50, 2_181_500),
        ({"name": "paco"}, 39, 8, 10, 1_700_040 + 10 * 5),
        ({"name": "paco", "n_parameter_sets": 20}, 39, 8, 50, 6_800_160 + 50 * 20),
    ],
)
def test_parameter_counts_are_the_derived_ones(options, in_features, out_features, n_tasks, count):
    hidden = body_config(options).net_arch
    body = build_body(options, in_features, out_features, n_tasks, hidden, nn.ReLU)
    assert sum(parameter.numel() for parameter in body.parameters()) == count


@every_body
@pytest.mark.parametrize("layer_norm", [False, True])
def test_rows_in_any_order_and_task_major_rows_are_the_same_function(name, layer_norm):
    body = build(name, layer_norm=layer_norm)
    x, task = task_major_rows()
    order = th.randperm(N_TASKS * BATCH, generator=th.Generator().manual_seed(2))
    task_major = body(x, task)
    any_order = body(x.flatten(0, 1)[order], task.flatten(0, 1)[order])
    assert task_major.shape == (N_TASKS, BATCH, OUT) and any_order.dtype == th.float32
    assert th.allclose(any_order, task_major.flatten(0, 1)[order], atol=1e-5)
    for a, b in zip(gradients(body, task_major), gradients(body, any_order), strict=True):
        assert th.allclose(a, b, atol=1e-4)


@every_body
def test_a_row_does_not_depend_on_the_other_rows(name):
    body = build(name)
    x, task = flat_rows()
    assert th.allclose(body(x, task)[4:5], body(x[4:5], task[4:5]), atol=1e-5)


@every_body
def test_the_task_changes_the_output(name):
    body = enlarged(build(name))
    x, task = flat_rows()
    assert (body(x, task) - body(x, task.roll(1, dims=1))).abs().max() > 1e-3


def with_tasks_renumbered(body, order):
    """A copy in which every parameter of task ``order[i]`` became task i's."""
    renumbered = copy.deepcopy(body)
    with th.no_grad():
        for module in renumbered.modules():
            if isinstance(module, TaskLinear):  # a block of rows per task
                for parameter in (module.weight, module.bias):
                    blocks = parameter.view(N_TASKS, -1)
                    blocks.copy_(blocks[order].clone())
            elif isinstance(module, (nn.Linear, StackedLinear)) and module.weight.shape[-1] in (
                N_TASKS,
                IN + N_TASKS,
            ):
                columns = module.weight[..., -N_TASKS:]  # a column per task
                columns.copy_(columns[..., order].clone())
            elif isinstance(module, PaCo):
                module.task_weights.copy_(module.task_weights[order].clone())
            elif isinstance(module, PopArt):
                for buffer in module.buffers(recurse=False):
                    buffer.copy_(buffer[order].clone())
    return renumbered


@every_body
def test_renumbering_the_tasks_renumbers_the_outputs(name):
    body = enlarged(build(name, task_in_input=name != "soft_modules"))
    for module in body.modules():
        if isinstance(module, PopArt):
            module.std.uniform_(1, 2)
            module.mean.normal_()
    order = th.tensor([2, 0, 1])
    x, task = task_major_rows()
    expected = body(x, task)[order]
    assert th.allclose(with_tasks_renumbered(body, order)(x[order], task), expected, atol=1e-4)
    assert not th.allclose(body(x[order], task), expected, atol=1e-3)


@every_body
@pytest.mark.parametrize("in_input", [False, True])
def test_task_in_input_widens_the_input_by_the_one_hot(name, in_input):
    body = build(name, task_in_input=in_input)
    first = next(
        module for module in body.modules() if isinstance(module, (nn.Linear, StackedLinear))
    )  # fmt: skip
    assert first.weight.shape[-1] == IN + N_TASKS * in_input


@every_body
def test_layer_norm_makes_the_output_blind_to_the_inputs_scale(name):
    x, task = task_major_rows()
    plain, normed = build(name, task_in_input=False), build(name, layer_norm=True, task_in_input=False)
    assert th.allclose(normed(100 * x, task), normed(50 * x, task), atol=1e-4)
    assert not th.allclose(plain(100 * x, task), plain(50 * x, task), atol=1e-2)


@every_body
def test_activation_is_the_one_asked_for(name):
    kinds = {type(module) for module in build(name, activation=nn.Tanh).modules()}
    assert nn.Tanh in kinds and nn.ReLU not in kinds


@every_body
@pytest.mark.filterwarnings("ignore:.*should not be instantiated")  # torch.compile's about torch
@pytest.mark.parametrize("task_major", [False, True])
def test_one_graph_holds_the_whole_body(name, task_major):
    # what needs a graph break (data-dependent control flow, a wait for the device) cannot be captured either
    body = build(name)
    rows = task_major_rows() if task_major else flat_rows()
    th._dynamo.reset()
    compiled = th.compile(body, backend="eager", fullgraph=True)
    assert th.equal(compiled(*rows), body(*rows))


@every_body
@settings(max_examples=15, deadline=None)
@given(scale=st.sampled_from([0.0, 1e-8, 1.0, 1e3]), n_tasks=st.integers(1, 4), seed=st.integers(0, 99))
def test_outputs_and_gradients_are_finite(name, scale, n_tasks, seed):
    body = build(name, n_tasks=n_tasks)
    x, task = task_major_rows(n_tasks=n_tasks, batch=2, seed=seed)
    out = body(scale * x, task)
    assert out.isfinite().all()
    assert all(gradient.isfinite().all() for gradient in gradients(body, out))


# ---------------------------------------------------------------- layers


@pytest.mark.parametrize("shared_input", [False, True])
def test_stacked_layers_are_the_layers_one_by_one(shared_input):
    stack, norm = StackedLinear(3, 5, 4), StackedLayerNorm(3, 4)
    with th.no_grad():
        norm.weight.normal_()
        norm.bias.normal_()
    x = th.randn(6, 5) if shared_input else th.randn(3, 6, 5)
    out = norm(stack(x))
    for k in range(3):
        own = nn.functional.linear(x if shared_input else x[k], stack.weight[k], stack.bias[k])
        own = nn.functional.layer_norm(own, (4,), norm.weight[k, 0], norm.bias[k, 0])
        assert th.allclose(out[k], own, atol=1e-6)


@needs_onednn
@pytest.mark.parametrize("kind", ["own", "strided", "shared"])
def test_fused_stacked_layers_are_the_same_function(kind):
    stack = StackedLinear(3, 33, 17)
    x = {
        "own": th.randn(3, 20, 33),
        "strided": th.randn(20, 3, 33).transpose(0, 1),
        "shared": th.randn(20, 33),
    }[kind]
    x.requires_grad_()

    def outputs_and_gradients():
        out = stack(x)
        return out, *th.autograd.grad(out.square().sum(), [x, *stack.parameters()])

    plain = outputs_and_gradients()
    stack.fused = True
    for a, b in zip(plain, outputs_and_gradients(), strict=True):
        assert th.allclose(a, b, rtol=1e-4, atol=1e-3)


@needs_onednn
@every_body
@pytest.mark.parametrize("task_major", [False, True])
def test_fused_bodies_are_the_same_function(name, task_major):
    body = build(name)
    rows = task_major_rows() if task_major else flat_rows()
    out = body(*rows)
    plain = gradients(body, out)
    for module in body.modules():
        module.fused = True
    fused = body(*rows)
    assert th.allclose(out, fused, atol=1e-5)
    for a, b in zip(plain, gradients(body, fused), strict=True):
        assert th.allclose(a, b, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("fused", [False, pytest.param(True, marks=needs_onednn)])
def test_bfloat16_rounds_operands_between_hidden_layers_only(fused):
    stack = StackedLinear(3, 33, 17)
    own, shared = th.randn(3, 20, 33), th.randn(20, 33)
    exact = stack(own), stack(shared)
    stack.fused, stack.precision = fused, "bf16"
    assert stack(own).dtype == th.float32
    assert 1e-5 < (stack(own) - exact[0]).abs().max() < 0.05
    assert th.allclose(stack(shared), exact[1], atol=1e-6)


def test_xavier_scales_every_copy_as_a_layer_of_its_own():
    stack, equal = StackedLinear(4, 300, 100), StackedLinear(4, 300, 100, identical=True)
    for layer in (stack, equal):
        layer.xavier_()
        assert th.equal(layer.bias, th.zeros_like(layer.bias))
        assert layer.weight.std(dim=(1, 2)).tolist() == pytest.approx([(2 / 400) ** 0.5] * 4, rel=0.05)
    assert th.equal(equal.weight[0], equal.weight[3]) and not th.equal(stack.weight[0], stack.weight[3])


def test_a_row_passes_through_its_own_tasks_layer():
    layer = TaskLinear(2, 1, n_tasks=2)
    with th.no_grad():
        layer.weight.copy_(th.tensor([[1.0, 2.0], [10.0, 20.0]]))
        layer.bias.copy_(th.tensor([0.5, 0.25]))
    x, task = th.tensor([[1.0, 1.0], [1.0, -1.0]]), th.eye(2)
    assert layer(x, task, task_major=True).tolist() == [[3.5], [-9.75]]
    assert layer(x, task.flip(0), task_major=False).tolist() == [[30.25], [-0.5]]


# ---------------------------------------------------------------- multi-head


@pytest.mark.parametrize("name", ["multi_head", "moore"])
@pytest.mark.parametrize("task_major", [False, True])
def test_a_tasks_gradient_is_exactly_zero_on_the_other_heads(name, task_major):
    body = build(name)
    x, task = task_major_rows() if task_major else flat_rows()
    out = body(x, task).view(N_TASKS, BATCH, OUT)
    (gradient,) = th.autograd.grad(out[1].square().sum(), body.heads.weight)
    of_head = gradient.view(N_TASKS, -1)
    assert th.equal(of_head[[0, 2]], th.zeros_like(of_head[[0, 2]])) and of_head[1].abs().max() > 0


def test_equal_heads_are_the_plain_network():
    body = build("multi_head")
    with th.no_grad():
        body.heads.weight.view(N_TASKS, -1).copy_(body.heads.weight.view(N_TASKS, -1)[:1].clone())
        body.heads.bias.view(N_TASKS, -1).copy_(body.heads.bias.view(N_TASKS, -1)[:1].clone())
    x, task = flat_rows()
    latent = body.trunk(th.cat([x, task], dim=1))
    plain = nn.functional.linear(latent, body.heads.weight[:OUT], body.heads.bias[:OUT])
    assert th.allclose(body(x, task), plain, atol=1e-6)


# ---------------------------------------------------------------- Soft Modularization


def test_routing_is_a_distribution_over_sources():
    body = build("soft_modules", n_modules=3)
    mixtures = body.routing(*flat_rows())
    assert [mixture.shape[1:] for mixture in mixtures] == [(3, 3), (3, 3), (1, 3)]
    for mixture in mixtures:
        assert (mixture > 0).all() and th.allclose(mixture.sum(dim=2), th.ones(()), atol=1e-6)


def test_routing_reads_all_earlier_probabilities():
    body = build("soft_modules", n_modules=2, n_layers=4)
    assert [layer.in_features for layer in body.routing_in] == [4, 8, 12]


def test_equal_modules_are_blind_to_the_task():
    body = enlarged(build("soft_modules"))
    x, task = flat_rows()
    different = body(x, task) - body(x, task.roll(1, dims=1))
    with th.no_grad():
        for layer in body.layers:
            layer.weight.copy_(layer.weight[:1].clone())
            layer.bias.copy_(layer.bias[:1].clone())
    equal = body(x, task) - body(x, task.roll(1, dims=1))
    assert different.abs().max() > 1e-2 and equal.abs().max() < 1e-5


def test_saturated_routing_is_the_plain_network_through_the_chosen_modules():
    body = build("soft_modules", n_modules=3)
    # destination j of layer l reads source (j + l) % 3; the output reads module 2
    with th.no_grad():
        for layer, routing in enumerate(body.routing_out):
            routing.weight.zero_()
            chosen = th.arange(3).add(layer).remainder(3) if layer < 2 else th.tensor([2])
            routing.bias.copy_(1e4 * nn.functional.one_hot(chosen, 3).flatten())
    x, task = flat_rows()
    # backwards from module 2 of layer 3: it reads module (2 + 1) % 3 = 0 of layer 2, which reads module 0 of layer 1
    hidden = body.embedding(x).relu()
    for layer, module in zip(body.layers, (0, 0, 2), strict=True):
        hidden = nn.functional.linear(hidden, layer.weight[module], layer.bias[module]).relu()
    assert th.allclose(body(x, task), body.output(hidden), atol=1e-6)


def test_one_module_per_layer_is_the_plain_network():
    body = build("soft_modules", n_modules=1)
    x, task = flat_rows()
    hidden = body.embedding(x).relu()
    for layer in body.layers:
        hidden = nn.functional.linear(hidden, layer.weight[0], layer.bias[0]).relu()
    assert th.allclose(body(x, task), body.output(hidden), atol=1e-6)


# ---------------------------------------------------------------- MOORE


def random_vectors(n=4, rows=6, width=20, seed=0):
    return th.randn(n, rows, width, generator=th.Generator().manual_seed(seed))


def test_gram_schmidt_by_hand():
    vectors = th.tensor([[[3.0, 4.0, 0.0]], [[5.0, 0.0, 2.0]]])
    # v1 = (.6, .8, 0); u2.v1 = 3; r2 = (5 - 1.8, -2.4, 2) = (3.2, -2.4, 2), |r2|^2 = 10.24 + 5.76 + 4 = 20
    expected = th.stack([th.tensor([0.6, 0.8, 0]), th.tensor([3.2, -2.4, 2.0]) / 20**0.5])
    assert th.allclose(orthonormal(vectors)[:, 0], expected, atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(
    n=st.integers(1, 6),
    width=st.integers(6, 40),
    scale=st.sampled_from([1e-2, 1.0, 1e3]),
    seed=st.integers(0, 999),
)
def test_the_basis_is_orthonormal(n, width, scale, seed):
    vectors = scale * random_vectors(n=n, width=max(width, 3 * n), seed=seed)
    basis = orthonormal(vectors)
    gram = th.einsum("krd,mrd->rkm", basis, basis)
    assert (gram - th.eye(n)).abs().max() < 1e-5


def test_the_basis_spans_what_the_experts_span_and_equals_qr_with_its_gradient():
    vectors = random_vectors().requires_grad_()
    basis = orthonormal(vectors)
    q, r = th.linalg.qr(vectors.double().permute(1, 2, 0))
    exact = (q * r.diagonal(dim1=1, dim2=2).sign().unsqueeze(1)).permute(2, 0, 1)
    assert (basis - exact).abs().max() < 1e-5
    projected = th.einsum("mrd,mre,kre->krd", basis, basis, vectors)
    assert th.allclose(projected, vectors, atol=1e-5)
    weight = random_vectors(seed=1)
    (ours,) = th.autograd.grad((basis * weight).sum(), vectors)
    (theirs,) = th.autograd.grad((exact * weight).sum(), vectors)
    assert th.allclose(ours, theirs, atol=1e-4)


def test_experts_that_differ_by_three_percent_are_still_orthogonal():
    basis = orthonormal(random_vectors(n=1) + 0.03 * random_vectors(seed=1))
    assert (th.einsum("krd,mrd->rkm", basis, basis) - th.eye(4)).abs().max() < 1e-4


def test_the_basis_ignores_the_length_of_an_expert():
    vectors = random_vectors()
    scaled = vectors * th.tensor([10.0, 0.1, 3.0, 700.0]).view(4, 1, 1)
    assert th.allclose(orthonormal(scaled), orthonormal(vectors), atol=1e-5)


def test_the_task_weights_alone_set_the_length_of_the_features():
    body = build("moore", hidden=(16, 16))
    x, task = flat_rows()
    weights = body.mixture(task)
    mixed = (orthonormal(body.experts(th.cat([x, task], 1))) * weights.t().unsqueeze(2)).sum(0)
    assert th.allclose(mixed.norm(dim=1), weights.norm(dim=1), atol=1e-5)


def test_one_expert_is_the_normalised_plain_network():
    body = build("moore", n_experts=1)
    x, task = flat_rows()
    unit = nn.functional.normalize(body.experts(th.cat([x, task], dim=1))[0], dim=1)
    features = th.tanh(unit * body.mixture(task))
    assert th.allclose(body(x, task), body.heads(features, task, False), atol=1e-6)


@pytest.mark.parametrize("kind", ["equal", "collinear", "zero"])
def test_dependent_experts_give_no_nan(kind):
    vectors = random_vectors()
    vectors[2] = {"equal": vectors[0], "collinear": vectors[0] - 3 * vectors[1], "zero": 0 * vectors[0]}[kind]
    vectors.requires_grad_()
    basis = orthonormal(vectors)
    (gradient,) = th.autograd.grad(basis.square().sum() + basis.sum(), vectors)
    assert gradient.isfinite().all()
    assert (basis[2].norm(dim=1) < 0.02).all()  # rounding is not blown up to a direction
    others = basis[[0, 1, 3]]
    assert (th.einsum("krd,mrd->rkm", others, others) - th.eye(3)).abs().max() < 1e-5


def test_orthogonality_is_float32_whatever_the_precision():
    body = build("moore")
    for layer in body.experts:
        layer.precision = "bf16"
    x, task = flat_rows()
    basis = orthonormal(body.experts(th.cat([x, task], dim=1)))
    assert (th.einsum("krd,mrd->rkm", basis, basis) - th.eye(3)).abs().max() < 1e-5
    assert (orthonormal(basis.bfloat16()).dtype, body(x, task).dtype) == (th.float32, th.float32)


# ---------------------------------------------------------------- PaCo


def plain_paco(body, k):
    def forward(x):
        for index, layer in enumerate(body.layers):
            x = nn.functional.linear(x.relu() if index else x, layer.weight[k], layer.bias[k])
        return x

    return forward


def test_the_parameter_sets_start_equal_and_the_mixtures_differ():
    body = build("paco", n_parameter_sets=4)
    for layer in body.layers:
        assert th.equal(layer.weight[0], layer.weight[3]) and th.equal(layer.bias[0], layer.bias[3])
    assert body.task_weights.unique().numel() == N_TASKS * 4


def test_one_parameter_set_of_weight_one_is_the_plain_network():
    body = build("paco", n_parameter_sets=1)
    nn.init.ones_(body.task_weights)
    x, task = flat_rows()
    assert th.allclose(body(x, task), plain_paco(body, 0)(x), atol=1e-6)


@pytest.mark.parametrize("task_major", [False, True])
def test_a_mixture_of_one_set_selects_it(task_major):
    body = build("paco", n_parameter_sets=3)
    with th.no_grad():
        for parameter in body.layers.parameters():
            parameter.normal_()
        body.task_weights.copy_(th.eye(3)[[2, 0, 1]])  # task 0 takes set 2, ...
    x, task = task_major_rows() if task_major else flat_rows()
    out = body(x, task).view(N_TASKS, BATCH, OUT)
    for i, k in enumerate((2, 0, 1)):
        assert th.allclose(out[i], plain_paco(body, k)(x.view(N_TASKS, BATCH, IN)[i]), rtol=1e-4, atol=1e-4)


def test_reinitialised_weights_by_hand():
    body = build("paco", n_tasks=3, n_parameter_sets=2)
    with th.no_grad():
        body.task_weights.copy_(th.tensor([[1.0, 0.0], [9.0, 9.0], [0.0, 1.0]]))
    body.reinitialize_(th.tensor([True, False, True]), th.tensor([[0.5] * 3, [0.3, 0.8, 0.1], [0.5] * 3]))
    # shares .3 and .1 of .4: 3/4 of (1, 0) and 1/4 of (0, 1)
    assert body.task_weights[1].tolist() == pytest.approx([0.75, 0.25])
    assert body.task_weights[[0, 2]].tolist() == [[1.0, 0.0], [0.0, 1.0]]


@settings(max_examples=25, deadline=None)
@given(mask=st.lists(st.booleans(), min_size=4, max_size=4), seed=st.integers(0, 999))
def test_reinitialised_weights_lie_in_the_hull_of_the_healthy(mask, seed):
    body = build("paco", n_tasks=4, n_parameter_sets=3)
    old, healthy = body.task_weights.detach().clone(), th.tensor(mask)
    address = body.task_weights.data_ptr()
    body.reinitialize_(healthy, th.rand(4, 4, generator=th.Generator().manual_seed(seed)))
    new = body.task_weights.detach()
    assert body.task_weights.data_ptr() == address
    if not any(mask):
        assert th.equal(new, old)
        return
    assert th.equal(new[healthy], old[healthy])
    direction = th.randn(3, 20, generator=th.Generator().manual_seed(seed))
    reach = (old[healthy] @ direction).amax(dim=0)  # the hull reaches this far in each direction
    assert ((new @ direction) <= reach + 1e-5).all()


# ---------------------------------------------------------------- options


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": "more"}, r"name='more' is unknown.*Did you mean 'moore'\?"),
        ({}, "name=None is unknown"),
        ({"name": "moore", "n_expert": 4}, r"'moore' has no option 'n_expert'.*Did you mean 'n_experts'\?"),
        ({"name": "moore", "n_experts": 0}, "n_experts=0 must be an integer of at least 1"),
        ({"name": "paco", "n_parameter_sets": 0}, "n_parameter_sets=0 must be"),
        ({"name": "paco", "n_parameter_sets": 2.5}, "n_parameter_sets=2.5 must be"),
        ({"name": "soft_modules", "n_layers": True}, "n_layers=True must be"),
        ({"name": "multi_head", "task_in_input": 1}, "task_in_input=1 must be True or False"),
        ({"name": "moore", "n_experts": 17}, "n_experts=17 exceeds the last width"),
    ],
)
def test_options_that_cannot_work_are_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        build_body(options, IN, OUT, N_TASKS, (16, 16), nn.ReLU)


@pytest.mark.parametrize("name", ["soft_modules", "moore"])
def test_too_few_hidden_layers_are_refused(name):
    with pytest.raises(ConfigError, match="needs at least 1 hidden layers"):
        build(name, hidden=())


def test_a_body_can_be_copied_and_loaded():
    for name in BODIES:
        body, other = build(name), copy.deepcopy(build(name))
        with th.no_grad():
            for parameter in other.parameters():
                parameter.normal_()
        other.load_state_dict(body.state_dict())
        assert th.equal(body(*flat_rows()), other(*flat_rows()))
