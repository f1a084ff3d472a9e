"""LSTM and GRU actors on the exploration environment: collected, updated, and unrolled by hand."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from tensordict.nn import InteractionType, TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torch.testing import assert_close
from torchrl.collectors import Collector
from torchrl.data import Composite, Unbounded
from torchrl.envs import InitTracker, TensorDictPrimer
from torchrl.modules import GRUModule, LSTMModule, MaskedCategorical, ProbabilisticActor

from marl_explore import ArenaConfig, make_env
from marl_explore.happo.loss import HAPPOLoss
from marl_explore.happo.update import sequential_update
from tests.helpers.happo import all_equal, clipped_objective, descend, parameters_of, perturb

ARENAS, STEPS, ROBOTS, HIDDEN = 6, 7, 2, 8
EPISODE = 5  # steps: episodes end within rows, and rows begin within episodes
GROUP = "agents"
ENTRIES = ("fov", "fpr", "net")
FEATURES = 9 + 24 + ROBOTS
STATES = {"lstm": ("h", "c"), "gru": ("h",)}
CELLS = {"lstm": nn.LSTMCell, "gru": nn.GRUCell}

KINDS = pytest.mark.parametrize("kind", ["lstm", "gru"])


def concat(fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
    return torch.cat([fov.flatten(-2), fpr.flatten(-2), net], -1)


def memory(kind: str) -> LSTMModule | GRUModule:
    states = STATES[kind]
    return {"lstm": LSTMModule, "gru": GRUModule}[kind](
        FEATURES,
        HIDDEN,
        in_keys=[(GROUP, "features"), *((GROUP, state) for state in states)],
        out_keys=[(GROUP, "memory"), *(("next", GROUP, state) for state in states)],
    )


def recurrent_actor(kind: str) -> ProbabilisticActor:
    inputs = [(GROUP, "observation", entry) for entry in ENTRIES]
    return ProbabilisticActor(
        TensorDictSequential(
            TensorDictModule(concat, inputs, [(GROUP, "features")]),
            memory(kind),
            TensorDictModule(nn.Linear(HIDDEN, 10), [(GROUP, "memory")], [(GROUP, "logits")]),
        ),
        in_keys={"logits": (GROUP, "logits"), "mask": (GROUP, "action_mask")},
        out_keys=[(GROUP, "action")],
        distribution_class=MaskedCategorical,
        return_log_prob=True,
        log_prob_key=(GROUP, "action_log_prob"),
        default_interaction_type=InteractionType.RANDOM,
    )


def make_critic() -> TensorDictModule:
    value = nn.Linear(ROBOTS * FEATURES, 1)
    module = nn.Module()
    module.value = value
    module.forward = lambda *entries: value(concat(*entries).flatten(-2))
    return TensorDictModule(
        module, [(GROUP, "observation", entry) for entry in ENTRIES], ["state_value"]
    )


def team(kind: str) -> tuple[HAPPOLoss, Collector]:
    """Two robots with an actor each, and a collector that carries their states."""
    env = make_env(ArenaConfig(height=6, width=6, num_agents=ROBOTS), ARENAS, max_steps=EPISODE)
    actors = {name: recurrent_actor(kind) for name in env.group_map[GROUP]}
    loss = HAPPOLoss(actors, make_critic(), group_map=env.group_map, entropy_coeff=0.0)
    env.append_transform(InitTracker())
    state = Unbounded((ROBOTS, 1, HIDDEN))  # robots, layers, numbers
    states = Composite({name: state.clone() for name in STATES[kind]}, shape=(ROBOTS,))
    env.append_transform(TensorDictPrimer({GROUP: states}, expand_specs=True))
    collector = Collector(
        env,
        loss.make_policy(),
        frames_per_batch=ARENAS * STEPS,
        total_frames=-1,
        auto_register_policy_transforms=False,
    )
    return loss, collector


def batches(collector: Collector, number: int) -> list:
    with torch.no_grad():
        return [batch.clone() for batch, _ in zip(collector, range(number), strict=False)]


def unrolled_log_prob(actor: nn.Module, kind: str, batch, robot: int) -> Tensor:
    """Log-probabilities [B, T] of a robot's actions, by a loop over steps with PyTorch's cells."""
    _, module, head = actor[0].module
    own = getattr(module, kind)
    cell = CELLS[kind](FEATURES, HIDDEN)
    for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
        del cell._parameters[name]
        setattr(cell, name, getattr(own, f"{name}_l0"))
    features = concat(*(batch[GROUP, "observation", entry] for entry in ENTRIES))[:, :, robot]
    # at the start of a row, the state with which the collector entered it
    state = [batch[GROUP, name][:, 0, robot, 0] for name in STATES[kind]]
    columns = []
    for t in range(batch.shape[1]):
        state = [torch.where(batch["is_init"][:, t], 0.0, s) for s in state]
        out = cell(features[:, t], tuple(state) if kind == "lstm" else state[0])
        state = list(out) if kind == "lstm" else [out]
        mask = batch[GROUP, "action_mask"][:, t, robot]
        logits = head.module(state[0]).masked_fill(~mask, -torch.inf)
        action = batch[GROUP, "action"][:, t, robot].unsqueeze(-1)
        columns.append(logits.log_softmax(-1).gather(-1, action).squeeze(-1))
    return torch.stack(columns, 1)


def actors_of(loss: HAPPOLoss) -> list[nn.Module]:
    return [loss.actor_losses[name].actor_network for name in loss.names]


@KINDS
def test_what_is_collected_is_what_the_loop_over_steps_gives(kind):
    loss, collector = team(kind)
    first, second = batches(collector, 2)
    assert first["is_init"][:, 0].all()
    assert not second["is_init"][:, 0].any()  # its rows begin within an episode
    assert second["is_init"].any()
    assert second[GROUP, "h"][:, 0].any()
    for batch in (first, second):
        assert not batch[GROUP, "h"][batch["is_init"].squeeze(-1)].any()
        for robot, actor in enumerate(actors_of(loss)):
            expected = unrolled_log_prob(actor, kind, batch, robot)
            assert_close(batch[GROUP, "action_log_prob"][:, :, robot], expected)


@KINDS
def test_the_factor_is_that_of_a_loop_over_steps(kind):
    loss, collector = team(kind)
    for batch in batches(collector, 2):
        expected = torch.ones(ARENAS, STEPS)
        for robot, actor in enumerate(actors_of(loss)):
            old = copy.deepcopy(actor)
            perturb(actor, size=0.2)
            loss.update_factor(batch, loss.names[robot])
            new, before = (unrolled_log_prob(a, kind, batch, robot) for a in (actor, old))
            expected = expected * (new - before).exp().detach()
            assert_close(batch["factor"].squeeze(-1), expected, rtol=1e-4, atol=1e-5)
            actor.load_state_dict(old.state_dict())  # the next batch is of the old policy
        assert (expected - 1).abs().max() > 0.1


@KINDS
def test_the_objective_and_its_gradient_through_time(kind):
    loss, collector = team(kind)
    _, batch = batches(collector, 2)
    batch["advantage"] = torch.randn(ARENAS, STEPS, 1)
    batch["factor"] = torch.rand(ARENAS, STEPS, 1)
    actor = actors_of(loss)[1]
    perturb(actor, size=0.1)
    parameters = list(actor.parameters())
    losses = loss.actor_loss(batch, loss.names[1])
    ratio = (
        unrolled_log_prob(actor, kind, batch, 1) - batch[GROUP, "action_log_prob"][:, :, 1]
    ).exp()
    columns = (batch[key].squeeze(-1) for key in ("factor", "advantage"))
    expected = clipped_objective(ratio, *columns)
    assert_close(losses["loss_objective"], expected, rtol=1e-4, atol=1e-5)
    pairs = zip(
        torch.autograd.grad(losses["loss_objective"], parameters),
        torch.autograd.grad(expected, parameters),
        strict=True,
    )
    for got, wanted in pairs:
        assert wanted.any()
        assert_close(got, wanted, rtol=1e-3, atol=1e-5)


@KINDS
def test_minibatches_of_whole_rows(kind):
    loss, collector = team(kind)
    _, batch = batches(collector, 2)
    batch["advantage"] = torch.randn(ARENAS, STEPS, 1)
    name = loss.names[0]
    perturb(actors_of(loss)[0], size=0.1)
    whole = loss.actor_loss(batch, name)["loss_objective"]
    parts = [loss.actor_loss(batch[rows], name) for rows in torch.arange(ARENAS).split(2)]
    assert_close(torch.stack([part["loss_objective"] for part in parts]).mean(), whole)
    flat = batch.reshape(-1)
    for call in (loss.actor_loss, loss.update_factor):
        with pytest.raises(ValueError, match=r"'robot_0' is recurrent.*\[42\].*do not flatten"):
            call(flat, name)


@KINDS
def test_a_recurrent_actor_acts_for_one_agent(kind):
    """Otherwise the agents' axis would be taken for time."""
    _, collector = team(kind)
    (batch,) = batches(collector, 1)
    batch["advantage"] = torch.randn(ARENAS, STEPS, 1)
    loss = HAPPOLoss({"team": recurrent_actor(kind)})
    for call in (loss.actor_loss, loss.update_factor):
        with pytest.raises(ValueError, match=r"'team'.*'h'\) has shape \[6, 7, 2, 1, 8\].*a view"):
            call(batch, "team")


