"""Actors that choose among goals: sets of choices, the prior, and what stands behind a choice."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from marl_explore import ArenaConfig, ExplorationEnv, Goals, evaluate, make_env
from marl_explore.config.constants import (
    CONTEXT_COLUMNS,
    FORBIDDEN_LOGIT,
    GOAL_COLUMNS,
    MATE_COLUMNS,
    MAX_FRONTIERS,
)
from marl_explore.config.goals import PRIOR
from marl_explore.core.grid import COMMUNICATE, NUM_DIRECTIONS, STAY
from marl_explore.evaluation.episodes import play
from marl_explore.evaluation.registry import find_policy
from marl_explore.planners import GoalUtility
from marl_explore.planners.goal_utility import place_terms
from marl_explore.policies.actors import CHOICE
from marl_explore.policies.argmax import ArgmaxPolicy
from marl_explore.policies.io import load_policy, save_policy
from marl_explore.policies.policy import Policy, PolicyConfig
from marl_explore.transforms.goals import Candidates
from marl_explore.transforms.memory import GOAL, REFUSED
from tests.helpers.situations import beyond_robot_0

ROBOTS = 3
ARENA = ArenaConfig(num_agents=ROBOTS, height=9, width=10)


def a_policy(arena=ARENA, trained=True, **options):
    torch.manual_seed(0)
    spec = PolicyConfig(arena, Goals(code_width=8, pair_width=4, **options), shared=True)
    policy = Policy(spec, spec.make_actors())
    if trained:  # as if: far from its prior
        for parameter in policy.parameters():
            parameter.data += torch.randn_like(parameter) / 2
    return policy


def episode(policy=None, arena=ARENA, steps=30, **task):
    env = make_env(arena, num_envs=6, features=("fov", *Candidates._fields), **task)
    return env.rollout(steps, (policy or a_policy()).team, break_when_any_done=False)


def rows_of(history, robot=0):
    """What one robot could choose from, in every step."""
    found = history["agents", "observation"]
    return Candidates(*(found[name][:, :, robot].flatten(0, 1) for name in Candidates._fields))


def test_the_order_of_candidates_does_not_matter():
    actor, rows = a_policy().actors[0], rows_of(episode())
    order = torch.randperm(MAX_FRONTIERS)
    shuffled = rows._replace(frontiers=rows.frontiers[:, order], rivals=rows.rivals[:, order])
    logits, moved = actor(*rows), actor(*shuffled)
    assert_close(moved[:, :MAX_FRONTIERS], logits[:, :MAX_FRONTIERS][:, order])
    assert_close(moved[:, MAX_FRONTIERS:], logits[:, MAX_FRONTIERS:])


def test_the_order_of_teammates_does_not_matter():
    actor, rows = a_policy().actors[0], rows_of(episode())
    order = torch.tensor([0, 2, 1])
    shuffled = rows._replace(rivals=rows.rivals[:, :, order], mates=rows.mates[:, order])
    logits, moved = actor(*rows), actor(*shuffled)
    mates = slice(MAX_FRONTIERS, MAX_FRONTIERS + ROBOTS)
    assert_close(moved[:, mates], logits[:, mates][:, order])
    assert_close(moved[:, :MAX_FRONTIERS], logits[:, :MAX_FRONTIERS])


def test_only_choices_are_chosen():
    """Over whole episodes, in which every kind of choice occurs."""
    history = episode(steps=120, arena=ARENA)
    choice, found = history[CHOICE], history["agents", "observation"]
    filled = found["frontiers"][..., GOAL_COLUMNS.index("moves")] > 0
    context = dict(zip(CONTEXT_COLUMNS, found["context"].unbind(-1), strict=True))
    mates = dict(zip(MATE_COLUMNS, found["mates"].unbind(-1), strict=True))
    visits = (mates["moves"] > 0) & (mates["linked"] == 0) & (context["all_covered"] > 0)[..., None]
    nowhere = ~(filled.any(-1) | visits.any(-1))
    on_time = (context["step"] % 3 == 0) & ((mates["since"] * mates["linked"]).amax(-1) >= 4)
    talks = (context["may_communicate"] > 0) & (
        on_time | (mates["since"].amax(-1) >= 8) | (nowhere & (context["all_covered"] > 0))
    )
    chosen_frontier = choice < MAX_FRONTIERS
    index = choice.clamp_max(MAX_FRONTIERS - 1)[..., None]
    assert filled.gather(-1, index).squeeze(-1)[chosen_frontier].all()
    assert talks[choice == MAX_FRONTIERS + ROBOTS].all()
    assert (nowhere & ~talks)[choice == MAX_FRONTIERS + ROBOTS + 1].all()
    assert chosen_frontier.any()
    assert (choice == MAX_FRONTIERS + ROBOTS).any()
    assert (choice == MAX_FRONTIERS + ROBOTS + 1).any()


def test_a_choice_is_a_place_and_the_first_move_to_it():
    history = episode()
    choice, action = history[CHOICE], history["agents", "action"]
    mask, refused = (history["agents", key] for key in ("action_mask", "dangerous"))
    table = history["agents", "observation", "frontiers"]
    place = choice < MAX_FRONTIERS
    row = table.gather(-2, choice.clamp_max(23)[..., None, None].expand(*choice.shape, 1, 14))
    row = row.squeeze(-2)
    move = row[..., GOAL_COLUMNS.index("move")]
    free = mask.gather(-1, move[..., None].long()).squeeze(-1) & ~refused
    assert action[place & free].equal(move[place & free].long())
    assert history[GOAL][place].equal(row[..., :2][place].long())
    assert (action[choice == MAX_FRONTIERS + ROBOTS] == COMMUNICATE).all()
    assert (action[choice == MAX_FRONTIERS + ROBOTS + 1] == STAY).all()


def test_after_a_refused_move_a_robot_yields():
    env = make_env(ARENA, num_envs=1, features=("fov", *Candidates._fields))
    step = env.reset().expand(200).clone()
    step[REFUSED][:, 0] = True
    acted = a_policy(trained=False, prior=100.0).team(step)
    allowed = step["agents", "action_mask"][0, 0, : STAY + 1].nonzero().flatten().tolist()
    assert set(acted["agents", "action"][:, 0].tolist()) == set(allowed)
    assert len(set(acted["agents", "action"][:, 1].tolist())) == 1


@pytest.mark.parametrize("likeliest", [False, True])
@pytest.mark.parametrize(("period", "yields"), [(2, True), (1, False)])
def test_a_slow_robot_yields_when_it_is_its_turn_again(period, yields, likeliest):
    """Its move at step 0 was refused, it could not move at step 1, and it yields at step 2."""
    config = replace(ARENA, move_period=period)
    policy = a_policy(trained=False, prior=100.0).in_world(config)
    team = ArgmaxPolicy(policy) if likeliest else policy
    env = make_env(config, num_envs=1, features=("fov",))
    step = env.reset().expand(200).clone()
    for now in range(3):
        step["step_count"].fill_(now)
        step["agents", "dangerous"].fill_(now == 1)
        acted = team(step.clone())["agents", "action"]
    allowed = step["agents", "action_mask"][0, 0, : STAY + 1].nonzero().flatten().tolist()
    assert len(allowed) > 2
    assert (set(acted[:, 0].tolist()) == set(allowed)) == yields


def test_periods_of_another_team_are_refused_until_the_policy_is_told_of_its_world():
    policy = a_policy(replace(ARENA, move_period=(1, 2, 2)), trained=False)
    other = replace(ARENA, num_agents=5, move_period=(1, 1, 2, 2, 3))
    start = ExplorationEnv(other, num_envs=2).reset()
    with pytest.raises(ValueError, match=r"move_period=\(1, 2, 2\).* 5 robots: Policy.in_world"):
        policy(start)
    assert policy.in_world(other)(start)["agents", "action"].shape == (2, 5)


def test_an_untrained_actor_acts_as_the_planner():
    """Moves and exchanges, over whole episodes, wherever neither has to yield.

    When it communicates, the planner also chooses a place, so their last goals differ at times.
    """
    actor = ArgmaxPolicy(a_policy(trained=False, prior=100.0, communicate_every=1000))
    planner = GoalUtility(ARENA.sight, PRIOR)
    alike = number = exchanges = 0
    env = ExplorationEnv(ARENA, num_envs=16)
    now = env.reset()
    for _ in range(40):
        planned = planner(now.clone())["agents", "action"]
        acted = actor(now.clone())["agents", "action"]
        mask = now["agents", "action_mask"]
        wanted = mask.gather(-1, planned.unsqueeze(-1)).squeeze(-1) & ~now["agents", "dangerous"]
        yields = now["agents", "dangerous"] | ((planned < NUM_DIRECTIONS) & ~wanted)
        alike += (acted == planned)[~yields].sum()
        number += (~yields).sum()
        exchanges += (acted == COMMUNICATE).sum()
        now = env.step(now.set(("agents", "action"), acted))["next"]
    assert number > 0.8 * 40 * 16 * ROBOTS
    assert alike > 0.98 * number
    assert exchanges > 100


def test_shares_are_those_of_each_robots_own_sensor():
    """A square of radius 1 beside a disc of radius 3, which has 29 cells."""
    found = rows_of(episode(steps=1))
    found = Candidates(*(torch.zeros_like(entry[:2]) for entry in found))
    gains = {"near_gain": 9, "middle_gain": 13, "far_gain": 25, "move_gain": 3, "from_last_goal": 2}
    for name, value in gains.items():
        found.frontiers[..., GOAL_COLUMNS.index(name)] = value
    sensors = {"radius": (1, 3), "shape_cells": (9, 29)}
    for name, values in sensors.items():
        found.context[..., CONTEXT_COLUMNS.index(name)] = torch.tensor(values)
    near, middle, far, last, move = place_terms(found)[:, 0, [2, 3, 4, 8, 10]].unbind(-1)
    assert_close(near, torch.tensor([9 / 9, 9 / 29]))
    assert_close(middle, torch.tensor([13 / 5**2, 13 / 13**2]))
    assert_close(far, torch.tensor([25 / 9**2, 25 / 25**2]))
    assert_close(move, torch.tensor([3 / 9, 3 / 29]))
    assert last.tolist() == [0, 1]


def test_in_larger_arenas_than_those_of_training_the_utility_says_more():
    rows = rows_of(episode())
    logits = {}
    for prior, home_cells in ((0.0, 30), (2.0, 30), (6.0, 90), (2.0, 90), (2.0, 91)):
        policy = a_policy(prior=prior, home_cells=home_cells)  # the arena has 90 cells
        policy.actors[0].prior.data.fill_(prior)
        logits[prior, home_cells] = policy.actors[0](*rows)
    assert_close(logits[2.0, 30], logits[6.0, 90])
    assert_close(logits[2.0, 90], logits[2.0, 91])
    choices = logits[0.0, 30] > FORBIDDEN_LOGIT / 2
    assert logits[0.0, 30][choices].abs().max() > 1
    assert not torch.allclose(logits[2.0, 30], logits[2.0, 90])


def test_impossible_choices_have_the_forbidden_logit():
    logits = a_policy().actors[0](*rows_of(episode()))
    assert (logits == FORBIDDEN_LOGIT).any()
    assert logits.isfinite().all()
    assert (logits > FORBIDDEN_LOGIT / 2).any(-1).all()  # there is always a choice


@pytest.mark.parametrize(("robots", "height", "width"), [(1, 5, 9), (2, 12, 12), (6, 20, 7)])
def test_one_actor_works_for_any_team_in_any_arena(robots, height, width):
    arena = ArenaConfig(num_agents=robots, height=height, width=width)
    result = evaluate(ArgmaxPolicy(a_policy(trained=False)), arena, num_arenas=6, steps=150)
    assert result["complete"] == 1


@pytest.mark.parametrize(
    "settings",
    [
        {"sensing_range": 3.0, "sensing_shape": "disc", "line_of_sight": True, "num_agents": 2},
        {"sensing_range": (1.1, 2.0), "move_period": (1, 2), "num_agents": 2},
        {"line_of_sight": True, "message_loss": 0.3, "num_walkers": 2, "num_agents": 5},
    ],
    ids=["lidars", "robots that differ", "the same square, but not through obstacles"],
)
def test_one_actor_works_with_any_sensor(settings):
    """Its features are those of the sensors that there are, whatever it was trained with."""
    arena = ArenaConfig(height=9, width=10, **settings)
    policy, born_there = a_policy(), a_policy(arena)
    born_there.init_from(policy)
    here = policy.in_world(arena)
    assert here.actors[0] is policy.actors[0]
    env = make_env(arena, num_envs=4, features=())
    for number, td in enumerate(play(ArgmaxPolicy(policy), env.base_env, 20)):
        torch.manual_seed(number)
        expected = born_there(td.clone())["agents", "action"]
        torch.manual_seed(number)
        assert here(td.clone())["agents", "action"].equal(expected)
    assert evaluate(policy, arena, num_arenas=4, steps=200)["complete"] == 1


def test_robots_have_the_actors_that_they_need():
    """One each, or one of their type."""
    own = PolicyConfig(ARENA, Goals(code_width=8, pair_width=4))
    with pytest.raises(ValueError, match="the policy has 3 actors, and the team 2 robots"):
        Policy(own, own.make_actors()).in_world(ArenaConfig(num_agents=2))
    mixed = ArenaConfig(num_agents=3, sensing_range=(1.1, 2.0, 2.0))
    by_type = PolicyConfig(mixed, own.network, by_type=True)
    policy = Policy(by_type, by_type.make_actors())
    larger = ArenaConfig(num_agents=5, sensing_range=(1.1, 2.0, 2.0, 2.0, 2.0))
    assert policy.in_world(larger).config.groups == ((0,), (1, 2, 3, 4))
    with pytest.raises(ValueError, match="has 2 actors, and the team 1 types of robots"):
        policy.in_world(ARENA)


def test_a_policy_of_another_world_says_how_it_gets_into_this_one():
    env = ExplorationEnv(ArenaConfig(num_agents=3, sensing_range=2.0))
    with pytest.raises(ValueError, match=r"fov_radius=1, .* 5 x 5 cells: Policy.in_world is for"):
        a_policy()(env.reset())


def test_robots_that_read_their_sensor_differ_by_it():
    arena = ArenaConfig(num_agents=3, sensing_range=(1.1, 2.0, 2.0))
    for reads in (False, True):
        policy = a_policy(arena, reads_sensor=reads)
        scale = policy.actors[0].encoder.features
        own = scale(rows_of(episode(policy, arena))).context[:, 10:]
        assert own.shape[1] == 2 * reads
        if reads:
            assert own.unique(dim=0).tolist() == [pytest.approx([1 / 5, 9 / 73])]
            other = scale(rows_of(episode(policy, arena), robot=1)).context[:, 10:]
            assert other.unique(dim=0).tolist() == [pytest.approx([2 / 6, 25 / 89])]


def test_its_own_most_likely_choices_need_no_sampling():
    """An argmax policy acts the same each time; only the yield rule draws random numbers."""
    policy, arena = ArgmaxPolicy(a_policy()), ArenaConfig(num_agents=1, height=9, width=10)
    histories = []
    for seed in (0, 1):
        torch.manual_seed(seed)
        env = ExplorationEnv(arena, num_envs=4)
        histories.append(env.rollout(30, policy)["agents", "action"])
    assert histories[0].equal(histories[1])


def test_a_saved_policy_keeps_the_prior_it_was_trained_with(tmp_path):
    policy = a_policy()
    policy.actors[0].encoder.features.weights[0] = (
        0.7  # as if the planner's weights had been others
    )
    path = tmp_path / "policy.safetensors"
    save_policy(policy, path)
    loaded = load_policy(path)
    assert loaded.actors[0].encoder.features.weights[0] == pytest.approx(0.7)
    rows = rows_of(episode())
    assert loaded.actors[0](*rows).equal(policy.actors[0](*rows))
    assert isinstance(find_policy(f"{path}:argmax", ARENA), ArgmaxPolicy)


def test_a_robot_decides_by_what_it_can_know():
    """The truth, others' maps and memories, and where robots out of range are, change nothing."""
    history = ExplorationEnv(ARENA, num_envs=8, stream="test").rollout(13)
    policy, ignorant = (ArgmaxPolicy(a_policy()) for _ in range(2))
    moved = 0
    for step in history.unbind(1):
        torch.manual_seed(1)
        action = policy(step.clone())["agents", "action"][:, 0]
        changed, hidden = beyond_robot_0(step)
        moved += hidden
        torch.manual_seed(1)
        assert ignorant(changed)["agents", "action"][:, 0].equal(action)
    assert moved
