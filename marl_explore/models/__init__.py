"""Networks: the paper's actors and critics, an actor for any team, and a critic on the state.

Networks are plain modules on parts of the observation, which an actor names in ``inputs``: for the
paper's float [*B, 2k+1, 2k+1], [*B, 8, 3], [*B, N] (FOV, FPR, NET), and the same with a robot axis
after ``*B`` for a critic. What they return is float32, also under autocast: losses are computed in
full precision.
"""

from __future__ import annotations

from collections.abc import Sequence

from tensordict.nn import TensorDictModule
from torch import nn

from marl_explore.config import Ability, Architecture, ArenaConfig, CriticInput
from marl_explore.models.ablation import Ablated
from marl_explore.models.deepset import DeepSetActor
from marl_explore.models.inputs import (
    OBSERVATION_KEYS,
    PAPER_INPUTS,
    by_robot,
    in_a_row,
    observation_keys,
    robots_first,
)
from marl_explore.models.layers import mlp
from marl_explore.models.paper import CNNActor, CNNCritic, CNNEncoder, MLPActor, MLPCritic
from marl_explore.models.state import STATE_KEYS, StateCritic

__all__ = [
    "OBSERVATION_KEYS",
    "PAPER_INPUTS",
    "STATE_KEYS",
    "Ablated",
    "CNNActor",
    "CNNCritic",
    "CNNEncoder",
    "DeepSetActor",
    "MLPActor",
    "MLPCritic",
    "StateCritic",
    "by_robot",
    "in_a_row",
    "make_actor",
    "make_critic",
    "mlp",
    "observation_keys",
    "robots_first",
]


def make_actor(
    config: ArenaConfig,
    architecture: Architecture,
    hidden: Sequence[int],
    norm_last: bool = False,
    without: Sequence[Ability] = (),
    communicate_every: int = 1,
    communicate_after: int = 0,
) -> nn.Module:
    """One robot's actor network; of ``hidden`` a CNN uses the last width."""
    actor: nn.Module
    if architecture == "mlp":
        actor = MLPActor(config, hidden, norm_last)
    elif architecture == "cnn":
        actor = CNNActor(config, hidden[-1])
    else:
        actor = DeepSetActor(
            config,
            hidden,
            norm_last,
            communicate_every=communicate_every,
            communicate_after=communicate_after,
        )
    return Ablated(actor, without) if without else actor


def make_critic(
    config: ArenaConfig,
    architecture: Architecture,
    hidden: Sequence[int],
    reads: CriticInput,
    norm_last: bool = False,
    robot: int | None = None,
) -> TensorDictModule:
    """A critic, writing "state_value" [*B, 1].

    Args:
        config: the arena.
        architecture: of a critic that reads observations.
        hidden: widths; a CNN uses the last one.
        reads: the observations or the true state.
        norm_last: whether the last hidden layer of an MLP is normalised too.
        robot: the only one whose observation it reads; None: those of all.
    """
    if reads == "state":
        return TensorDictModule(StateCritic(config, hidden, norm_last), STATE_KEYS, ["state_value"])
    critic = (
        MLPCritic(config, hidden, norm_last, robot)
        if architecture == "mlp"
        else CNNCritic(config, hidden[-1], robot=robot)
    )
    return TensorDictModule(critic, OBSERVATION_KEYS, ["state_value"])
