"""Metrics of the team's behaviour in a training batch."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from marl_explore.core.grid import COMMUNICATE, NUM_DIRECTIONS
from marl_explore.core.mapping import known_cells, known_mask, known_targets, target_cells
from marl_explore.core.survivors import largest_of_living


class FinalShares(NamedTuple):
    """What a team knows at the end of an episode, as in docs/metrics.md."""

    final_coverage: Tensor
    final_known_ratio: Tensor


_READ = ("reward", "done", "episode_reward", "step_count", *FinalShares._fields)
METRIC_KEYS: list[NestedKey] = [
    ("agents", "action"),
    *(("next", key) for key in _READ),
    *(("next", "agents", key) for key in ("received", "dangerous")),
]
"""Entries of a rollout that ``rollout_metrics`` reads."""


class FinalKnowledge(Transform):
    """Writes ``FinalShares`` [*B, 1] in the steps that end an episode, and 0 in all others.

    So a batch tells how its episodes ended without the maps of all its steps.
    """

    def __init__(self) -> None:
        super().__init__(out_keys=list(FinalShares._fields))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        zero = torch.zeros((*tensordict_reset.batch_size, 1), device=tensordict_reset.device)
        return tensordict_reset.update({name: zero.clone() for name in FinalShares._fields})

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        ended = next_tensordict["done"].squeeze(-1)
        shares = torch.zeros((len(FinalShares._fields), *ended.shape), device=ended.device)
        if ended.any():
            shares[:, ended] = torch.stack(_known(next_tensordict, ended))
        for name, share in zip(FinalShares._fields, shares.unsqueeze(-1), strict=True):
            next_tensordict.set(name, share)
        return next_tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the two entries."""
        shape = (*observation_spec.shape, 1)
        for name in FinalShares._fields:
            observation_spec[name] = Unbounded(shape, device=observation_spec.device)
        return observation_spec


def _known(step: TensorDictBase, ended: Tensor) -> FinalShares:
    """Of the arenas whose episode ended."""
    agents = step["agents"]
    known = known_mask(agents["map"][ended])
    target = target_cells(step["obstacles"][ended], agents["position"][ended])
    alive = agents["alive"][ended]
    covered = largest_of_living(known_targets(known, target), alive) / target.flatten(-2).sum(-1)
    ratio = largest_of_living(known_cells(known), alive) / target[0].numel()
    return FinalShares(covered, ratio)


def rollout_metrics(batch: TensorDictBase) -> dict[str, float]:
    """Metrics of the team's behaviour in a training batch [B, T] (docs/metrics.md)."""
    following = batch["next"]
    agents, action = following["agents"], batch["agents", "action"]
    communicating = action == COMMUNICATE
    useful = communicating & (agents["received"] > 0)
    metrics = {
        "reward": float(following["reward"].mean()),
        "communication_share": float(communicating.float().mean()),
        "useful_share": float(useful.sum() / communicating.sum()),
        "dangerous_share": float(agents["dangerous"].sum() / (action < NUM_DIRECTIONS).sum()),
    }
    ended = following["done"].squeeze(-1)
    if ended.any():
        metrics |= {
            "episode_return": float(following["episode_reward"][ended].mean()),
            "episode_steps": float(following["step_count"][ended].float().mean()),
        }
        metrics |= {name: float(following[name][ended].mean()) for name in FinalShares._fields}
    return metrics
