"""Sequential updates and their factor against brute force."""

from __future__ import annotations

import copy
import itertools
from collections import Counter

import pytest
import torch
from torch.testing import assert_close

from tests.helpers.happo import (
    ARENAS,
    CLIP,
    NAMES,
    ROBOTS,
    STEPS,
    all_equal,
    assert_same_losses,
    clipped_objective,
    descend,
    make_team,
    parameters_of,
    perturb,
    robot_ratio,
)


@pytest.mark.parametrize("minibatch_size", [ARENAS * STEPS, 22], ids=["full batch", "minibatches"])
def test_sequential_updates_match_brute_force(minibatch_size):
    team = make_team()
    old = copy.deepcopy(team.networks)
    flat = team.batch.reshape(-1)
    advantage = flat["advantage"].squeeze(-1)
    factor = torch.ones(len(flat))
    left_the_clip = False

    for robot in (2, 0, 3, 1):
        network, name = team.networks[robot], NAMES[robot]
        parameters = list(network.parameters())
        optimizer = torch.optim.Adam(parameters, lr=3e-2)
        for _ in range(4):
            for index in torch.randperm(len(flat)).split(minibatch_size):
                minibatch = flat[index]
                losses = team.loss.actor_loss(minibatch, name)
                ratio = robot_ratio(network, old[robot], minibatch, robot)
                expected = clipped_objective(ratio, factor[index], advantage[index])
                assert_close(losses["loss_objective"], expected)
                gradient = torch.autograd.grad(
                    losses["loss_objective"], parameters, retain_graph=True
                )
                assert_close(gradient, torch.autograd.grad(expected, parameters))
                outside = ((ratio - 1).abs() > CLIP).float().mean()
                assert_close(losses["clip_fraction"], outside)
                left_the_clip |= bool(outside)
                descend(optimizer, losses)
        team.loss.update_factor(flat, name)
        with torch.no_grad():
            factor = factor * robot_ratio(network, old[robot], flat, robot)
        assert_close(flat["factor"].squeeze(-1), factor)
    assert left_the_clip


def test_absent_factor_is_a_factor_of_ones():
    team = make_team()
    perturb(team.networks[1])
    absent = team.loss.actor_loss(team.batch, "robot_1")
    team.batch["factor"] = torch.ones_like(team.batch["advantage"])
    ones = team.loss.actor_loss(team.batch, "robot_1")
    assert_same_losses(absent, ones)


@pytest.mark.parametrize("robot", range(ROBOTS))
def test_an_actor_update_moves_no_other_parameters(robot):
    team = make_team()
    # one optimizer over everything: a gradient that leaked would move others
    optimizer = torch.optim.Adam(team.loss.parameters(), lr=1e-2)
    before = [parameters_of(module) for module in team.modules]
    for _ in range(3):
        descend(optimizer, team.loss.actor_loss(team.batch, NAMES[robot]))
        team.loss.update_factor(team.batch, NAMES[robot])
    for i, module in enumerate(team.modules):
        assert all_equal(before[i], module.parameters()) == (i != robot), i
        assert all((p.grad is None) == (i != robot) for p in module.parameters()), i


def test_a_critic_update_moves_no_actor():
    team = make_team()
    optimizer = torch.optim.Adam(team.loss.parameters(), lr=1e-2)
    before = parameters_of(*team.networks), parameters_of(team.critic)
    descend(optimizer, team.loss.critic_loss(team.batch))
    assert all_equal(before[0], parameters_of(*team.networks))
    assert not all_equal(before[1], team.critic.parameters())


def test_losses_leave_the_batch_alone():
    team = make_team()
    team.batch["factor"] = torch.rand_like(team.batch["advantage"])
    before = team.batch.clone()
    team.loss.actor_loss(team.batch, "robot_3")
    team.loss.critic_loss(team.batch)
    team.loss(team.batch)
    assert set(team.batch.keys(True, True)) == set(before.keys(True, True))
    assert (team.batch == before).all()


# ----------------------------------------------------------------- the factor alone


def test_factor_is_neither_clipped_nor_normalised_nor_differentiated():
    team = make_team()
    old = copy.deepcopy(team.networks)
    for network in team.networks:
        perturb(network)
    expected = torch.ones(ARENAS, STEPS)
    with torch.enable_grad():
        for i, name in enumerate(NAMES):
            assert team.loss.update_factor(team.batch, name) is team.batch
            expected = expected * robot_ratio(team.networks[i], old[i], team.batch, i).detach()
    factor = team.batch["factor"]
    assert factor.shape == (ARENAS, STEPS, 1)
    assert_close(factor.squeeze(-1), expected)
    assert factor.min() < (1 - CLIP) ** ROBOTS
    assert factor.max() > (1 + CLIP) ** ROBOTS
    assert not factor.requires_grad
    assert all(p.grad is None for p in team.loss.parameters())


def test_factor_over_rollouts_and_flat_batches_alike():
    team = make_team()
    for network in team.networks:
        perturb(network)
    flat, single = team.batch.reshape(-1), team.batch[0, 0]
    for name in NAMES:
        for batch in (team.batch, flat, single):
            team.loss.update_factor(batch, name)
    assert flat["factor"].shape == (ARENAS * STEPS, 1)
    assert_close(team.batch["factor"].reshape(-1, 1), flat["factor"])
    assert_close(team.batch["factor"][0, 0], single["factor"])


def test_entropy_bonus_is_not_weighted_by_the_factor():
    team = make_team(entropy_coeff=0.05)
    group = team.batch["agents"]
    without = team.loss.actor_loss(team.batch, "robot_0")
    team.batch["factor"] = 0.1 + 3 * torch.rand(ARENAS, STEPS, 1)
    losses = team.loss.actor_loss(team.batch, "robot_0")
    assert not torch.equal(losses["loss_objective"], without["loss_objective"])
    assert torch.equal(losses["loss_entropy"], without["loss_entropy"])

    logits = team.networks[0](group["observation"][:, :, 0])
    probability = logits.masked_fill(~group["action_mask"][:, :, 0], -torch.inf).softmax(-1)
    entropy = -torch.special.xlogy(probability, probability).sum(-1).mean()
    assert_close(losses["entropy"], entropy)
    assert_close(losses["loss_entropy"], -0.05 * entropy)


# ----------------------------------------------------------------- order of updates


def test_update_order_takes_every_permutation_equally_often():
    loss = make_team().loss
    generator = torch.Generator().manual_seed(5)
    draws, permutations = 4800, list(itertools.permutations(NAMES))
    count = Counter(tuple(loss.update_order(generator)) for _ in range(draws))
    assert set(count) == set(permutations)
    expected = draws / len(permutations)
    assert all(abs(n - expected) < 5 * expected**0.5 for n in count.values()), count
    first = Counter()
    for order, n in count.items():
        first[order[0]] += n
    assert all(abs(n - draws / ROBOTS) < 5 * (draws / ROBOTS) ** 0.5 for n in first.values()), first


def test_update_order_depends_on_the_generator_only():
    loss = make_team().loss

    def orders(global_seed: int) -> list[list[str]]:
        torch.manual_seed(global_seed)
        generator = torch.Generator().manual_seed(7)
        state = torch.get_rng_state()
        drawn = [loss.update_order(generator) for _ in range(20)]
        assert torch.equal(state, torch.get_rng_state())
        return drawn

    assert orders(1) == orders(2)
