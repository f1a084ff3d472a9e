"""Export a trained policy for use without torch: policy.npz, and an ONNX graph per robot.

marl-explore export runs/my-run --out exported

docs/robots.md explains how a robot uses them. ONNX needs ``pip install ".[export]"``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from marl_explore.cli.common import parse_options
from marl_explore.config.checks import require


@dataclass(frozen=True)
class Arguments:
    """Options of ``marl-explore export``."""

    policy: Annotated[str, tyro.conf.Positional]
    """Run folder, policy file or bundled policy."""
    out: Path = Path("exported")
    """Folder for the files."""
    kinds: tuple[Literal["npz", "onnx"], ...] = ("npz", "onnx")
    """Formats to write."""

    def __post_init__(self) -> None:
        """Check the arguments."""
        require(self.kinds != (), "kinds", self.kinds, "name at least one format, npz or onnx")


def parse(words: Sequence[str], prog: str = "marl-explore export") -> Arguments:
    """Parse a command line."""
    return parse_options(Arguments, words, prog, __doc__)


def run(arguments: Arguments) -> None:
    """Export the policy, and write a record."""
    from marl_explore.policies.export import (
        export_npz,
        export_onnx,
        require_exportable,
    )
    from marl_explore.policies.io import load_policy
    from marl_explore.utils import records

    policy = load_policy(arguments.policy)
    kinds = arguments.kinds
    require_exportable(policy, kinds)
    arguments.out.mkdir(parents=True, exist_ok=True)
    paths: list[Path] = []
    if "npz" in kinds:
        paths.append(export_npz(policy, arguments.out / "policy.npz"))
    if "onnx" in kinds:
        paths += export_onnx(policy, arguments.out)
    records.write_json(arguments.out / "export.json", records.provenance())
    print(*paths, sep="\n")
