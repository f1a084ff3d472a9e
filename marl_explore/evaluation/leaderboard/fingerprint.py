"""A fingerprint of the source that the numbers of a cell depend on."""

from __future__ import annotations

import ast
import hashlib
from functools import lru_cache
from pathlib import Path

PACKAGE = Path(__file__).parents[2]
RULES = (
    "config/arena.py",
    "config/checks.py",
    "config/constants.py",
    "config/goals.py",
    "config/shapes.py",
    "core",
    "envs",
    "evaluation/episodes.py",
    "evaluation/metrics.py",
)
PLANNING = ("planners", "transforms")
ACTING = (
    "planners/base.py",
    "planners/communication.py",
    "planners/goal_moves.py",
    "planners/goal_utility.py",
    "planners/hindrances.py",
    "transforms",
    "policies/actors.py",
    "policies/argmax.py",
    "policies/io.py",
    "policies/networks",
    "policies/policy.py",
    "policies/stacking.py",
)
"""Modules of planners and of trained policies, in addition to the rules and the measures."""


def sources(planner: bool) -> list[Path]:
    """The code behind a planner's or a trained policy's numbers: modules, and folders of them."""
    return [PACKAGE / part for part in (*RULES, *(PLANNING if planner else ACTING))]


@lru_cache
def source_digest(planner: bool) -> str:
    """SHA-256 of ``sources``, whatever their comments, docstrings and layout say.

    Of arenas a suite has its own fingerprint.
    """
    return digest(sources(planner))


def digest(paths: list[Path]) -> str:
    """SHA-256 of what modules, and all modules of folders, do; C sources count as they are."""
    total = hashlib.sha256()
    for path in paths:
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.suffix in (".py", ".c"):
                total.update(f"{file.name}\n{_source(file)}\n".encode())
    return total.hexdigest()


def _source(file: Path) -> str:
    text = file.read_text(encoding="utf-8")
    return _statements(text) if file.suffix == ".py" else text


def _statements(source: str) -> str:
    """Source code without comments, docstrings and other bare strings."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [line for line in body if not _is_text(line)] or [ast.Pass()]  # type: ignore[attr-defined]
    return ast.unparse(tree)


def _is_text(line: ast.AST) -> bool:
    return (
        isinstance(line, ast.Expr)
        and isinstance(line.value, ast.Constant)
        and isinstance(line.value.value, str)
    )
