"""Arenas and maps drawn as text, so that a test shows the situation it is about."""

from __future__ import annotations

import torch
from torch import Tensor

from marl_explore.core.grid import FREE, OCCUPIED, UNKNOWN

ACTIONS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW", "stay", "talk")
"""The ten actions in their order; "talk" is communicate."""

CELL_CODES = {"?": UNKNOWN, ".": FREE, "#": OCCUPIED, "@": FREE}


def arena(board: str) -> tuple[Tensor, Tensor]:
    """Obstacles bool [H, W] and positions int64 [N, 2] of a drawn arena.

    ``#`` is an obstacle, ``.`` a free cell and a digit a robot on a free cell; row 0 comes first.

    Raises:
        ValueError: for ragged lines, other symbols, or robots not numbered 0, 1, 2 ... once each.
    """
    lines = _lines(board, allowed="#.0123456789")
    obstacles = [[symbol == "#" for symbol in line] for line in lines]
    robots = [(symbol, cell) for cell, symbol in _symbols(lines) if symbol.isdigit()]
    numbers = sorted(symbol for symbol, _ in robots)
    if numbers != [str(robot) for robot in range(len(robots))]:
        raise ValueError(f"robots must be numbered 0, 1, 2 ... once each, got {numbers}:\n{board}")
    cells = [cell for _, cell in sorted(robots)]
    return torch.tensor(obstacles), torch.tensor(cells, dtype=torch.int64).view(-1, 2)


def known_map(board: str) -> tuple[Tensor, Tensor]:
    """A robot's map int8 [H, W] and its position int64 [2].

    ``?`` is an unknown cell, ``.`` a free and ``#`` an occupied one, ``@`` the robot's own.

    Raises:
        ValueError: for ragged lines, other symbols, or not exactly one ``@``.
    """
    lines = _lines(board, allowed="?.#@")
    own = [cell for cell, symbol in _symbols(lines) if symbol == "@"]
    if len(own) != 1:
        raise ValueError(f"a map needs exactly one @, got {len(own)}:\n{board}")
    codes = [[CELL_CODES[symbol] for symbol in line] for line in lines]
    return torch.tensor(codes, dtype=torch.int8), torch.tensor(own[0])


def map_cells(board: str) -> Tensor:
    """A map int8 [H, W] without a robot, of the symbols ``?``, ``.`` and ``#``."""
    lines = _lines(board, allowed="?.#")
    return torch.tensor([[CELL_CODES[s] for s in line] for line in lines], dtype=torch.int8)


def actions(names: str) -> Tensor:
    """Actions int64 [N] of the robots in turn, such as ``actions("NE stay talk")``."""
    return torch.tensor([ACTIONS.index(name) for name in names.split()])


def _lines(board: str, allowed: str) -> list[str]:
    lines = board.split()
    for number, line in enumerate(lines):
        if len(line) != len(lines[0]):
            raise ValueError(
                f"line {number} ({line!r}) has {len(line)} cells and line 0 has "
                f"{len(lines[0])}:\n{board}"
            )
        strange = sorted(set(line) - set(allowed))
        if strange:
            raise ValueError(f"line {number} ({line!r}) holds {strange}, not one of {allowed!r}")
    return lines


def _symbols(lines: list[str]) -> list[tuple[tuple[int, int], str]]:
    return [((r, c), symbol) for r, line in enumerate(lines) for c, symbol in enumerate(line)]
