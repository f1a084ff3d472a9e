"""Advantages, returns and value normalisation."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torch.testing import assert_close
from torchrl.modules import (
    PopArtValueNorm,
    RunningValueNorm,
)

from marl_explore.happo.loss import HAPPOLoss
from tests.helpers.happo import (
    GAMMA,
    LMBDA,
    episodes,
    gae_by_hand,
    ground_network,
    masked_actor,
    perturb,
    state_critic,
)

# ------------------------------------------------------------------ value estimation


def advantages_by_hand(batch: TensorDictBase, value: Tensor, next_value: Tensor) -> Tensor:
    ends = batch["next"]
    columns = (value, next_value, ends["reward"], ends["done"], ends["terminated"])
    rows = zip(*(column.squeeze(-1).tolist() for column in columns), strict=True)
    return torch.tensor([gae_by_hand(*row) for row in rows]).unsqueeze(-1)


def predictions(critic: TensorDictModule, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
    """The critic's outputs for the observations and the next observations."""
    with torch.no_grad():
        return critic.module(batch["state"]), critic.module(batch["next", "state"])


def loss_of_critic(critic: TensorDictModule, **options) -> HAPPOLoss:
    return HAPPOLoss({"robot": masked_actor(ground_network(), "robot")}, critic, **options)


def test_truncated_episodes_bootstrap_and_terminated_ones_do_not():
    critic, batch = state_critic(), episodes()
    loss = loss_of_critic(critic)
    loss.make_value_estimator(gamma=GAMMA, lmbda=LMBDA, average_gae=False)
    value, next_value = predictions(critic, batch)
    expected = advantages_by_hand(batch, value, next_value)
    assert loss.estimate_advantage(batch) is batch
    assert_close(batch["advantage"], expected)
    assert_close(batch["value_target"], expected + value)
    assert_close(batch["state_value"], value)
    assert not any(batch[key].requires_grad for key in ("advantage", "value_target"))


def test_average_gae_is_the_default_and_normalises_over_the_batch():
    critic, batch = state_critic(), episodes()
    loss = loss_of_critic(critic)
    loss.make_value_estimator(gamma=GAMMA, lmbda=LMBDA)
    loss.estimate_advantage(batch)
    advantage = batch["advantage"]
    assert_close(advantage.mean(), torch.tensor(0.0))
    assert_close(advantage.std(), torch.tensor(1.0))
    value, next_value = predictions(critic, batch)
    raw = advantages_by_hand(batch, value, next_value)
    assert_close(advantage, (raw - raw.mean()) / raw.std())
    assert_close(batch["value_target"], raw + value)  # the critic's target is not normalised


def test_an_estimate_uses_the_critic_as_it_is_now():
    critic, batch = state_critic(), episodes()
    loss = loss_of_critic(critic)
    loss.make_value_estimator(gamma=GAMMA, lmbda=LMBDA, average_gae=False)
    loss.estimate_advantage(batch)
    perturb(critic)
    loss.estimate_advantage(batch)
    assert_close(batch["advantage"], advantages_by_hand(batch, *predictions(critic, batch)))


def test_default_estimator_has_the_documented_numbers():
    critic, batch = state_critic(), episodes()
    explicit = batch.clone()
    loss_of_critic(critic).estimate_advantage(batch)
    loss = loss_of_critic(critic)
    loss.make_value_estimator(gamma=0.99, lmbda=0.95, average_gae=True)
    assert torch.equal(batch["advantage"], loss.estimate_advantage(explicit)["advantage"])


EARLIER = torch.tensor([[10.0], [14.0], [15.0], [21.0]])  # targets seen before: mean 15, var 15.5


@pytest.mark.parametrize("norm_class", [RunningValueNorm, PopArtValueNorm])
def test_gae_uses_denormalised_values(norm_class):
    critic, batch = state_critic(), episodes()
    norm = norm_class()
    norm.update(EARLIER)
    loss = loss_of_critic(critic, value_norm=norm)
    loss.make_value_estimator(gamma=GAMMA, lmbda=LMBDA, average_gae=False)
    value, next_value = (15 + 15.5**0.5 * v for v in predictions(critic, batch))
    expected = advantages_by_hand(batch, value, next_value)
    loss.estimate_advantage(batch)
    tolerance = {"rtol": 1e-4, "atol": 1e-3 if norm_class is PopArtValueNorm else 1e-5}
    assert_close(batch["state_value"], value, **tolerance)
    assert_close(batch["advantage"], expected, **tolerance)
    assert_close(batch["value_target"], expected + value, **tolerance)


def test_critic_loss_is_a_squared_error_in_normalised_units():
    critic, batch = state_critic(), episodes()
    norm = RunningValueNorm()
    norm.update(EARLIER)
    loss = loss_of_critic(critic, value_norm=norm)
    loss.estimate_advantage(batch)
    seen = torch.cat([EARLIER, batch["value_target"].reshape(-1, 1)])
    target = (batch["value_target"] - seen.mean()) / seen.std(correction=0)
    value, _ = predictions(critic, batch)
    losses = loss.critic_loss(batch)
    assert_close(losses["loss_critic"], ((value - target) ** 2).mean())  # no factor 1/2
    explained = 1 - (target - value).var(correction=0) / target.var(correction=0)
    assert_close(losses["explained_variance"], explained)


def test_critic_loss_without_normalisation():
    critic, batch = state_critic(), episodes()
    loss = loss_of_critic(critic)
    loss.estimate_advantage(batch)
    value, _ = predictions(critic, batch)
    expected = ((value - batch["value_target"]) ** 2).mean()
    assert_close(loss.critic_loss(batch)["loss_critic"], expected)


def test_value_statistics_are_updated_once_per_estimate():
    critic, batch = state_critic(), episodes()
    norm = RunningValueNorm()
    loss = loss_of_critic(critic, value_norm=norm)
    seen = []
    for _ in range(2):
        loss.estimate_advantage(batch)
        seen.append(batch["value_target"].reshape(-1))
        targets = torch.cat(seen)
        for _ in range(3):
            loss.critic_loss(batch)
            loss.critic_loss(batch.reshape(-1)[:5])
        assert norm.count == len(targets)
        assert_close(norm.mean, targets.mean().view(1))
        assert_close(norm.m2 / norm.count, targets.var(correction=0).view(1))
