"""Who learns: what the actors and critics of every algorithm read and share."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from marl_explore.policies.io import save_policy
from marl_explore.policies.networks import MLP
from marl_explore.policies.policy import Policy, PolicyConfig
from marl_explore.training.learners import make_learners
from marl_explore.training.trainer import Trainer
from tests.helpers.configs import NETWORKS, tiny

ROBOTS = 3
CONFIG = tiny(ROBOTS, episodes=8, ppo_epochs=1)


def trainer_of(algorithm, network="mlp"):
    return Trainer(replace(CONFIG, algorithm=algorithm, network=NETWORKS[network]))


def influence(critic, batch):
    """Whether the critic's value depends on what robot i observes: bool [N]."""
    group = batch["agents"].clone()
    observation = {key: group["observation", key].float() for key in ("fov", "fpr", "net")}
    for entry in observation.values():
        entry.requires_grad_()
    value = critic.module(**observation)
    gradients = torch.autograd.grad(value.sum(), list(observation.values()))
    return sum(g.abs().movedim(2, 0).flatten(1).sum(1) for g in gradients) > 0


@pytest.mark.parametrize("network", ["mlp", "cnn"])
def test_each_of_ippos_critics_reads_its_own_robot(network):
    trainer = trainer_of("ippo", network)
    (batch,) = trainer.collect()
    assert list(trainer.learners) == [f"robot_{i}" for i in range(ROBOTS)]
    for robot, learner in enumerate(trainer.learners.values()):
        assert influence(learner.critic, batch).tolist() == [i == robot for i in range(ROBOTS)]
        assert learner.loss.names == [f"robot_{robot}"]


@pytest.mark.parametrize("algorithm", ["happo", "mappo"])
def test_the_critic_of_a_team_reads_all_robots(algorithm):
    trainer = trainer_of(algorithm)
    (learner,) = trainer.learners.values()
    assert influence(learner.critic, *trainer.collect()).all()


def test_ippos_robots_learn_from_one_reward_and_no_factor():
    trainer = trainer_of("ippo")
    (batch,) = trainer.collect()
    metrics = trainer.update(batch)
    assert metrics["factor_ess"] == metrics["factor_mean"] == 1
    assert batch.get("advantage", None) is None  # every learner wrote into a copy of its own


@pytest.mark.parametrize("network", ["mlp", "cnn"])
def test_mappos_objective_is_the_mean_over_robots_of_clipped_ppo(network):
    trainer = trainer_of("mappo", network)
    (learner,) = trainer.learners.values()
    batch = learner.loss.estimate_advantage(*trainer.collect()).reshape(-1)
    actor = trainer.policy.actors[0]
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    got = learner.loss.actor_loss(batch, "team")["loss_objective"]

    per_robot = []
    for robot in range(ROBOTS):
        group = {
            key: batch["agents"][entry].select(1, robot)
            for key, entry in {
                "fov": ("observation", "fov"),
                "fpr": ("observation", "fpr"),
                "net": ("observation", "net"),
                "mask": "action_mask",
                "action": "action",
                "before": "action_log_prob",
            }.items()
        }
        logits = actor(group["fov"], group["fpr"], group["net"])
        log_probs = logits.masked_fill(~group["mask"], -torch.inf).log_softmax(-1)
        after = log_probs.gather(-1, group["action"].unsqueeze(-1)).squeeze(-1)
        ratio = (after - group["before"]).exp()
        advantage = batch["advantage"].squeeze(-1)
        clipped = ratio.clamp(0.8, 1.2)
        per_robot.append(-torch.minimum(ratio * advantage, clipped * advantage).mean())
    assert_close(got, torch.stack(per_robot).mean(), rtol=1e-4, atol=1e-5)


def test_a_shared_actor_answers_alike_for_every_robot():
    spec = PolicyConfig(CONFIG.arena, NETWORKS["cnn"], shared=True)
    policy = Policy(spec, spec.make_actors())
    assert len(policy.actors) == 1
    fov, fpr, net = torch.rand(2, 1, 3, 3), torch.rand(2, 1, 8, 3), torch.rand(2, 1, ROBOTS)
    rows = [entry.expand(2, ROBOTS, *entry.shape[2:]) for entry in (fov, fpr, net)]
    logits = policy.team.stacked(*rows)
    assert_close(logits, logits[:, :1].expand_as(logits))
    assert policy.actor_of(2) is policy.actors[0]


def test_every_algorithm_starts_from_actors_of_its_own():
    for algorithm, actors in (("happo", ROBOTS), ("mappo", 1), ("ippo", ROBOTS)):
        trainer = trainer_of(algorithm)
        assert len(trainer.policy.actors) == actors
        names = [name for learner in trainer.learners.values() for name in learner.loss.names]
        assert len(names) == actors


def test_a_run_starts_from_another_policy(tmp_path):
    shared = trainer_of("mappo").policy
    torch.nn.init.normal_(shared.actors[0].layers[0].weight)
    path = save_policy(shared, tmp_path / "shared.safetensors")
    trainer = Trainer(replace(CONFIG, init_from=str(path)))
    weights = [actor.layers[0].weight for actor in trainer.policy.actors]
    assert all(weight.equal(shared.actors[0].layers[0].weight) for weight in weights)
    assert len({id(weight) for weight in weights}) == ROBOTS
    with pytest.raises(ValueError, match=r"3 actors \(MLP\(hidden=\(8,\), .* cannot start from 1 "):
        Trainer(replace(CONFIG, init_from=str(path), network=MLP(hidden=(8,))))
    with pytest.raises(ValueError, match=r"2 actors .*, 2\) cannot start from 1 .*, 3\)"):
        Trainer(replace(CONFIG, init_from=str(path), arena=replace(CONFIG.arena, num_agents=2)))
    Trainer(replace(CONFIG, init_from="nowhere"), fresh=False)  # weights come from a checkpoint


def test_ippo_with_a_critic_on_the_state_is_refused():
    with pytest.raises(ValueError, match="critic_input='state'.*ippo's critics"):
        replace(CONFIG, algorithm="ippo", critic_input="state")


def test_optimizers_cover_all_parameters_once():
    trainer = trainer_of("ippo")
    held = [
        id(parameter)
        for learner in make_learners(trainer.config, trainer.policy).values()
        for optimizer in learner.optimizers.values()
        for parameter in optimizer.param_groups[0]["params"]
    ]
    assert len(held) == len(set(held))
    assert {id(p) for p in trainer.policy.actors.parameters()} <= set(held)
