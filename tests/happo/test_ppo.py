"""One robot updated by HAPPO is plain PPO, bit for bit."""

from __future__ import annotations

import copy

import pytest
import torch
from torch.testing import assert_close
from torchrl.objectives import ClipPPOLoss

from marl_explore.happo.loss import HAPPOLoss
from tests.helpers.happo import (
    ARENAS,
    CLIP,
    DRONE_FEATURES,
    FEATURES,
    GAMMA,
    LMBDA,
    STEPS,
    all_equal,
    continuous_actor,
    descend,
    drone_network,
    ground_network,
    masked_actor,
    random_mask,
    rollout,
    state_critic,
)

# ------------------------------------------------------------ one robot is plain PPO


@pytest.mark.parametrize("continuous", [False, True], ids=["masked categorical", "TanhNormal"])
def test_one_robot_is_clip_ppo_bitwise(continuous):
    shape = (ARENAS, STEPS)
    if continuous:
        actor = continuous_actor(drone_network(), "agents")
        batch = rollout(agents={"observation": torch.randn(*shape, DRONE_FEATURES)})
    else:
        actor = masked_actor(ground_network(), "agents")
        entries = {"observation": torch.randn(*shape, FEATURES), "action_mask": random_mask(*shape)}
        batch = rollout(agents=entries)
    critic = state_critic()
    with torch.no_grad():
        actor(batch)
    stock_actor, stock_critic = copy.deepcopy(actor), copy.deepcopy(critic)

    happo = HAPPOLoss({"robot": actor}, critic, clip_epsilon=CLIP, entropy_coeff=0.01)
    happo.make_value_estimator(gamma=GAMMA, lmbda=LMBDA)
    stock = ClipPPOLoss(
        stock_actor, stock_critic, clip_epsilon=CLIP, entropy_coeff=0.01, loss_critic_type="l2"
    )
    stock.make_value_estimator(gamma=GAMMA, lmbda=LMBDA, average_gae=True)

    stock_batch, functional_batch = batch.clone(), batch.clone()
    happo.estimate_advantage(batch)
    with torch.no_grad():
        stock.value_estimator(stock_batch)
        stock.value_estimator(
            functional_batch,
            params=stock.critic_network_params,
            target_params=stock.target_critic_network_params,
        )
    for key in ("advantage", "value_target", "state_value"):
        assert torch.equal(batch[key], stock_batch[key]), key
        # Stacked copies of the parameters make the matrix products round otherwise.
        assert_close(batch[key], functional_batch[key], rtol=0, atol=2e-6)

    optimizer = torch.optim.Adam(actor.parameters(), lr=1e-2)
    critic_optimizer = torch.optim.Adam(critic.parameters(), lr=1e-2)
    stock_optimizer = torch.optim.Adam(stock.parameters(), lr=1e-2)
    flat, stock_flat = batch.reshape(-1), stock_batch.reshape(-1)
    for step in range(8):
        torch.manual_seed(step)  # TanhNormal's entropy is estimated from a sample
        expected = stock(stock_flat)
        torch.manual_seed(step)
        got = happo.actor_loss(flat, "robot")
        critic_got = happo.critic_loss(flat)

        shared = set(expected.keys()) - {"loss_critic", "explained_variance"}
        assert shared == set(got.keys())
        for key in shared:
            assert torch.equal(got[key], expected[key]), (step, key)
        assert torch.equal(critic_got["loss_critic"], expected["loss_critic"]), step
        # The stock loss guards its division by another epsilon, and keeps the last axis.
        assert_close(critic_got["explained_variance"], expected["explained_variance"].squeeze())

        descend(stock_optimizer, expected)
        descend(optimizer, got)
        descend(critic_optimizer, critic_got)
        assert all_equal(actor.parameters(), stock_actor.parameters()), step
        assert all_equal(critic.parameters(), stock_critic.parameters()), step
    assert expected["clip_fraction"] > 0.05  # the clip had something to do
