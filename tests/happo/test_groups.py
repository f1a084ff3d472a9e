"""Groups with action spaces of their own, and masked actions."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.testing import assert_close

from marl_explore.happo.loss import HAPPOLoss
from tests.helpers.happo import (
    ACTIONS,
    ARENAS,
    CLIP,
    DRONE_FEATURES,
    FEATURES,
    STEPS,
    clipped_objective,
    continuous_actor,
    drone_network,
    ground_network,
    masked_actor,
    masked_log_prob,
    perturb,
    random_mask,
    rollout,
    state_critic,
    tanh_normal_log_prob,
    with_advantage,
)

# ------------------------------------------------- groups with other action spaces


@dataclass
class MixedTeam:
    """A masked ground robot, and a pair of continuous drones that share one actor."""

    ground: nn.Module
    drone: nn.Module
    loss: HAPPOLoss
    batch: TensorDict  # [6, 11], with random advantages and value targets

    def ratio(self, name: str, old: nn.Module, batch: TensorDictBase) -> Tensor:
        """Ratio [*B] of an actor; of the pair it is that of the joint action of both drones."""
        if name == "drones":
            return self.drone_ratios(old, batch).prod(-1)
        row = [batch[name][key] for key in ("observation", "action_mask", "action")]
        return (masked_log_prob(self.ground, *row) - masked_log_prob(old, *row).detach()).exp()

    def drone_ratios(self, old: nn.Module, batch: TensorDictBase) -> Tensor:
        """Ratio [*B, 2] of each drone's own action."""
        row = [batch["drones"][key] for key in ("observation", "action")]
        change = tanh_normal_log_prob(self.drone, *row) - tanh_normal_log_prob(old, *row).detach()
        return change.exp()


def make_mixed_team() -> MixedTeam:
    ground, drone = ground_network(), drone_network()
    actors = {
        "ground": masked_actor(ground, "ground"),
        "drones": continuous_actor(drone, "drones"),
    }
    shape = (ARENAS, STEPS)
    entries = {"observation": torch.randn(*shape, FEATURES), "action_mask": random_mask(*shape)}
    drones = {"observation": torch.randn(*shape, 2, DRONE_FEATURES)}
    batch = with_advantage(rollout(ground=entries, drones=drones))
    with torch.no_grad():
        for actor in actors.values():
            actor(batch)
    loss = HAPPOLoss(actors, state_critic(), clip_epsilon=CLIP)
    return MixedTeam(ground, drone, loss, batch)


@pytest.mark.parametrize("order", [("ground", "drones"), ("drones", "ground")])
@pytest.mark.parametrize("flat", [False, True], ids=["rollout", "flat"])
def test_mixed_groups_factor_matches_brute_force(order, flat):
    team = make_mixed_team()
    old = {"ground": copy.deepcopy(team.ground), "drones": copy.deepcopy(team.drone)}
    batch = team.batch.reshape(-1) if flat else team.batch
    expected = torch.ones(batch.shape)
    for name in order:
        perturb(team.ground if name == "ground" else team.drone, size=0.1)
        team.loss.update_factor(batch, name)
        expected = expected * team.ratio(name, old[name], batch).detach()
        assert_close(batch["factor"].squeeze(-1), expected, rtol=1e-4, atol=1e-5)


def test_mixed_groups_ground_robot_loss_after_the_drones():
    team = make_mixed_team()
    old_ground, old_drone = copy.deepcopy(team.ground), copy.deepcopy(team.drone)
    perturb(team.ground)
    perturb(team.drone, size=0.1)
    team.loss.update_factor(team.batch, "drones")
    got = team.loss.actor_loss(team.batch, "ground")["loss_objective"]
    expected = clipped_objective(
        team.ratio("ground", old_ground, team.batch),
        team.ratio("drones", old_drone, team.batch).detach(),
        team.batch["advantage"].squeeze(-1),
    )
    assert_close(got, expected, rtol=1e-4, atol=1e-5)


def test_mixed_groups_each_drone_of_a_shared_actor_is_clipped_on_its_own():
    team = make_mixed_team()
    old_ground, old_drone = copy.deepcopy(team.ground), copy.deepcopy(team.drone)
    perturb(team.ground)
    perturb(team.drone, size=0.1)
    team.loss.update_factor(team.batch, "ground")
    got = team.loss.actor_loss(team.batch, "drones")["loss_objective"]
    expected = clipped_objective(
        team.drone_ratios(old_drone, team.batch),
        team.ratio("ground", old_ground, team.batch).detach().unsqueeze(-1),
        team.batch["advantage"],
    )
    assert_close(got, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda actor, critic: HAPPOLoss({}, critic), "at least one actor"),
        (
            lambda actor, critic: HAPPOLoss({"a": actor}, views={"a": ("team", 0)}),
            "views\\['a'\\].*'team'.*reads",
        ),
        (
            lambda actor, critic: HAPPOLoss({"a": actor}, continuous_actor(critic, "ground")),
            "'a' and 'critic' share parameters",
        ),
    ],
    ids=["no actors", "view of another group", "critic in an actor"],
)
def test_parts_that_do_not_fit_are_refused(build, message):
    network = ground_network()
    with pytest.raises(ValueError, match=message):
        build(masked_actor(network, "ground"), network)


def test_padded_batches_are_refused():
    team = make_mixed_team()
    padded = team.batch.set(("collector", "mask"), torch.ones(*team.batch.shape, dtype=torch.bool))
    with pytest.raises(ValueError, match="split_trajs=False"):
        team.loss.estimate_advantage(padded)


# --------------------------------------------------------------------- action masks


def test_masked_actions_have_no_probability_and_no_gradient():
    samples = 40
    mask = random_mask(samples)
    table = nn.Linear(samples, ACTIONS, bias=False)  # column s holds the logits of sample s
    actor = masked_actor(table, "robot")
    entries = {"observation": torch.eye(samples), "action_mask": mask}
    batch = TensorDict({"robot": entries}, [samples])
    with torch.no_grad():
        actor(batch)
    perturb(table)
    batch["advantage"] = torch.randn(samples, 1)
    batch["factor"] = 0.5 + torch.rand(samples, 1)

    distribution = actor.get_dist(batch)
    for action in range(ACTIONS):
        log_prob = distribution.log_prob(torch.full((samples,), action))
        assert torch.equal(log_prob == -torch.inf, ~mask[:, action])

    loss = HAPPOLoss({"robot": actor}, entropy_coeff=0.05)
    for key in ("loss_objective", "loss_entropy"):
        (gradient,) = torch.autograd.grad(loss.actor_loss(batch, "robot")[key], [table.weight])
        assert gradient.isfinite().all()
        assert (gradient.T[~mask] == 0).all()
        assert (gradient.T[mask] != 0).any()
