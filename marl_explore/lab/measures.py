"""Measures of robots in the lab, compared with the rules of the grid."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.constants import NUM_DIRECTIONS, UNKNOWN
from marl_explore.core.links import links
from marl_explore.core.mapping import target_cells
from marl_explore.core.motion import action_mask, dangerous_moves, move, open_moves
from marl_explore.core.radio import reaches
from marl_explore.core.sensing import bordered, surroundings
from marl_explore.evaluation import metrics


@dataclass(frozen=True)
class LabRecord:
    """A run of A arenas over T steps with N robots each, and what happened between the steps."""

    config: ArenaConfig
    obstacles: Tensor
    """bool [A, H, W]."""
    maps: Tensor
    """Each robot's map, int8 [A, T + 1, N, H, W]."""
    cells: Tensor
    """True cells of the robots, int64 [A, T + 1, N, 2]."""
    actions: Tensor
    """Chosen actions, int64 [A, T, N]."""
    robot_contacts: int
    """Number of times that two robots began to touch."""
    obstacle_contacts: int
    """Number of times that a robot began to touch an obstacle."""
    seconds: float
    """Simulated time (seconds)."""
    sent_bytes: dict[str, int]
    """Bytes sent, by kind of message, counted once for every receiver."""

    def coverage(self) -> dict[str, Tensor]:
        """Coverage of the "best" map and of all maps "merged", float64 [A, T + 1]."""
        target = target_cells(self.obstacles, self.cells[:, 0])
        moments = metrics.snapshot(self.maps, target.unsqueeze(1))
        whole = target.flatten(1).sum(-1).unsqueeze(-1).double()
        return {
            "best": moments.known_targets.amax(-1) / whole,
            "merged": moments.union_targets / whole,
        }

    def wrong_cells(self) -> int:
        """Number of known cells of the last maps that contradict the arena."""
        last = self.maps[:, -1]
        return int(((last != UNKNOWN) & (last != self.obstacles.unsqueeze(1))).sum())

    def known_cells(self) -> int:
        """Number of known cells of the last maps."""
        return int((self.maps[:, -1] != UNKNOWN).sum())

    def disagreements(self) -> Tensor:
        """Where a robot did not end in the cell given by the rules of the grid, bool [A, T, N].

        Each step starts from the true cells of the robots.
        """
        config, before = self.config, self.cells[:, :-1]
        obstacles = self.obstacles.unsqueeze(1).expand(-1, before.shape[1], -1, -1)
        view = surroundings(bordered(obstacles, config.fov_radius), before, config.sight)
        reach = reaches(config, before.new_zeros(*before.shape[:2], 1))
        linked = links(config, before, obstacles, reach)
        allowed = action_mask(open_moves(view), linked)
        refused = dangerous_moves(allowed, before, self.actions)
        expected = move(before, self.actions, refused)
        return (expected != self.cells[:, 1:]).any(-1)

    def summary(self) -> dict[str, float]:
        """All measures by name."""
        wrong, curves = self.disagreements(), self.coverage()
        moves = self.actions < NUM_DIRECTIONS
        steps = self.actions.shape[1]
        return {
            "arenas": len(self.obstacles),
            "steps": steps,
            "moves": int(moves.sum()),
            "agreement": 1 - wrong.double().mean().item(),
            "agreement of moves": 1 - (wrong & moves).sum().item() / max(int(moves.sum()), 1),
            "robot contacts": self.robot_contacts,
            "obstacle contacts": self.obstacle_contacts,
            "wrong cells": self.wrong_cells(),
            "known cells": self.known_cells(),
            "best map at the end": curves["best"][:, -1].mean().item(),
            "merged map at the end": curves["merged"][:, -1].mean().item(),
            "seconds of a step": self.seconds / steps,
            **{f"{kind} bytes": count for kind, count in sorted(self.sent_bytes.items())},
        }
