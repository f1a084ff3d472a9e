"""Advantages, returns and value normalisation."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torch.testing import assert_close
from torchrl.modules import (
    PopArtValueNorm,
    RunningValueNorm,
)

from marl_explore.happo.loss import HAPPOLoss
from tests.helpers.happo import (
    FEATURES,
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


def counted(critic: TensorDictModule) -> list[int]:
    """The numbers of observations that it evaluates from now on."""
    rows: list[int] = []
    critic.register_forward_hook(lambda module, args, output: rows.append(args[0].numel()))
    return rows


@pytest.mark.parametrize("norm_class", [None, PopArtValueNorm])
def test_observations_that_two_steps_share_are_evaluated_once(norm_class):
    critic, batch = state_critic(), episodes()
    norm = norm_class() if norm_class else None
    if norm is not None:
        norm.update(EARLIER)
    twice = batch.clone()
    loss = loss_of_critic(critic, value_norm=norm)
    loss.make_value_estimator(gamma=GAMMA, lmbda=LMBDA)
    state = None if norm is None else {k: v.clone() for k, v in norm.state_dict().items()}
    loss.estimate_advantage(twice)
    if norm is not None:
        norm.load_state_dict(state)
    loss.make_value_estimator(gamma=GAMMA, lmbda=LMBDA, reuse_values=True)
    rows = counted(critic)
    assert loss.estimate_advantage(batch) is batch
    assert rows == [16, 6]  # four episodes end, and both rows do
    for key in ("advantage", "value_target", "state_value", ("next", "state_value")):
        assert_close(batch[key], twice[key])
    assert not any(x.requires_grad for x in batch.values(True, True))
    loss.set_keys(value="state_value")  # makes the estimator anew, with the same options
    loss.estimate_advantage(batch)
    assert rows[2:] == [16, 6]


@pytest.mark.parametrize("shape", [(8,), (1, 1), (3, 2, 5)])
def test_rollouts_of_any_shape_are_evaluated_once(shape):
    critic = state_critic()
    state = torch.randn(*shape, FEATURES)
    batch = TensorDict({"state": state, "next": {"state": torch.randn_like(state)}}, shape)
    batch["next", "state"][..., :-1, :] = state[..., 1:, :]
    batch["next"].set("reward", torch.randn(*shape, 1))
    for name in ("done", "terminated"):
        batch["next"].set(name, torch.zeros(*shape, 1, dtype=torch.bool))
    loss = loss_of_critic(critic)
    loss.make_value_estimator(gamma=GAMMA, lmbda=LMBDA, reuse_values=True, average_gae=False)
    rows = counted(critic)
    loss.estimate_advantage(batch)
    assert rows == [batch.numel(), batch.numel() // shape[-1]]
    value, next_value = predictions(critic, batch)
    assert_close(batch["state_value"], value)
    assert_close(batch["next", "state_value"], next_value)


@pytest.mark.parametrize("entry", ["state", "seen", "count"])
def test_a_next_observation_that_differs_at_all_is_evaluated(entry):
    """In one number of one entry, and although the episode goes on."""
    shape, keys = (2, 5), [("agents", "state"), ("agents", "seen"), ("agents", "count")]
    weights = torch.randn(FEATURES + 6)

    def value(state: Tensor, seen: Tensor, count: Tensor) -> Tensor:
        columns = torch.cat([state, seen.flatten(-2), count], -1).to(weights)
        return (columns @ weights).unsqueeze(-1)

    def observed() -> TensorDict:
        return TensorDict(
            {
                "state": torch.randn(*shape, FEATURES),
                "seen": torch.rand(*shape, 2, 2) < 0.5,
                "count": torch.randint(9, (*shape, 2)),
            },
            shape,
        )

    batch = TensorDict({"agents": observed(), "next": {"agents": observed()}}, shape)
    batch["next", "agents"][:, :-1] = batch["agents"][:, 1:]
    batch["next"].set("reward", torch.randn(*shape, 1))
    for name in ("done", "terminated"):
        batch["next"].set(name, torch.zeros(*shape, 1, dtype=torch.bool))
    changed = batch["next", "agents", entry][1, 2].view(-1)[-1:]
    changed.copy_(~changed if changed.dtype is torch.bool else changed + 1)
    plain = batch.clone()
    critic = TensorDictModule(value, keys, ["state_value"])
    loss = loss_of_critic(critic)
    rows = counted(critic)
    for rollout, reuse in ((plain, False), (batch, True)):
        loss.make_value_estimator(gamma=GAMMA, lmbda=LMBDA, reuse_values=reuse)
        loss.estimate_advantage(rollout)
    assert rows[-2:] == [10, 3]  # both rows end, and one step goes on elsewhere
    for key in ("advantage", "state_value", ("next", "state_value")):
        assert_close(batch[key], plain[key])
    assert batch["next", "state_value"][1, 2] != batch["state_value"][1, 3]


@pytest.mark.parametrize(
    "option", [{"num_chunks": 2}, {"skip_existing": True}, {"deactivate_vmap": True}], ids=str
)
def test_options_of_how_gae_calls_the_critic_do_not_fit_reused_values(option):
    loss = loss_of_critic(state_critic())
    loss.make_value_estimator(**option)
    name = next(iter(option))
    with pytest.raises(ValueError, match=f"{name} is not allowed with reuse_values=True"):
        loss.make_value_estimator(reuse_values=True, **option)


def test_an_observation_stands_for_a_next_one_that_is_absent():
    """As in TorchRL's GAE: a collector of compact observations marks it by NaN."""
    critic, batch = state_critic(), episodes()
    batch["next", "state"][batch["next", "done"].squeeze(-1)] = torch.nan
    twice = batch.clone()
    loss = loss_of_critic(critic)
    for rollout, reuse_values in ((twice, False), (batch, True)):
        loss.make_value_estimator(gamma=GAMMA, lmbda=LMBDA, reuse_values=reuse_values)
        loss.estimate_advantage(rollout)
    assert batch["advantage"].isfinite().all()
    assert_close(batch["advantage"], twice["advantage"])


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
