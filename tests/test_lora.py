"""Adapters: unchanged outputs at first, a frozen base, low rank, and the same function however it is computed."""

import pytest
import torch as th
from torch import nn

from sb3_ars.errors import ConfigError
from sb3_ars.nets.lora import LoRAConfig, LoRALinear, adapters, add_adapters, merge_adapters, renew_adapters
from sb3_ars.nets.mlp import MLP, fused_layers_are_available, set_arithmetic, with_layer_norm

N_TASKS, BATCH, IN = 3, 4, 6
every_config = pytest.mark.parametrize(
    "config",
    [
        LoRAConfig(rank=2, per_task=per_task, scale=scale, layers=layers)
        for per_task in (True, False)
        for scale, layers in (("released", "all"), ("paper", "hidden"))
    ],
    ids=lambda config: f"{'per_task' if config.per_task else 'shared'}-{config.scale}-{config.layers}",
)


class Actor(nn.Module):
    """The shape of SB3's: a trunk and two heads."""

    def __init__(self, in_features=IN, width=16, depth=2, action_dim=2):
        super().__init__()
        layers = []
        for size in [in_features] + [width] * (depth - 1):
            layers += [nn.Linear(size, width), nn.ReLU()]
        self.latent_pi = MLP(*layers)
        self.mu, self.log_std = nn.Linear(width, action_dim), nn.Linear(width, action_dim)

    def forward(self, x):
        latent = self.latent_pi(x)
        return th.cat([self.mu(latent), self.log_std(latent)], dim=1)


def critic():
    plain = MLP(nn.Linear(IN, 16), nn.Tanh(), nn.Linear(16, 16), nn.Tanh(), nn.Linear(16, 1))
    return with_layer_norm(plain)


def rows(seed=0):
    return th.randn(N_TASKS * BATCH, IN, generator=th.Generator().manual_seed(seed))


def train(network, steps=5):
    optimizer = th.optim.Adam(adapters(network), lr=0.01)
    for step in range(steps):
        optimizer.zero_grad()
        (network(rows(step)) - 3).square().mean().backward()
        optimizer.step()


def adapted(config, make=Actor, steps=5):
    th.manual_seed(0)
    network = make()
    tasks = add_adapters(network, config, N_TASKS)
    train(network, steps)
    return network, tasks


@every_config
@pytest.mark.parametrize("make", [Actor, critic])
def test_outputs_are_the_same_to_the_bit_when_adapters_are_added(make, config):
    network = make()
    before = network(rows())
    tasks = add_adapters(network, config, N_TASKS)
    assert th.equal(network(rows()), before)
    with tasks.rows(th.eye(N_TASKS).repeat(BATCH, 1)):
        assert th.equal(network(rows()), before)


@every_config
def test_at_the_first_step_b_learns_and_a_does_not(config):
    network = Actor()
    add_adapters(network, config, N_TASKS)
    network(rows()).square().mean().backward()
    for layer in network.modules():
        if isinstance(layer, LoRALinear):
            assert (layer.lora_b.grad.norm(dim=(1, 2)) > 0).all()
            assert th.equal(layer.lora_a.grad, th.zeros_like(layer.lora_a))


@every_config
@pytest.mark.parametrize("make", [Actor, critic])
def test_training_changes_the_outputs_and_leaves_the_base_bitwise(make, config):
    th.manual_seed(0)
    network = make()
    base = {name: value.clone() for name, value in network.state_dict().items()}
    norms = {n for n, m in network.named_modules() if isinstance(m, nn.LayerNorm)}
    before = network(rows()).detach()
    add_adapters(network, config, N_TASKS)
    train(network)
    assert (network(rows()) - before).abs().max() > 1e-3
    after = network.state_dict()
    assert set(base) <= set(after)
    for name, value in base.items():
        is_norm = name.rpartition(".")[0] in norms
        assert th.equal(after[name], value) is not is_norm, name


@every_config
def test_the_change_of_each_weight_has_low_rank(config):
    network, _ = adapted(config)
    for layer in network.modules():
        if isinstance(layer, LoRALinear):
            delta = layer.delta()
            assert delta.shape[0] == (N_TASKS if config.per_task else 1)
            assert (th.linalg.matrix_rank(delta) <= config.rank).all() and delta.abs().max() > 0


@every_config
def test_the_adapted_network_is_the_network_with_the_changed_weights(config):
    network, _ = adapted(config)
    x = rows()
    out = network(x).view(N_TASKS, BATCH, -1)
    for task in range(N_TASKS):
        plain = Actor()
        plain.load_state_dict({k: v for k, v in network.state_dict().items() if "lora" not in k})
        with th.no_grad():
            for name, layer in network.named_modules():
                if isinstance(layer, LoRALinear):
                    plain.get_submodule(name).weight.add_(layer.delta()[task if config.per_task else 0])
        assert th.allclose(plain(x).view(N_TASKS, BATCH, -1)[task], out[task], atol=1e-5)


@every_config
def test_rows_in_any_order_are_the_same_function(config):
    network, tasks = adapted(config)
    order = th.randperm(N_TASKS * BATCH, generator=th.Generator().manual_seed(1))
    task_major = network(rows())
    with tasks.rows(th.eye(N_TASKS).repeat_interleave(BATCH, dim=0)[order]):
        assert th.allclose(network(rows()[order]), task_major[order], atol=1e-5)
    assert th.equal(network(rows()), task_major)  # the context is over


