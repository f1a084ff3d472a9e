"""What single robots observe in a step of an environment, as robots have it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from tensordict import TensorDictBase

from marl_explore.config.constants import NUM_DIRECTIONS, NUM_FEATURES
from marl_explore.robot.observation import Observation


def robot_observation(tensordict: TensorDictBase, arena: int, robot: int) -> Observation:
    """What one robot observes in a step of an environment, as robots have it.

    Args:
        tensordict: as for ``robot_observations``.
        arena: index in the batch.
        robot: its number.
    """
    return robot_observations(tensordict)(arena, robot)


def robot_observations(tensordict: TensorDictBase) -> Callable[[int, int], Observation]:
    """What robots observe in a step of an environment: a function of arena and robot.

    The arrays of an observation are views of the environment's tensors, where those are on the CPU.

    Args:
        tensordict: with the entries of ``ExplorationEnv``, batch [B]; FPR and NET are 0 where it
            does not have them. Without a memory (``RememberTeam``) ``refused`` is of the last step
            alone, which robots that move every few steps have to remember until their turn.
    """
    team = tensordict.get("agents").cpu()
    cells = [[tuple(cell) for cell in row] for row in team.get("position").tolist()]
    steps = tensordict.get("step_count").flatten().tolist()
    own = ("action_mask", "map", "unshared", "steps_since_merge", "linked")
    entries = {name: team.get(name).numpy() for name in own}
    entries["refused"] = team.get(("memory", "refused"), team.get("dangerous")).numpy()
    entries["fov"] = team.get(("observation", "fov")).numpy()
    batch, robots = len(cells), len(cells[0])
    for name, shape in {"fpr": (NUM_DIRECTIONS, NUM_FEATURES), "net": (robots,)}.items():
        feature = team.get(("observation", name), None)
        absent = np.zeros((batch, robots, *shape), np.float32)
        entries[name] = absent if feature is None else feature.numpy()

    def observation(arena: int, robot: int) -> Observation:
        seen = {name: entry[arena, robot] for name, entry in entries.items()}
        linked, refused = seen.pop("linked").nonzero()[0].tolist(), seen.pop("refused")
        return Observation(
            position=cells[arena][robot],
            step=steps[arena],
            mates={mate: cells[arena][mate] for mate in linked if mate != robot},
            refused=bool(refused),
            **seen,
        )

    return observation
