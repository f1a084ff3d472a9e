"""Arenas drawn for tests of generators."""

from __future__ import annotations

import torch


def drawn(generate, count=20, seed=0, episode=0):
    """Obstacles and positions of the first arenas."""
    return generate(seed, torch.arange(count), torch.full((count,), episode))


def cells(positions):
    """Positions [N, 2] as a set of (row, column)."""
    return {tuple(cell) for cell in positions.tolist()}
