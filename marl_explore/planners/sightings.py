"""What robots remember about each other: when and where they were last linked."""

from __future__ import annotations

import torch
from torch import Tensor

from marl_explore.core.links import linked_others
from marl_explore.core.sensing import in_view

NOT_SEEN = -1_000_000
"""Step of the last sighting if there was none."""


class Sightings:
    """Memory of a batch of teams; it is cleared where an episode starts.

    All entries are [B, N, ...]: row i is what robot i remembers.

    Args:
        grid: maps [B, N, H, W], for their shape and device.
    """

    step: Tensor
    """Step at which i was last linked to j, int64 [B, N, N]; NOT_SEEN before, and for j = i."""
    cell: Tensor
    """Position of j then, int64 [B, N, N, 2]."""
    waited: Tensor
    """Whether j was at the same position one step earlier, bool [B, N, N]."""
    covered: Tensor
    """Cells that others have seen, as far as i knows, bool [B, N, H, W]."""

    def __init__(self, grid: Tensor) -> None:
        batch, robots, height, width = grid.shape
        pairs, device = (batch, robots, robots), grid.device
        self.step = torch.full(pairs, NOT_SEEN, device=device)
        self.cell = torch.zeros(*pairs, 2, dtype=torch.int64, device=device)
        self.waited = torch.zeros(pairs, dtype=torch.bool, device=device)
        self.covered = torch.zeros(batch, robots, height, width, dtype=torch.bool, device=device)

    def update(self, now: Tensor, position: Tensor, linked: Tensor, radius: int) -> None:
        """Add one observation.

        Args:
            now: step of the episode, int64 [B, 1].
            position: int64 [B, N, 2].
            linked: bool [B, N, N].
            radius: half side of the field of view (cells).
        """
        begun = now == 0
        self.step = self.step.masked_fill(begun.unsqueeze(-1), NOT_SEEN)
        self.covered = self.covered & ~begun[..., None, None]
        others = linked_others(linked)
        place = position.unsqueeze(1).expand_as(self.cell)
        again = (self.step == now.unsqueeze(-1) - 1) & (self.cell == place).all(-1)
        self.waited = others & again
        self.cell = torch.where(others.unsqueeze(-1), place, self.cell)
        self.step = torch.where(others, now.unsqueeze(-1), self.step)
        height, width = self.covered.shape[-2:]
        views = in_view(position, height, width, radius).float()
        seen = torch.einsum("bij,bjc->bic", others.float(), views.flatten(-2)) > 0
        self.covered = self.covered | seen.view_as(self.covered)

    def last_place(self) -> Tensor:
        """Position at which i last saw another robot, int64 [B, N, 2]."""
        latest = self.step.argmax(-1)
        index = latest[..., None, None].expand(*latest.shape, 1, 2)
        return self.cell.gather(2, index).squeeze(2)
