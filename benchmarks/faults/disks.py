"""Runs on disks that fill up: one clear error, and nothing that cannot be resumed."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

from benchmarks.faults import programs
from benchmarks.faults.isolated import run
from benchmarks.faults.kills import content

SIZES_KB = (4, 8, 12, 16, 24, 32, 48, 64, 80, 96, 112, 128, 160, 192, 256, 320, 384)
ENOUGH_KB = 65536


def fill_disks() -> list[str]:
    """Train on disks of every size, then with enough of it; returns what was wrong."""
    faults: list[str] = []
    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        run(programs.command, *_words("whole"), folder=home, limit=600)
        whole = content(home / "whole")
        for size in SIZES_KB:
            disk = home / f"disk-{size}"
            disk.mkdir()
            mount = ["mount", "-t", "tmpfs", "-o", f"size={size}k", "tmpfs", str(disk)]
            if subprocess.run(mount, capture_output=True).returncode:
                print("disks: not tested, mounting a disk takes root")
                return ["disks of a size cannot be mounted without root"]
            try:
                faults += _fill(disk, size, whole)
            finally:
                subprocess.run(["umount", str(disk)], check=True)
    print(f"disks: {len(SIZES_KB)} sizes, {len(faults)} faults")
    return faults


def _fill(disk: Path, size: int, whole: dict[str, str]) -> list[str]:
    faults = []
    first = run(programs.command, *_words("run"), folder=disk, limit=120)
    if first.status == 0:
        return [f"{size} KB: finished, so the disk was large enough"]
    if not first.refused or "run" not in first.output:
        faults.append(f"{size} KB: {first.status}, {first.output[-300:]}")
    subprocess.run(["mount", "-o", f"remount,size={ENOUGH_KB}k", str(disk)], check=True)
    words = ["resume", "run"] if (disk / "run" / "config.json").exists() else _words("again")
    again = run(programs.command, *words, folder=disk, limit=120)
    if again.status:
        faults.append(f"{size} KB, resumed: {again.status}, {again.output[-300:]}")
    else:
        there = content(disk / ("run" if words[0] == "resume" else "again"))
        different = [key for key in whole if whole[key] != there.get(key)]
        faults += [f"{size} KB, resumed: {key} differs" for key in different]
    return faults


def _words(out: str) -> list[str]:
    """The command line that trains ``programs.CONFIG``, with frequent checkpoints."""
    options = {
        "--height": "6",
        "--width": "6",
        "--num-agents": "2",
        "--episodes": "48",
        "--episode-steps": "10",
        "--num-envs": "4",
        "--rollout-steps": "5",
        "--num-minibatches": "2",
        "--checkpoint-every": "3",
        "--validate-every": "4",
        "--validation-arenas": "4",
        "--validation-steps": "10",
        "--out": out,
    }
    words = [word for pair in options.items() for word in pair]
    return ["train", "paper-mlp-case2", "--hidden", "16", "16", *words]
