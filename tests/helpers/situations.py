"""Drawn situations for planners."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.core.links import within_range
from marl_explore.evaluation.knowledge import changed_beyond
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


def beyond_robot_0(step):
    """An observation in which all that robot 0 cannot know is different.

    Also returns how many robots are where it cannot know.
    """
    return changed_beyond(step, robot=0), int((~step["agents", "linked"][:, 0]).sum())
