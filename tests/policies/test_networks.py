"""Networks: the paper's layer tables, initialisation, and the same actors alone and stacked."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs import ExplorationType, set_exploration_type

from marl_explore.config.arena import ArenaConfig
from marl_explore.policies.actors import MultiAgentActors, TeamActor, probabilistic_actor
from marl_explore.policies.networks import CNN, MLP, NETWORKS, DeepSet, network_from_json
from marl_explore.policies.networks.ablation import Ablated
from marl_explore.policies.stacking import stack_modules
from tests.helpers.configs import NETWORKS as SMALL

PAPER = ArenaConfig()


def layers(network):
    """(kind, inputs, outputs) of every layer with parameters or an activation."""
    table = []
    for layer in network.modules():
        if isinstance(layer, nn.Linear):
            table.append(("linear", layer.in_features, layer.out_features))
        elif isinstance(layer, nn.Conv2d):
            assert layer.kernel_size == (3, 3)
            assert layer.stride == (1, 1)
            assert layer.padding == (1, 1)
            table.append(("conv", layer.in_channels, layer.out_channels))
        elif isinstance(layer, nn.LayerNorm):
            table.append(("norm", *layer.normalized_shape))
        elif isinstance(layer, nn.ReLU):
            table.append(("relu",))
    return table


def observation(*batch, robots=None, config=PAPER):
    torch.manual_seed(0)
    axis = () if robots is None else (robots,)
    side = config.fov_size
    return (
        torch.rand(*batch, *axis, side, side),
        torch.rand(*batch, *axis, 8, 3),
        torch.rand(*batch, *axis, config.num_agents),
    )


def test_mlp_actor_is_the_papers_table():
    assert layers(MLP().make_actor(PAPER)) == [
        ("linear", 37, 2400),
        ("relu",),
        ("norm", 2400),
        ("linear", 2400, 300),
        ("relu",),
        ("linear", 300, 10),
    ]


def test_mlp_critic_reads_148_numbers():
    assert [
        row for row in layers(MLP().make_critic(PAPER, "observation")) if row[0] == "linear"
    ] == [
        ("linear", 148, 2400),
        ("linear", 2400, 300),
        ("linear", 300, 1),
    ]


def test_a_flag_normalises_the_last_hidden_layer_too():
    assert ("norm", 300) in layers(MLP(norm_last=True).make_actor(PAPER))


def test_cnn_actor_is_the_papers_figure():
    assert layers(CNN().make_actor(PAPER)) == [
        ("conv", 1, 8),
        ("relu",),
        ("conv", 8, 16),
        ("relu",),
        ("linear", 144, 64),
        ("relu",),
        ("linear", 24, 64),
        ("relu",),
        ("linear", 4, 16),
        ("relu",),
        ("linear", 144, 300),
        ("relu",),
        ("linear", 300, 10),
    ]


def test_cnn_critic_has_an_encoder_per_robot():
    table = layers(CNN().make_critic(PAPER, "observation"))
    assert table.count(("conv", 1, 8)) == 4
    assert table[-3:] == [("linear", 576, 300), ("relu",), ("linear", 300, 1)]


@pytest.mark.parametrize("network", [MLP().make_actor(PAPER), CNN().make_actor(PAPER)])
def test_initial_policies_are_nearly_uniform_with_orthogonal_weights(network):
    logits = network(*observation(50))
    assert logits.shape == (50, 10)
    assert logits.softmax(-1).sub(0.1).abs().max() < 0.01
    last = [m for m in network.modules() if isinstance(m, nn.Linear)][-1]
    torch.testing.assert_close(last.weight @ last.weight.T, 1e-4 * torch.eye(10))
    assert (last.bias == 0).all()


def test_hidden_layers_start_orthogonal_with_gain_sqrt_2():
    weight = MLP().make_actor(PAPER).layers[3].weight  # 300 x 2400
    torch.testing.assert_close(weight @ weight.T, 2 * torch.eye(300), atol=1e-4, rtol=0)


@pytest.mark.parametrize("network", [MLP(), CNN()])
def test_stacked_actors_are_the_single_ones(network):
    config = ArenaConfig(num_agents=3, sensing_range=1.8)
    actors = [network.make_actor(config) for _ in range(3)]
    inputs = observation(6, 2, robots=3, config=config)
    stacked = MultiAgentActors(actors)(*inputs)
    for i, single in enumerate(actors):
        alone = single(inputs[0][:, :, i], inputs[1][:, :, i], inputs[2][:, :, i])
        torch.testing.assert_close(stacked[:, :, i], alone)


@pytest.mark.parametrize("network", ["mlp", "cnn"])
@pytest.mark.parametrize("index", [0, 1, 2])
def test_an_actor_without_an_input_reads_0_there(network, index):
    inputs = observation(5, config=PAPER)
    blind = Ablated(SMALL[network].make_actor(PAPER), [("fov", "fpr", "net")[index]])
    other = [x + (i == index) for i, x in enumerate(inputs)]
    assert blind(*other).equal(blind(*inputs))
    zero = [x * (i != index) for i, x in enumerate(inputs)]
    assert blind(*inputs).equal(blind.actor(*zero))
    assert not blind(*inputs).equal(blind.actor(*inputs))


def test_an_actor_without_communication_never_communicates():
    inputs = observation(5, config=PAPER)
    actor = Ablated(SMALL["mlp"].make_actor(PAPER), ["communication"])
    logits = actor(*inputs)
    assert logits[..., :9].equal(actor.actor(*inputs)[..., :9])
    assert (logits.softmax(-1)[..., 9] == 0).all()
    logits.sum().backward()
    assert all(p.grad.isfinite().all() for p in actor.parameters())


@pytest.mark.parametrize(
    ("network", "ablate"),
    [
        (MLP(), ()),
        (MLP(norm_last=True), ()),
        (CNN(), ()),
        (MLP(hidden=(16,)), ("fpr", "communication")),
    ],
)
def test_actors_run_together_are_the_single_ones_in_their_latest_state(network, ablate):
    config = ArenaConfig(num_agents=3, sensing_range=1.8)
    stacked = MultiAgentActors([Ablated(network.make_actor(config), ablate) for _ in range(3)])
    inputs = observation(6, 2, robots=3, config=config)
    names = set(stacked.state_dict())
    for _ in range(2):
        with torch.no_grad():
            for parameter in stacked.parameters():
                parameter.add_(0.1 * torch.randn_like(parameter))
        expected = stacked(*inputs)
        with stacked.together():
            torch.testing.assert_close(stacked(*inputs), expected, rtol=1e-4, atol=1e-4)
            one_batch = stacked(*(x[:, 0] for x in inputs))
        torch.testing.assert_close(one_batch, expected[:, 0], rtol=1e-4, atol=1e-4)
        assert stacked(*inputs).equal(expected)
        assert set(stacked.state_dict()) == names


class Attention(nn.Module):
    """An actor with layers that cannot be stacked: FPR's directions attend to one another."""

    inputs = ("fov", "fpr", "net")

    def __init__(self):
        super().__init__()
        self.heads = nn.MultiheadAttention(3, 1, batch_first=True)
        self.logits = nn.Linear(3, 10)

    def forward(self, fov, fpr, net):
        table = fpr.flatten(0, -3)
        seen, _ = self.heads(table, table, table, need_weights=False)
        return self.logits(seen.mean(-2)).unflatten(0, fpr.shape[:-2])