def test_a_tasks_loss_reaches_its_own_adapters_only():
    network, _ = adapted(LoRAConfig(rank=2))
    loss = network(rows()).view(N_TASKS, BATCH, -1)[1].square().sum()
    for gradient in th.autograd.grad(loss, adapters(network)):
        assert th.equal(gradient[[0, 2]], th.zeros_like(gradient[[0, 2]])) and gradient[1].abs().max() > 0


@pytest.mark.parametrize("make", [Actor, critic])
@pytest.mark.parametrize("layers", ["all", "hidden"])
def test_merged_weights_are_the_adapted_network(make, layers):
    network, _ = adapted(LoRAConfig(rank=2, per_task=False, layers=layers), make)
    out, keys = network(rows()), [key for key in network.state_dict() if "lora" not in key]
    merge_adapters(network)
    assert list(network.state_dict()) == keys
    assert not any(isinstance(module, LoRALinear) for module in network.modules())
    assert th.allclose(network(rows()), out, atol=1e-5)
    assert all(parameter.requires_grad for parameter in network.parameters())


def test_renewed_adapters_are_the_base_again():
    base = Actor()
    network = Actor()
    network.load_state_dict(base.state_dict())
    add_adapters(network, LoRAConfig(rank=2), N_TASKS)
    train(network)
    old = network.mu.lora_a.detach().clone()
    address = network.mu.lora_a.data_ptr()
    renew_adapters(network)
    assert th.equal(network(rows()), base(rows()))
    assert network.mu.lora_a.data_ptr() == address and not th.equal(network.mu.lora_a, old)


def test_the_released_scale_divides_by_the_rank():
    layer = LoRALinear(nn.Linear(2, 1), LoRAConfig(rank=2), 1, None)
    with th.no_grad():
        layer.weight.copy_(th.tensor([[1.0, 1.0]]))
        layer.bias.fill_(0.5)
        layer.lora_a.copy_(th.tensor([[[1.0, 0.0], [0.0, 2.0]]]))
        layer.lora_b.copy_(th.tensor([[[3.0, 4.0]]]))
    # B A = (3, 8); on (1, 1): 2.5 + 11 / 2
    assert layer(th.ones(1, 2)).item() == pytest.approx(8.0)
    assert LoRAConfig(rank=4, scale="paper").factor == 1


@pytest.mark.parametrize(
    ("config", "in_features", "n_tasks", "count"),
    [
        (LoRAConfig(rank=8, per_task=False, layers="hidden"), 49, 10, 22_792),
        (LoRAConfig(rank=16, per_task=False, layers="hidden"), 89, 50, 46_224),
        (LoRAConfig(rank=8), 49, 10, 292_560),
        (LoRAConfig(rank=16), 89, 50, 2_957_600),
    ],
)
def test_parameter_counts_are_the_derived_ones(config, in_features, n_tasks, count):
    actor = Actor(in_features, width=400, depth=4, action_dim=4)
    base = sum(parameter.numel() for parameter in actor.parameters())
    assert base == {10: 504_408, 50: 520_408}[n_tasks]
    add_adapters(actor, config, n_tasks)
    assert sum(parameter.numel() for parameter in adapters(actor)) == count


@pytest.mark.skipif(not fused_layers_are_available(), reason="this torch has no oneDNN layers")
@pytest.mark.parametrize("make", [Actor, critic])
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_adapters_work_in_fused_and_bfloat16_networks(make, precision):
    network, _ = adapted(LoRAConfig(rank=2), make)
    plain, out = make(), network(rows())
    plain.load_state_dict({k: v for k, v in network.state_dict().items() if "lora" not in k})
    set_arithmetic(plain, True, precision)
    add_adapters(plain, LoRAConfig(rank=2), N_TASKS)
    plain.load_state_dict(network.state_dict())
    inside = [net for net in plain.modules() if isinstance(net, MLP)]
    assert inside and all(layer.fused for net in inside for layer in net if isinstance(layer, LoRALinear))
    tolerance = 1e-5 if precision == "fp32" else 0.05
    assert th.allclose(plain(rows()), out, atol=tolerance)
    ours = th.autograd.grad(plain(rows()).square().mean(), adapters(plain))
    theirs = th.autograd.grad(out.square().mean(), adapters(network))
    for a, b in zip(ours, theirs, strict=True):
        assert th.allclose(a, b, atol=tolerance, rtol=0.05)


def test_one_graph_holds_an_adapted_network():
    network, _ = adapted(LoRAConfig(rank=2))
    th._dynamo.reset()
    compiled = th.compile(network, backend="eager", fullgraph=True)
    assert th.equal(compiled(rows()), network(rows()))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rank": 0}, "rank=0 must be an integer of at least 1"),
        ({"per_task": "yes"}, "per_task='yes' must be True or False"),
        ({"scale": "papers"}, r"scale='papers' is unknown.*Did you mean 'paper'\?"),
        ({"layers": "heads"}, "layers='heads' is unknown"),
    ],
)
def test_options_that_cannot_work_are_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        LoRAConfig(**options)


def test_networks_that_cannot_be_adapted_are_refused():
    with pytest.raises(ConfigError, match="rank=7 exceeds the width of a layer from 6 to 16"):
        add_adapters(Actor(), LoRAConfig(rank=7), N_TASKS)
    with pytest.raises(ConfigError, match="no plain linear layer"):
        add_adapters(nn.Sequential(nn.Tanh()), LoRAConfig(), N_TASKS)
    network, _ = adapted(LoRAConfig(rank=2))
    with pytest.raises(ConfigError, match="has adapters already"):
        add_adapters(network, LoRAConfig(rank=2), N_TASKS)
    with pytest.raises(ConfigError, match="per_task=False to merge"):
        merge_adapters(network)
