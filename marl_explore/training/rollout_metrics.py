"""Metrics of the team's behaviour in a training batch."""

from __future__ import annotations

from tensordict import TensorDictBase

from marl_explore.core.grid import COMMUNICATE, NUM_DIRECTIONS
from marl_explore.core.mapping import known_cells, known_mask, known_targets, target_cells
from marl_explore.core.survivors import largest_of_living


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
        known = known_mask(agents["map"][ended])
        target = target_cells(following["obstacles"][ended], agents["position"][ended])
        alive = agents["alive"][ended]
        largest = largest_of_living(known_targets(known, target), alive)
        covered = largest / target.flatten(-2).sum(-1)
        ratio = largest_of_living(known_cells(known), alive) / target[0].numel()
        metrics |= {
            "episode_return": float(following["episode_reward"][ended].mean()),
            "episode_steps": float(following["step_count"][ended].float().mean()),
            "final_coverage": float(covered.mean()),
            "final_known_ratio": float(ratio.mean()),
        }
    return metrics
