"""An actor per type of robots: who acts with which weights, and what learns."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import pytest
import torch
from torchrl.envs import ExplorationType, set_exploration_type

from marl_explore.config.arena import ArenaConfig
from marl_explore.policies.io import load_policy, save_policy
from marl_explore.policies.policy import Policy, PolicyConfig
from marl_explore.training.collectors import make_collector
from marl_explore.training.environment import make_training_env
from marl_explore.training.trainer import Trainer
from tests.helpers.configs import BY_TYPE, NETWORKS

TEAM = BY_TYPE.arena


def run(network="mlp", **settings):
    return replace(BY_TYPE, network=NETWORKS[network], **settings)


def test_types_are_robots_with_equal_settings():
    assert TEAM.types == ((0, 3), (1, 2))
    assert ArenaConfig().types == ((0, 1, 2, 3),)
    assert replace(TEAM, move_period=(1, 1, 2, 2)).types == ((0,), (1,), (2,), (3,))
    assert ArenaConfig(num_agents=3, move_period=(2, 1, 2)).types == ((0, 2), (1,))


@pytest.mark.parametrize("network", ["mlp", "cnn", "goals"])
def test_robots_of_a_type_act_as_with_actors_of_their_own_that_are_equal(network, tmp_path):
    by_type = PolicyConfig(TEAM, NETWORKS[network], by_type=True)
    policy = Policy(by_type, by_type.make_actors())
    for parameter in policy.parameters():  # away from the nearly uniform start
        torch.nn.init.normal_(parameter, std=0.5)
    each = replace(by_type, by_type=False)
    equal = Policy(each, each.make_actors())
    equal.init_from(policy)
    loaded = load_policy(save_policy(policy, tmp_path / "team.safetensors"))
    assert (len(policy.actors), len(equal.actors), len(loaded.actors)) == (2, 4, 2)
    config = run(network)
    actors = Trainer(config).policy.team
    create = partial(make_training_env, config)
    batch = next(iter(make_collector(create, actors, config.num_envs, config.rollout_steps)))
    step = batch[:, -1].exclude("next")
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        found, *others = (
            one.team(step.clone())["agents", "action"] for one in (policy, equal, loaded)
        )
    assert all(torch.equal(found, other) for other in others)
    assert policy.actor_of(3) is policy.actor_of(0)
    assert policy.actor_of(2) is policy.actor_of(1)


@pytest.mark.parametrize("network", ["mlp", "goals"])
def test_happo_updates_an_actor_per_type_in_turn(network):
    trainer = Trainer(run(network, actor_lr=1e-2))
    (learner,) = trainer.learners.values()
    assert learner.loss.views == {"type_0": ("agents", (0, 3)), "type_1": ("agents", (1, 2))}
    before = {name: value.clone() for name, value in trainer.policy.named_parameters()}
    (metrics,) = [next(trainer.run())]
    assert metrics["factor_ess"] < 1
    moved = {
        name for name, value in trainer.policy.named_parameters() if not value.equal(before[name])
    }
    assert {name.split(".")[3] for name in moved} == {"0", "1"}


@pytest.mark.parametrize(
    "settings", [{"algorithm": "mappo"}, {"algorithm": "ippo"}, {"arena": ArenaConfig()}]
)
def test_actors_of_types_need_happo_and_types(settings):
    with pytest.raises(ValueError, match="actors='type' is not allowed: .* robots that differ"):
        replace(run(), **settings)


def test_the_order_of_updates_is_for_happo():
    assert run(update_order="simultaneous").update_order == "simultaneous"
    with pytest.raises(ValueError, match="update_order='fixed' is not allowed: only happo"):
        replace(run(), algorithm="mappo", actors="robot", update_order="fixed")


def test_simultaneous_updates_have_no_factor():
    (metrics,) = [next(Trainer(run(update_order="simultaneous", actor_lr=1e-2)).run())]
    assert (metrics["factor_ess"], metrics["factor_max"]) == (1, 1)
