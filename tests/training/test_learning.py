"""HAPPO learns tiny tasks with known answers, and its factor M earns its keep."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import InteractionType, TensorDictModule
from torch import Tensor, nn
from torchrl.envs import ActionMask, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import MaskedCategorical, PopArtValueNorm, ProbabilisticActor

from marl_explore.happo.loss import HAPPOLoss
from tests.helpers.probes import (
    ACTIONS,
    FORBIDDEN,
    ROBOTS,
    ConstantReward,
    Coordination,
    CutOff,
    DelayedReward,
    ObservedReward,
    Probe,
)

NAMES = [f"robot_{i}" for i in range(ROBOTS)]
VIEWS = {name: ("agents", i) for i, name in enumerate(NAMES)}
PROBES = [ConstantReward, DelayedReward, ObservedReward, CutOff, Coordination]
GAMMA = 0.6

value_norms = pytest.mark.parametrize("value_norm", [None, PopArtValueNorm], ids=["plain", "norm"])


# ----------------------------------------------------------------------- the learner


class SideBySide(nn.Module):
    """Logits [B, 2, 3] of both robots from observations [B, 2, S]."""

    def __init__(self, networks: list[nn.Module]) -> None:
        super().__init__()
        self.networks = nn.ModuleList(networks)

    def forward(self, observation: Tensor) -> Tensor:
        robots = zip(self.networks, observation.unbind(-2), strict=True)
        return torch.stack([network(own) for network, own in robots], -2)


def masked_policy(network: nn.Module) -> ProbabilisticActor:
    return ProbabilisticActor(
        TensorDictModule(network, [("agents", "observation")], [("agents", "logits")]),
        in_keys={"logits": ("agents", "logits"), "mask": ("agents", "action_mask")},
        out_keys=[("agents", "action")],
        distribution_class=MaskedCategorical,
        return_log_prob=True,
        log_prob_key=("agents", "action_log_prob"),
        default_interaction_type=InteractionType.RANDOM,
    )


def mlp(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, 16), nn.Tanh(), nn.Linear(16, outputs))


def descend(optimizer: torch.optim.Optimizer, losses: TensorDictBase) -> None:
    total = sum(value for key, value in losses.items() if key.startswith("loss_"))
    optimizer.zero_grad()
    total.backward()
    optimizer.step()


@dataclass
class Result:
    """What a trained team does in the states it meets."""

    state: Tensor  # [M]
    value: Tensor  # [M], reward units
    action: Tensor  # [M, 2], the likeliest of each robot
    probability: Tensor  # [M, 2, 3]

    def value_of(self, state: int) -> float:
        return self.value[self.state == state].mean().item()

    def actions_in(self, state: int) -> set[tuple[int, ...]]:
        return {tuple(row) for row in self.action[self.state == state].tolist()}


def train(
    probe: type[Probe],
    value_norm: Callable[[], nn.Module] | None,
    iterations: int = 60,
    epochs: int = 4,
    seed: int = 0,
) -> Result:
    torch.manual_seed(seed)
    env = probe(seed=seed)
    networks = [mlp(env.num_states, ACTIONS) for _ in NAMES]
    policy = masked_policy(SideBySide(networks))
    actors = {name: masked_policy(network) for name, network in zip(NAMES, networks, strict=True)}
    joint = nn.Sequential(nn.Flatten(-2), mlp(ROBOTS * env.num_states, 1))
    critic = TensorDictModule(joint, [("agents", "observation")], ["state_value"])
    loss = HAPPOLoss(actors, critic, views=VIEWS, value_norm=value_norm and value_norm())
    loss.make_value_estimator(gamma=GAMMA, lmbda=0.95)
    optimizers = {name: torch.optim.Adam(actors[name].parameters(), lr=0.02) for name in NAMES}
    critic_optimizer = torch.optim.Adam(critic.parameters(), lr=0.02)

    for _ in range(iterations):
        with torch.no_grad():
            batch = loss.estimate_advantage(env.rollout(env.horizon, policy)).reshape(-1)
        for name in loss.update_order():
            for _ in range(epochs):
                descend(optimizers[name], loss.actor_loss(batch, name))
            loss.update_factor(batch, name)
        for _ in range(epochs):
            descend(critic_optimizer, loss.critic_loss(batch))

    with torch.no_grad():
        batch = loss.estimate_advantage(env.rollout(env.horizon, policy)).reshape(-1)
        probability = policy.get_dist(batch).probs
    value = batch["state_value"].squeeze(-1)
    return Result(batch["state"], value, probability.argmax(-1), probability)


# ----------------------------------------------------------------- known answers


@pytest.mark.parametrize("probe", PROBES)
def test_probe_is_a_valid_environment(probe):
    masked = ActionMask(action_key=("agents", "action"), mask_key=("agents", "action_mask"))
    check_env_specs(TransformedEnv(probe(num_envs=5), masked))


@value_norms
def test_constant_reward(value_norm):
    result = train(ConstantReward, value_norm)
    torch.testing.assert_close(result.value, torch.ones_like(result.value), atol=0.05, rtol=0)


@value_norms
def test_delayed_reward_is_discounted_once(value_norm):
    result = train(DelayedReward, value_norm)
    assert result.actions_in(0) == {(1, 1)}
    assert result.value_of(0) == pytest.approx(GAMMA, abs=0.05)
    assert result.value_of(1) == pytest.approx(1, abs=0.05)


@value_norms
def test_reward_depends_on_the_observation(value_norm):
    result = train(ObservedReward, value_norm)
    assert result.actions_in(0) == {(0, 0)}
    assert result.actions_in(1) == {(1, 1)}
    assert result.value_of(0) == pytest.approx(1, abs=0.1)
    assert result.value_of(1) == pytest.approx(2, abs=0.1)


@value_norms
def test_cut_off_episodes_bootstrap(value_norm):
    result = train(CutOff, value_norm)
    endless = 1 / (1 - GAMMA)
    assert result.value_of(0) == pytest.approx(endless, abs=0.05)
    assert result.value_of(1) == pytest.approx(endless, abs=0.05)


@value_norms
@pytest.mark.parametrize("seed", range(3))
def test_robots_split_the_work(value_norm, seed):
    result = train(Coordination, value_norm, seed=seed)
    assert result.actions_in(0) in ({(0, 1)}, {(1, 0)})
    assert result.value_of(0) == pytest.approx(2, abs=0.1)


def test_masked_actions_keep_probability_zero():
    result = train(Coordination, None, iterations=10)
    assert (result.probability[..., FORBIDDEN] == 0).all()


# ------------------------------------------------------------ what the factor is for


def expected_reward(first: float, second: float) -> float:
    """Of ``Coordination`` when the robots choose action 1 with these probabilities."""
    return 2 * first * (1 - second) + 2 * (1 - first) * second - first * second


def one_iteration(use_factor: bool) -> tuple[float, float]:
    """Both robots' probabilities of action 1 after an update from 0.38 each.

    The batch holds each joint action as often as the policies choose it, 50 x 50 samples, so no
    chance is involved, and the robots ascend until the clip stops them.
    """
    share = torch.arange(50) < 19  # 19 of 50 choose action 1
    action = torch.cartesian_prod(share.long(), share.long())
    env = Coordination(num_envs=len(action))
    logits = torch.tensor([0.62, 0.38, 1.0]).log()
    tables = [nn.Linear(1, ACTIONS, bias=False) for _ in NAMES]
    for table in tables:
        table.weight = nn.Parameter(logits.clone().unsqueeze(-1))
    actors = {name: masked_policy(table) for name, table in zip(NAMES, tables, strict=True)}
    critic = TensorDictModule(
        nn.Sequential(nn.Flatten(-2), nn.Linear(ROBOTS, 1)),
        [("agents", "observation")],
        ["state_value"],
    )
    loss = HAPPOLoss(actors, critic, views=VIEWS, clip_epsilon=0.2, entropy_coeff=0.0)
    start = env.reset()
    start["agents", "action"] = action
    start["agents", "action_log_prob"] = logits[action]
    batch = loss.estimate_advantage(env.step(start).unsqueeze(-1)).reshape(-1)

    for name in NAMES:
        optimizer = torch.optim.SGD(actors[name].parameters(), lr=0.2)
        for _ in range(200):
            descend(optimizer, loss.actor_loss(batch, name))
        if use_factor:
            loss.update_factor(batch, name)
    first, second = (table.weight[:FORBIDDEN, 0].softmax(0)[1].item() for table in tables)
    return first, second


def test_without_the_factor_an_update_overshoots():
    before = expected_reward(0.38, 0.38)

    # While the other robot chooses action 1 with 0.38 < 0.4, choosing it more often pays. The first
    # robot goes up to the clip, 1.2 x 0.38 = 0.456. With M the second one sees that and goes down
    # to the clip, 0.8 x 0.38 = 0.304. Without M it goes up too, and both together lose.
    simultaneous = one_iteration(use_factor=False)
    assert simultaneous == pytest.approx((0.456, 0.456), abs=0.01)
    assert expected_reward(*simultaneous) < before - 0.01

    sequential = one_iteration(use_factor=True)
    assert sequential == pytest.approx((0.456, 0.304), abs=0.01)
    assert expected_reward(*sequential) > before + 0.02
