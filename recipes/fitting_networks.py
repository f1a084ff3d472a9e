"""Actors and a critic that fit an environment's specs, for happo_mappo.py.

The environment has one group per agent, each with an "observation" and an "action".
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict.nn import (
    InteractionType,
    NormalParamExtractor,
    TensorDictModule,
    TensorDictSequential,
)
from torch import nn
from torchrl.data import Categorical
from torchrl.envs import EnvBase
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal


def make_actor(env: EnvBase, group: str, hidden: tuple[int, ...]) -> ProbabilisticActor:
    """A policy of one group: categorical or squashed Gaussian, depending on its action space."""
    observation = (group, "observation")
    action = env.full_action_spec[group, "action"]
    kind: dict[str, Any]
    if isinstance(action, Categorical):
        outputs, head, numbers = ["logits"], nn.Identity(), int(action.space.n)
        kind = {"distribution_class": torch.distributions.Categorical}
    else:
        outputs, head, numbers = ["loc", "scale"], NormalParamExtractor(), 2 * action.shape[-1]
        bounds = {"low": action.space.low, "high": action.space.high}
        kwargs = {name: bound.flatten(0, -2)[0] for name, bound in bounds.items()}
        kind = {"distribution_class": TanhNormal, "distribution_kwargs": kwargs}
    network = nn.Sequential(_mlp(env, [group], numbers, hidden), head)
    return ProbabilisticActor(
        TensorDictModule(network, [observation], [(group, name) for name in outputs]),
        in_keys={name: (group, name) for name in outputs},
        out_keys=[(group, "action")],
        return_log_prob=True,
        log_prob_key=(group, "action_log_prob"),
        default_interaction_type=InteractionType.RANDOM,
        **kind,
    )


def make_critic(env: EnvBase, groups: list[str], hidden: tuple[int, ...]) -> TensorDictSequential:
    """A critic of the team, "state_value" [*B, 1], from the observations of all groups."""
    keys = [(group, "observation") for group in groups]
    return TensorDictSequential(
        TensorDictModule(
            lambda *agents: torch.cat([agent.flatten(-2) for agent in agents], -1), keys, ["joint"]
        ),
        TensorDictModule(_mlp(env, groups, 1, hidden), ["joint"], ["state_value"]),
    )


def _mlp(env: EnvBase, groups: list[str], outputs: int, hidden: tuple[int, ...]) -> MLP:
    features = sum(env.observation_spec[group, "observation"].shape[-1] for group in groups)
    return MLP(features, outputs, num_cells=list(hidden), activation_class=nn.Tanh)
