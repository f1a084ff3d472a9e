"""An exported policy with weights that are drawn, written without torch."""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np

from marl_explore import ArenaConfig
from marl_explore.config.constants import COMMUNICATE
from marl_explore.robot.policy import FORMAT, save_arrays


def policy_file(folder, robots=4, seed=0, talkative=0.0, **arena):
    """An MLP for every robot, FPR by "proximity"; its actions are nearly equally likely.

    ``talkative`` is added to the logit of communicating.
    """
    chance = np.random.default_rng(seed)
    config = ArenaConfig(num_agents=robots, **arena)
    spec = {"format": FORMAT, "arena": asdict(config), "twin": "mlp", "fpr": "proximity"}
    arrays = {}
    inputs = (2 * config.fov_radius + 1) ** 2 + 24 + robots
    for robot in range(robots):
        for name, shape in (("layers.0", (16, inputs)), ("layers.2", (10, 16))):
            weights = (0.1 * chance.normal(size=shape)).astype(np.float32)
            arrays[f"{robot}.actor.{name}.weight"] = weights
            arrays[f"{robot}.actor.{name}.bias"] = np.zeros(shape[0], np.float32)
        arrays[f"{robot}.actor.layers.2.bias"][COMMUNICATE] = talkative
    path = folder / "policy.npz"
    with path.open("wb") as file:
        save_arrays(file, json.dumps(spec | {"ablate": []}), arrays)
    return path
