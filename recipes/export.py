"""Write a trained policy for computers without torch: policy.npz, and an ONNX graph per robot.

python recipes/export.py runs/my-run --out exported

docs/robots.md tells how a robot uses them. ONNX takes ``pip install ".[export]"``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from marl_explore import cli


@dataclass(frozen=True)
class Arguments:
    """Which policy, and where to."""

    policy: Annotated[str, tyro.conf.Positional]
    """Run folder, policy file or bundled policy."""
    out: Path = Path("exported")
    """Folder to write to."""
    kinds: tuple[Literal["npz", "onnx"], ...] = ("npz", "onnx")
    """What to write."""


def parse() -> Arguments:
    """Read the command line."""
    return tyro.cli(Arguments, prog="export.py", description=__doc__)


def run(arguments: Arguments) -> None:
    """Export the policy, and write how."""
    from marl_explore import runs
    from marl_explore.export import export_npz, export_onnx
    from marl_explore.policies import load_policy

    policy = load_policy(arguments.policy)
    arguments.out.mkdir(parents=True, exist_ok=True)
    paths: list[Path] = []
    if "npz" in arguments.kinds:
        paths.append(export_npz(policy, arguments.out / "policy.npz"))
    if "onnx" in arguments.kinds:
        paths += export_onnx(policy, arguments.out)
    runs.write_json(arguments.out / "export.json", runs.provenance())
    print(*paths, sep="\n")


if __name__ == "__main__":
    cli.main(parse, run)