def test_actors_with_unknown_layers_run_one_by_one():
    actors = MultiAgentActors([Attention() for _ in range(3)])
    inputs = observation(6, 2, robots=3, config=ArenaConfig(num_agents=3))
    with torch.no_grad():
        expected = actors(*inputs)
        with actors.together():
            assert actors(*inputs).equal(expected)


@pytest.mark.parametrize("network", [MLP(hidden=(5,)), CNN(channels=(2, 3)), DeepSet(code_width=7)])
def test_networks_are_told_in_json(network):
    told = json.loads(json.dumps(network.to_json()))
    assert network_from_json(told["network"], told["options"]) == network
    assert NETWORKS[told["network"]] is type(network)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("MLP", {}, "network='MLP' .*cnn.*mlp"),
        ("mlp", {"hidden": []}, "hidden"),
        ("mlp", {"hidden": [0]}, "hidden=0"),
        ("cnn", {"norm_last": True}, "options of cnn has an unknown field 'norm_last'"),
        ("deepset", {"communicate_every": 4}, r"communicate_every=4 .*\(1, 2, 3, 6\)"),
        ("deepset", {"communicate_after": -1}, "communicate_after=-1"),
    ],
)
def test_networks_that_cannot_be_are_refused(name, options, message):
    with pytest.raises(ValueError, match=message):
        network_from_json(name, options)


