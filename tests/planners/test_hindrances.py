"""Planners in wider worlds: what is on no map, lost messages, turns, and teams that die out."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import step_mdp

from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.arenas.rooms import Rooms
from marl_explore.core.grid import COMMUNICATE, NUM_DIRECTIONS, STAY
from marl_explore.core.mapping import finishable, target_cells, union_of
from marl_explore.planners import PLANNERS, FrontierAssignment, NearestFrontier, PairTimer, never
from marl_explore.planners.assignment import UtilityCost
from marl_explore.planners.hindrances import (
    ATTEMPTS,
    KEPT_STEPS,
    LostMessages,
    Obstructions,
    Turns,
)
from tests.helpers.situations import knowing, names, on_board

EXPLORERS = sorted(set(PLANNERS) - {"random"})
MORTAL = {"failure_rate": 1e-9}
"""Robots may fail, but hardly do."""


def with_dead(env, td, *dead):
    """The first observation of the arenas in which some robots have failed."""
    alive = torch.ones_like(td["agents", "alive"])
    alive[:, list(dead)] = False
    start = TensorDict({"obstacles": td["obstacles"]}, td.batch_size)
    start["agents"] = {"position": td["agents", "position"], "alive": alive}
    return env.reset(start, set_state=True)


def occupied(maps, robot=0):
    """Cells of one robot's map that are occupied."""
    return [tuple(cell) for cell in (maps[0, robot] == 1).nonzero().tolist()]


# ------------------------------------------------------------------------- what is on no map


def test_a_robot_that_failed_is_an_obstacle_until_its_cell_is_seen_free():
    env, td = on_board("01...\n.....", 2, 5, **MORTAL)
    seen = Obstructions(env.config.sight)
    linked = td.clone()
    assert occupied(seen.maps(linked)) == []  # a linked robot is none
    dead = with_dead(env, td, 1)
    assert occupied(seen.maps(dead)) == [(0, 1)]
    dead["step_count"] += 1
    dead["agents", "observation", "fov"][0, 0, 1, 2] = 0
    assert occupied(seen.maps(dead)) == []


def test_what_is_out_of_sight_is_forgotten_after_a_while_and_later_if_it_was_met_again():
    env, td = on_board("0.1.......", 1, 10, **MORTAL)
    seen = Obstructions(env.config.sight)
    td = with_dead(env, td, 1)
    free = "." * 10
    away = knowing(td, free, free)
    near = away.clone()
    near["agents", "position"][0, 0] = torch.tensor([0, 1])
    near["agents", "observation", "fov"][0, 0] = torch.tensor([[1, 1, 1], [0, 0, 1], [1, 1, 1.0]])
    away["agents", "position"][0, 0] = torch.tensor([0, 6])
    away["agents", "observation", "fov"][0, 0] = torch.tensor([[1, 1, 1], [0, 0, 0], [1, 1, 1.0]])

    def at(time, td):
        td["step_count"].fill_(time)
        return occupied(seen.maps(td))

    assert at(0, near) == [(0, 2)]
    assert at(KEPT_STEPS - 1, away) == [(0, 2)]
    assert at(KEPT_STEPS, away) == []
    assert at(KEPT_STEPS + 8, near) == [(0, 2)]
    assert at(3 * KEPT_STEPS, away) == [(0, 2)]
    assert at(3 * KEPT_STEPS + 16, away) == []
    assert at(0, away) == []  # another episode


def test_cells_that_are_out_of_sight_are_no_obstructions():
    """They read 1 like robots, also when they have been seen from elsewhere."""
    board = ".....\n.0#..\n.....\n.....\n....."
    settings = {"sensing_range": 1.5, "sensing_shape": "disc", "line_of_sight": True}
    env, td = on_board(board, 5, 5, **settings, **MORTAL)
    known = knowing(td, board.replace("0", "."))
    assert (known["agents", "observation", "fov"][0, 0] == 1).sum() > 8
    assert occupied(Obstructions(env.config.sight).maps(known)) == [(1, 2)]


def test_a_robot_that_is_shut_in_goes_to_what_shuts_it_in():
    env, td = on_board("0.1..", 1, 5, **MORTAL)
    td = knowing(with_dead(env, td, 1), "....?", "?????")
    td["agents", "position"][0, 0] = torch.tensor([0, 1])
    td["agents", "observation", "fov"][0, 0, 1] = torch.tensor([0, 0, 1.0])
    td["agents", "action_mask"][0, 0, 2] = False
    td["agents", "action_mask"][0, 0, 6] = True
    planner = NearestFrontier(never, env.config)
    assert planner.plan(planner._hindrances.seen(td)).tolist()[0][0] == 2
    assert set(planner(td.expand(50).clone())["agents", "action"][:, 0].tolist()) == {6, STAY}


def test_robots_drive_around_one_that_failed():
    """The way around it is the only one that leads on."""
    env, td = on_board("....\n012.\n....", 3, 4, **MORTAL)
    td = with_dead(env, td, 1)
    td = knowing(td, "...#\n....\n...?", "????\n????\n????", "????\n????\n????")
    auction = FrontierAssignment(never, UtilityCost(), env.config)
    for planner in (NearestFrontier(never, env.config), auction):
        assert names(planner(td.clone())["agents", "action"])[0] == "SE"
    without = NearestFrontier(never).plan(td)
    assert names(without)[0] == "E"


