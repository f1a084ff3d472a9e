"""Drawn situations for planners."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.core.links import within_range
from tests.helpers.boards import ACTIONS, arena, map_cells


def on_board(board, height, width, **settings):
    """An env of one drawn arena, and its first observation."""
    obstacles, position = arena(board)
    config = ArenaConfig(height=height, width=width, num_agents=len(position), **settings)
    env = ExplorationEnv(config, num_envs=1)
    start = TensorDict({"obstacles": obstacles.unsqueeze(0)}, [1])
    start.set(("agents", "position"), position.unsqueeze(0))
    return env, env.reset(start, set_state=True)


def knowing(td, *boards):
    """The observation with other maps, one drawing per robot."""
    td = td.clone()
    td["agents", "map"] = torch.stack([map_cells(board) for board in boards]).unsqueeze(0)
    return td


def placed(env, td, *cells):
    """The observation with the robots in other cells, linked as they are there."""
    td = td.clone()
    td["agents", "position"] = position = torch.tensor([cells])
    td["agents", "linked"] = within_range(position, env.config.communication_cells)
    return td


def names(action):
    """Actions of a single arena by name."""
    return [ACTIONS[index] for index in action.flatten().tolist()]


def beyond_robot_0(step, config):
    """An observation in which all that robot 0 cannot know is different.

    That is the truth, the others' maps and memories, their links and failures, what will happen,
    people, and where robots are to which it is not linked: in the corner farthest from it. Also
    returns how many of those there are.
    """
    changed = step.clone()
    changed["obstacles"] = ~changed["obstacles"]
    changed["draw_key"] += 1
    if config.num_walkers:
        changed["walkers"] = torch.zeros_like(changed["walkers"])
    for key in ("map", "steps_since_merge", "unshared", "dangerous", "merged"):
        changed["agents", key][:, 1:] = 0
    for key in ("alive", "linked"):
        changed["agents", key][:, 1:] = ~changed["agents", key][:, 1:]
    position = changed["agents", "position"]
    far = ~changed["agents", "linked"][:, 0]
    last = torch.tensor([config.height - 1, config.width - 1])
    hiding = torch.where(2 * position[:, :1] < last + 1, last, 0).expand_as(position)
    position[far] = hiding[far]
    return changed, int(far.sum())
