"""Ablations: actors without some of their inputs, or without communication."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from marl_explore.config.checks import require
from marl_explore.config.constants import ABILITIES, COMMUNICATE, FORBIDDEN_LOGIT, Ability
from marl_explore.policies.networks.base import Network


class Ablated(nn.Module):
    """An actor that reads some of its inputs as 0, or never communicates.

    Args:
        actor: the network.
        ablate: what it does without.
    """

    def __init__(self, actor: nn.Module, ablate: Sequence[Ability]) -> None:
        super().__init__()
        self.actor = actor
        self.inputs: tuple[str, ...] = actor.inputs  # type: ignore[assignment]
        self.ablate = frozenset(ablate)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Logits [*B, 10]."""
        read = (
            torch.zeros_like(entry) if name in self.ablate else entry
            for name, entry in zip(self.inputs, inputs, strict=True)
        )
        logits = self.actor(*read)
        if "communication" in self.ablate:
            logits = logits.index_fill(
                -1, torch.tensor(COMMUNICATE, device=logits.device), FORBIDDEN_LOGIT
            )
        return logits


def require_abilities(network: Network, ablate: Sequence[str]) -> None:
    """Raise an error for ablations of what actors do not have.

    Raises:
        ValueError: naming what can be ablated.
    """
    for ability in ablate:
        require(ability in ABILITIES, "ablate", ablate, f"use some of {ABILITIES}")
        require(
            ability in (*network.features, "communication"),
            "ablate",
            ablate,
            f"{network.name} actors do not read {ability}",
        )
        require(
            network.chooses != "goals",
            "ablate",
            ablate,
            f"{network.name} actors choose among goals, and cannot do without {ability}",
        )