@KINDS
def test_values_of_a_recurrent_critic_cannot_be_reused(kind):
    value = TensorDictModule(nn.Linear(HIDDEN, 1), [(GROUP, "memory")], ["state_value"])
    critic = TensorDictSequential(memory(kind), value)
    loss = HAPPOLoss({"team": recurrent_actor(kind)}, critic)
    loss.make_value_estimator(gamma=0.9)
    with pytest.raises(
        ValueError, match="reuse_values=True is not allowed: the critic is recurrent"
    ):
        loss.make_value_estimator(gamma=0.9, reuse_values=True)


@KINDS
def test_it_trains(kind):
    loss, collector = team(kind)
    networks = {**dict(zip(loss.names, actors_of(loss), strict=True)), "critic": loss.critic}
    optimizers = {name: torch.optim.Adam(net.parameters(), 1e-2) for name, net in networks.items()}
    loss.make_value_estimator(gamma=0.9)

    def passes(batch, keys):
        for _ in range(2):
            for rows in torch.randperm(ARENAS).split(3):
                yield batch.select(*keys, strict=False)[rows]

    before = {name: parameters_of(net) for name, net in networks.items()}
    for batch in batches(collector, 1):
        loss.estimate_advantage(batch)
        metrics = sequential_update(
            loss, batch, passes, lambda name, losses: descend(optimizers[name], losses)
        )
        for part in passes(batch, loss.critic_keys):
            descend(optimizers["critic"], loss.critic_loss(part))
        assert all(map(math.isfinite, metrics.values()))
        assert metrics["factor_min"] < 1 < metrics["factor_max"]
        assert batch["factor"].shape == (ARENAS, STEPS, 1)
    for name, net in networks.items():
        pairs = zip(before[name], net.parameters(), strict=True)
        assert not any(all_equal([then], [now]) for then, now in pairs), name
