"""Views, also from an environment's groups, and the policy that the actors make together."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close
from torchrl.envs import ExplorationType, set_exploration_type

from marl_explore import MLP, ArenaConfig, MultiAgentActors, make_env, probabilistic_actor
from marl_explore.happo.loss import HAPPOLoss
from marl_explore.happo.policy import TeamPolicy
from marl_explore.happo.views import views_of
from tests.helpers.happo import (
    FEATURES,
    NAMES,
    ROBOTS,
    VIEWS,
    assert_same_losses,
    continuous_actor,
    drone_network,
    ground_network,
    make_team,
    masked_actor,
    random_mask,
)

MIXED = {"rovers": ["rover_0", "rover_1"], "drone": ["drone"], "wheels": ["left", "right"]}


@pytest.mark.parametrize(
    ("names", "views"),
    [
        (["rover_1", "rover_0"], {"rover_1": ("rovers", 1), "rover_0": ("rovers", 0)}),
        (["rovers"], {}),
        (["drone"], {"drone": ("drone", 0)}),  # an agent in a group of its own
        (["left", "drone", "rovers"], {"left": ("wheels", 0), "drone": ("drone", 0)}),
    ],
)
def test_actors_named_after_agents_or_groups(names, views):
    assert views_of(names, MIXED) == views


def test_an_actor_of_no_agent():
    with pytest.raises(ValueError, match=r"\['rover_2'\] are not in group_map.*'rover_1'"):
        views_of(["rover_0", "rover_2"], MIXED)
    team = make_team()
    actors = {"robot_9": team.loss.actor_losses["robot_0"].actor_network}
    with pytest.raises(ValueError, match="'robot_9'"):
        HAPPOLoss(actors, group_map={"agents": NAMES})


def test_a_group_map_gives_the_loss_of_the_views():
    team = make_team()
    actors = {name: part.actor_network for name, part in team.loss.actor_losses.items()}
    mapped = HAPPOLoss(actors, team.critic, group_map={"agents": NAMES}, clip_epsilon=0.2)
    assert mapped.views == VIEWS
    assert_same_losses(mapped(team.batch), team.loss(team.batch))
    with pytest.raises(ValueError, match="views and group_map"):
        HAPPOLoss(actors, group_map={"agents": NAMES}, views=VIEWS)


def test_an_agent_and_its_group_have_not_both_an_actor():
    actors = {name: masked_actor(ground_network(), "agents") for name in ("agents", "robot_1")}
    with pytest.raises(ValueError, match="'agents' and 'robot_1' both act for"):
        HAPPOLoss(actors, group_map={"agents": NAMES})


# ------------------------------------------------------------ groups of another shape


def test_an_index_beyond_the_group():
    team = make_team()
    loss = HAPPOLoss(
        {"a": masked_actor(ground_network(), "agents")}, views={"a": ("agents", ROBOTS)}
    )
    for call in (loss.actor_loss, loss.update_factor):
        with pytest.raises(
            ValueError, match=rf"\('agents', {ROBOTS}\) does not fit.*more than {ROBOTS} of them"
        ):
            call(team.batch, "a")


@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("observation", lambda x: x.transpose(-1, -2)),  # [*B, F, N]
        ("observation", lambda x: x[:, :, 0]),  # [*B, F]
        ("action", lambda x: x[:, :, 0]),  # [*B]
        ("action_log_prob", lambda x: x[:, :, :2]),
        ("action_mask", lambda x: x[:, :, :1]),
    ],
)
def test_an_axis_of_agents_in_another_place(key, change):
    team = make_team()
    batch = TensorDict({k: v for k, v in team.batch.items() if k != "agents"}, team.batch.shape)
    group = {k: change(v) if k == key else v for k, v in team.batch["agents"].items()}
    batch["agents"] = TensorDict(group, team.batch.shape)
    for call in (team.loss.actor_loss, team.loss.update_factor):
        with pytest.raises(ValueError, match=rf"views\['robot_2'\].*axis.*'{key}'\) \["):
            call(batch, "robot_2")


# ------------------------------------------------------------------------- the policy


def observations(*shape):
    agents = {
        "observation": torch.randn(*shape, 2, FEATURES),
        "action_mask": random_mask(*shape, 2),
    }
    drones = {"observation": torch.randn(*shape, 3, 3)}
    return TensorDict({"rovers": agents, "drones": drones}, shape)


def mixed_loss():
    """Two rovers with an actor each, in the other order; three drones that share one."""
    actors = {
        "rover_1": masked_actor(ground_network(), "rovers"),
        "drones": continuous_actor(drone_network(), "drones"),
        "rover_0": masked_actor(ground_network(), "rovers"),
    }
    groups = {"rovers": ["rover_0", "rover_1"], "drones": ["drone_0", "drone_1", "drone_2"]}
    return HAPPOLoss(actors, group_map=groups)


@pytest.mark.parametrize("shape", [(), (7,), (4, 5)])
def test_every_actor_acts_for_its_agent(shape):
    loss, batch = mixed_loss(), observations(*shape)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        assert loss.make_policy()(batch) is batch
        for index, name in enumerate(("rover_0", "rover_1")):
            rovers = {k: v.select(len(shape), index) for k, v in batch["rovers"].items()}
            own = {k: rovers[k] for k in ("observation", "action_mask")}
            alone = loss.actor_losses[name].actor_network(TensorDict({"rovers": own}, shape))
            for key in ("action", "action_log_prob"):
                assert torch.equal(rovers[key], alone["rovers", key])
        drones = loss.actor_losses["drones"].actor_network
        alone = drones(batch.select(("drones", "observation")))
        assert torch.equal(batch["drones", "action"], alone["drones", "action"])
    # what it wrote is what the loss reads, and no actor has moved: every ratio is 1
    for name in loss.names:
        loss.update_factor(batch, name)
    assert_close(batch["factor"], torch.ones(*shape, 1))


def test_its_parameters_are_the_actors_own():
    loss = mixed_loss()
    mine = {id(p) for p in loss.make_policy().parameters()}
    assert mine == {id(p) for p in loss.parameters()}


def test_it_needs_all_agents_of_a_group():
    team = make_team()
    actors = {name: part.actor_network for name, part in team.loss.actor_losses.items()}
    del actors["robot_1"]
    views = {name: VIEWS[name] for name in actors}
    with pytest.raises(ValueError, match=r"every agent of the group 'agents'.*\[0, 2, 3\]"):
        TeamPolicy(actors, views)
    del actors["robot_3"], actors["robot_2"]
    policy = TeamPolicy(actors, {"robot_0": ("agents", 0)})
    with pytest.raises(ValueError, match=r"\[6, 11, 4, .*actors for 1 agents"):
        policy(team.batch)


def test_on_the_exploration_environment_it_acts_as_the_stacked_actors_do():
    arena = ArenaConfig(height=8, width=8, num_agents=3)
    env, same = (make_env(arena, 5, seed=3) for _ in range(2))
    network = MLP(hidden=(16,))
    networks = [network.make_actor(arena) for _ in range(3)]
    names = env.group_map["agents"]
    actors = {n: probabilistic_actor(net) for n, net in zip(names, networks, strict=True)}
    loss = HAPPOLoss(actors, group_map=env.group_map)
    assert loss.views == {name: ("agents", i) for i, name in enumerate(names)}
    stacked = probabilistic_actor(MultiAgentActors(networks))
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        ours, theirs = env.rollout(10, loss.make_policy()), same.rollout(10, stacked)
    assert ours.shape == (5, 10)
    for key in (("agents", "action"), ("agents", "map"), ("next", "reward")):
        assert torch.equal(ours[key], theirs[key]), key
    assert_close(ours["agents", "action_log_prob"], theirs["agents", "action_log_prob"])


# ------------------------------------------------------- several agents, one actor

TYPES = {"scouts": ("agents", (3, 0)), "mappers": ("agents", (1, 2))}


def typed_loss():
    actors = {name: masked_actor(ground_network(), "agents") for name in TYPES}
    return HAPPOLoss(actors, views=TYPES, clip_epsilon=0.2)


def test_agents_of_one_type_act_by_their_actor_in_the_order_of_the_group():
    loss = typed_loss()
    batch = TensorDict(
        {
            "agents": {
                "observation": torch.randn(5, ROBOTS, FEATURES),
                "action_mask": random_mask(5, ROBOTS),
            }
        },
        [5],
    )
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        loss.make_policy()(batch)
        for name, (_, robots) in TYPES.items():
            for robot in robots:
                own = {k: batch["agents", k][:, robot] for k in ("observation", "action_mask")}
                alone = loss.actor_losses[name].actor_network(TensorDict({"agents": own}, [5]))
                for key in ("action", "action_log_prob"):
                    assert_close(batch["agents", key][:, robot], alone["agents", key])


def test_the_objective_of_a_type_is_the_mean_over_its_agents_and_the_factor_their_product():
    team, loss = make_team(), typed_loss()
    batch, advantage = team.batch, team.batch["advantage"]
    ratios = {}
    for name, (_, robots) in TYPES.items():
        network = loss.actor_losses[name].actor_network
        own = {k: batch["agents", k][..., [*robots], :] for k in ("observation", "action_mask")}
        with torch.no_grad():
            dist = network.get_dist(TensorDict({"agents": own}, batch.shape))
            new = dist.log_prob(batch["agents", "action"][..., [*robots]])
        ratios[name] = (new - batch["agents", "action_log_prob"][..., [*robots]]).exp()
        clipped = ratios[name].clamp(0.8, 1.2)
        gains = torch.minimum(ratios[name] * advantage, clipped * advantage)
        assert_close(loss.actor_loss(batch, name)["loss_objective"], -gains.mean())
    for name in TYPES:
        loss.update_factor(batch, name)
    product = torch.cat([*ratios.values()], -1).prod(-1, keepdim=True)
    assert_close(batch["factor"], product)


@pytest.mark.parametrize("indices", [(), (0, 0), (1, -1), (0, True), [0, 1], (0, 1.0)])
def test_indices_that_name_no_agents_once(indices):
    with pytest.raises(ValueError, match=r"views\['a'\]=.* a tuple of different ones"):
        HAPPOLoss({"a": masked_actor(ground_network(), "agents")}, views={"a": ("agents", indices)})


@pytest.mark.parametrize("other", [1, (1,), (2, 1)])
def test_an_agent_has_not_two_actors(other):
    actors = {name: masked_actor(ground_network(), "agents") for name in "ab"}
    with pytest.raises(ValueError, match="'a' and 'b' both act for"):
        HAPPOLoss(actors, views={"a": ("agents", (0, 1)), "b": ("agents", other)})
    HAPPOLoss(actors, views={"a": ("agents", (0, 1)), "b": ("agents", (2, 3))})


def test_types_that_leave_an_agent_out_make_no_policy():
    actors = {name: masked_actor(ground_network(), "agents") for name in "ab"}
    loss = HAPPOLoss(actors, views={"a": ("agents", (0, 2)), "b": ("agents", 3)})
    with pytest.raises(ValueError, match=r"have the indices \[0, 2, 3\]"):
        loss.make_policy()


def test_an_index_of_several_beyond_the_group():
    team = make_team()
    actors = {"a": masked_actor(ground_network(), "agents")}
    loss = HAPPOLoss(actors, views={"a": ("agents", (0, ROBOTS))})
    with pytest.raises(ValueError, match=rf"more than {ROBOTS} of them"):
        loss.actor_loss(team.batch, "a")