def test_equal_layouts_can_swap_weights():
    assert DeepSet(communicate_every=3).layout == DeepSet(communicate_after=2).layout
    assert DeepSet(code_width=7).layout != replace(DeepSet(), code_width=8).layout


def test_only_known_layers_run_side_by_side():
    with pytest.raises(TypeError, match="Bilinear cannot be stacked"):
        stack_modules([nn.Bilinear(2, 2, 2), nn.Bilinear(2, 2, 2)])


@pytest.mark.parametrize("network", ["mlp", "cnn"])
@pytest.mark.parametrize("reads", ["observation", "state"])
def test_critics_write_one_value_per_arena(network, reads):
    config = ArenaConfig(num_agents=2)
    fov, fpr, net = observation(5, robots=2, config=config)
    td = TensorDict(
        {
            "obstacles": torch.zeros(5, 12, 12, dtype=torch.bool),
            "agents": {
                "map": torch.full((5, 2, 12, 12), -1, dtype=torch.int8),
                "position": torch.zeros(5, 2, 2, dtype=torch.int64),
                "observation": {"fov": fov, "fpr": fpr, "net": net},
            },
        },
        batch_size=[5],
    )
    critic = SMALL[network].make_critic(config, reads)
    assert critic(td)["state_value"].shape == (5, 1)


def test_actors_obey_the_mask_and_take_the_likeliest_action_when_asked():
    config = ArenaConfig(num_agents=2)
    fov, fpr, net = observation(400, robots=2, config=config)
    mask = torch.rand(400, 2, 10) < 0.3
    mask[..., 8] = True
    td = TensorDict(
        {"agents": {"observation": {"fov": fov, "fpr": fpr, "net": net}, "action_mask": mask}},
        [400],
    )
    policy = probabilistic_actor(
        MultiAgentActors([MLP(hidden=(8, 8)).make_actor(config) for _ in range(2)])
    )
    sampled = policy(td.clone())
    action = sampled["agents", "action"]
    assert mask.gather(-1, action.unsqueeze(-1)).all()
    logits = sampled["agents", "logits"].masked_fill(~mask, -torch.inf)
    expected = logits.log_softmax(-1).gather(-1, action.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(sampled["agents", "action_log_prob"], expected)
    team = TeamActor(policy.module[0].module.actors)
    for likeliest in (ExplorationType.DETERMINISTIC, ExplorationType.MODE):
        with set_exploration_type(likeliest):
            assert torch.equal(policy(td.clone())["agents", "action"], logits.argmax(-1))
            assert torch.equal(team(td.clone())["agents", "action"], logits.argmax(-1))


def test_a_team_actor_samples_as_the_chain_of_modules_does():
    config = ArenaConfig(num_agents=2)
    fov, fpr, net = observation(300, robots=2, config=config)
    entries = {"fov": fov, "fpr": fpr, "net": net}
    mask = torch.rand(300, 2, 10) < 0.4
    mask[..., 8] = True
    td = TensorDict({"agents": {"observation": entries, "action_mask": mask}}, [300])
    stacked = MultiAgentActors([MLP(hidden=(8, 8)).make_actor(config) for _ in range(2)])
    torch.manual_seed(3)
    chain = probabilistic_actor(stacked)(td.clone())["agents"]
    torch.manual_seed(3)
    team = TeamActor(stacked.actors)(td.clone())["agents"]
    assert torch.equal(team["action"], chain["action"])
    torch.testing.assert_close(team["action_log_prob"], chain["action_log_prob"])
