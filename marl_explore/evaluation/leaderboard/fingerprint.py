"""A fingerprint of the source that the numbers of a cell depend on."""

from __future__ import annotations

import ast
import hashlib
from functools import lru_cache
from pathlib import Path
from typing import Literal

from marl_explore.evaluation.outside import package_files

Kind = Literal["planner", "trained", "outside"]
"""Of a policy; "outside" are those of other packages."""

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
    "evaluation/recording.py",
    "utils/devices.py",
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
OBSERVING = (
    "evaluation/outside.py",
    "policies/observations.py",
    "robot/observation.py",
    "transforms",
    "utils/chance.py",
)
"""Modules of planners, of trained policies and of those of other packages, in addition to the rules
and the measures."""


PARTS: dict[Kind, tuple[str, ...]] = {
    "planner": PLANNING,
    "trained": ACTING,
    "outside": OBSERVING,
}


def sources(kind: Kind) -> list[Path]:
    """The code of this package behind a policy's numbers: modules, and folders of them."""
    return [PACKAGE / part for part in (*RULES, *PARTS[kind])]


@lru_cache
def source_digest(kind: Kind) -> str:
    """SHA-256 of ``sources``, whatever their comments, docstrings and layout say.

    Of arenas a suite has its own fingerprint.
    """
    return digest(sources(kind))


def outside_digest(policy: str) -> str:
    """As ``source_digest``, of a policy of another package: also of the code of that package."""
    return digest([*sources("outside"), *package_files(policy)])


def digest(paths: list[Path]) -> str:
    """SHA-256 of what modules, and all modules of folders, do; C sources count as they are."""
    total = hashlib.sha256()
    for path in paths:
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.suffix in (".py", ".c"):
                total.update(f"{file.name}\n{_source(file)}\n".encode())
    return total.hexdigest()


def _source(file: Path) -> str:
    text = file.read_text(encoding="utf-8", errors="replace")
    if file.suffix != ".py":
        return text
    try:
        return _statements(text)
    except SyntaxError:  # a file of another package that nobody imports
        return text


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
