"""Actors that choose among goals as a graph whose shapes do not depend on what there is."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from marl_explore.config.constants import GOAL_COLUMNS
from marl_explore.policies.networks.goals import GoalActor
from marl_explore.transforms.goals import Candidates

_MOVES = GOAL_COLUMNS.index("moves")


class GoalGraph(nn.Module):
    """The most likely choice and the logits of a ``GoalActor``, for export.

    The actor itself computes only the choices that there are, which a graph cannot.

    Args:
        actor: the network.
    """

    def __init__(self, actor: GoalActor) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, *candidates: Tensor) -> tuple[Tensor, Tensor]:
        """The choice int64 [B], and logits [B, 24 + N + 2], -inf where there is no choice.

        Args:
            candidates: float32, frontiers [B, 24, 14], rivals [B, 24, N, 2], mates [B, N, 9] and
                context [B, 9] (docs/goals.md).
        """
        found, actor = Candidates(*candidates), self.actor
        encoder = actor.encoder
        scaled = encoder.features(found, dense=True)
        filled = (found.frontiers[..., _MOVES] > 0).flatten()
        # rows without a candidate hold whatever division by zero gives
        places = torch.where(filled.unsqueeze(-1), scaled.frontier, 0)
        pairs = torch.where(filled[:, None, None], scaled.pair, 0)
        scaled = scaled._replace(frontier=places, pair=pairs)
        rows = found.frontiers.shape[:2]
        first = (
            encoder.of_frontiers(scaled).unflatten(0, rows),
            encoder.mate(_with_context(scaled.mate, scaled.context)),
            encoder.still(_with_context(scaled.still, scaled.context)),
        )
        valid = scaled.valid.unsqueeze(-1)
        each = torch.where(valid, encoder.code(torch.cat(first, -2)), 0)
        pooled = torch.cat((each.sum(-2) / valid.sum(-2), each.amax(-2)), -1)
        score = actor.score(_with_context(each, pooled)).squeeze(-1)
        logits = actor.refine(score, scaled, found.context)
        logits = logits.masked_fill(~scaled.valid, -torch.inf)
        return logits.argmax(-1), logits


def _with_context(features: Tensor, context: Tensor) -> Tensor:
    """Features [B, C, F] with those of their row [B, G], [B, C, F + G]."""
    wide = context.unsqueeze(-2).expand(*features.shape[:-1], context.shape[-1])
    return torch.cat((features, wide), -1)