# ------------------------------------------------------------------------------ lost messages


def test_robots_whose_messages_are_lost_explore_alone_for_longer_and_longer():
    env, td = on_board("0.1.....", 1, 8, message_loss=1.0)
    messages, lonely = LostMessages(), []
    for _ in range(40):
        lonely.append(bool(messages.alone(td)[0, 0]))
        action = torch.full((1, 2), STAY if lonely[-1] else COMMUNICATE)
        messages.note(action)
        td = step_mdp(env.step(td.set(("agents", "action"), action)))
    tries = [False] * ATTEMPTS
    assert lonely[:30] == tries + [True] * 8 + tries + [True] * 16
    messages.note(torch.full((1, 2), COMMUNICATE))
    assert not messages.alone(td.set("step_count", torch.tensor([[0]]))).any()


def test_a_robot_that_is_alone_acts_as_without_links():
    env, td = on_board("0.1.....", 1, 8, message_loss=1.0)
    planner, talks = NearestFrontier(PairTimer(1), env.config), []
    for _ in range(ATTEMPTS + 8):
        td = planner(td)
        talks.append((td["agents", "action"] == COMMUNICATE).any().item())
        td = step_mdp(env.step(td))
    assert talks == [True] * ATTEMPTS + [False] * 8


# -------------------------------------------------------------------------------------- turns


def test_a_refusal_is_kept_until_the_robot_may_move():
    env, td = on_board("0.1.....", 1, 8, move_period=(3, 1))
    turns, refused = Turns(env.config.move_period), []
    for time in range(8):
        td["step_count"].fill_(time)
        td["agents", "dangerous"] = torch.tensor([[time == 1, time == 1]])
        turns.only(torch.tensor([0]))
        refused.append(turns.refused(td)[0].tolist())
    first, second = zip(*refused, strict=True)
    assert first == (False, True, True, True, False, False, False, False)
    assert second == (False, True, False, False, False, False, False, False)


@pytest.mark.parametrize("period", [2, (1, 2, 3)])
@pytest.mark.parametrize("name", EXPLORERS)
def test_planners_wait_for_their_turn(name, period):
    config = ArenaConfig(num_agents=3, height=8, width=8, move_period=period)
    td = ExplorationEnv(config, num_envs=8).rollout(12, PLANNERS[name](config))
    action = td["agents", "action"]
    assert td["agents", "action_mask"].gather(-1, action.unsqueeze(-1)).all()
    moves = (action < NUM_DIRECTIONS).any(0).any(0)
    assert moves.all()


def test_rendezvous_does_not_answer_one_that_waits_for_its_turn():
    env, td = on_board("0....1........", 1, 14, move_period=(1, 2))
    planner = PLANNERS["rendezvous"](env.config)
    planner.communicate = never
    talks = []
    for time in range(1, 5):
        td["step_count"].fill_(time)
        talks.append(names(planner.plan(td))[0] == "talk")
    # robot 1 could have moved at times 2 and 4, which is seen at 3 and 5
    assert talks == [False, False, True, False]


# ------------------------------------------------------------------------------ to the end

SMALL = {"height": 9, "width": 9, "num_agents": 3}
ROOMS = ArenaConfig(
    height=14,
    width=14,
    num_agents=3,
    obstacle_density=0.15,
    sensing_range=2.0,
    sensing_shape="disc",
    line_of_sight=True,
    communication_range=5.0,
    wall_loss_db=math.inf,
    num_walkers=3,
)
WORLDS = {
    "one is left": (ArenaConfig(**SMALL, **MORTAL), "uniform", 150),
    "no message arrives": (ArenaConfig(**SMALL, message_loss=1.0), "uniform", 200),
    "nobody is ever linked": (ArenaConfig(**SMALL, communication_range=0.0), "uniform", 200),
    "rooms with people": (ROOMS, Rooms(ROOMS, starts="clustered"), 300),
    "different turns": (ArenaConfig(**SMALL, move_period=(1, 2, 3)), "uniform", 200),
}


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("name", EXPLORERS)
def test_some_living_robot_completes_its_map(name, world):
    config, arenas, most = WORLDS[world]
    env = ExplorationEnv(config, num_envs=6, arenas=arenas, stream="validation", max_steps=most + 1)
    td = env.reset()
    if world == "one is left":
        td = with_dead(env, td, 0, 2)
    planner = PLANNERS[name](config)
    shares = getattr(planner, "shares_maps", False)
    start = td
    target = target_cells(td["obstacles"], td["agents", "position"])
    torch.manual_seed(0)
    done = torch.zeros(6, dtype=torch.bool)
    for _ in range(most):
        alive, grid = td["agents", "alive"], td["agents", "map"]
        maps = union_of(grid, alive).unsqueeze(1) if shares else grid
        complete = ((maps != -1) | ~target.unsqueeze(1)).flatten(2).all(-1)
        done |= (complete if shares else complete & alive).any(-1)
        if done.all():
            return
        td = step_mdp(env.step(planner(td)))
    can = finishable(start["obstacles"], td["agents", "position"], alive, grid, target)
    assert (done | ~can).all()
    assert can.sum() >= 4
