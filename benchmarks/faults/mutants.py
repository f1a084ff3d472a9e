"""Damaged files of every kind: each is refused by name, or it says what it said before."""

from __future__ import annotations

import json
import random
import shutil
import tempfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.faults import programs
from benchmarks.faults.isolated import run
from benchmarks.faults.kills import _text
from marl_explore.arenas import suite
from marl_explore.evaluation.leaderboard import cells
from marl_explore.policies.export import export_npz
from marl_explore.policies.io import load_policy
from marl_explore.robot import ExportedPolicy, Pose
from marl_explore.robot.driving import Velocity
from marl_explore.training.checkpoint import list_checkpoints, read_checkpoint
from marl_explore.training.run_folder import read_config, read_record
from marl_explore.training.seeds import SweepRecord, read_sweep
from marl_explore.utils.curves import read_curve

VALUES: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    1.5,
    10**12,
    10**30,
    "",
    "x",
    [],
    [[]],
    {},
    float("nan"),
    float("inf"),
)
"""What takes the place of a field of a JSON file."""


def mutate_files(number: int) -> list[str]:
    """Damage every kind of file ``number`` times; returns what was accepted or crashed."""
    faults: list[str] = []
    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        run(programs.begin_or_resume, "run", folder=home, limit=600)
        for kind, (path, read, signed) in _files(home).items():
            draw, seen = random.Random(kind), {"refused": 0, "same": 0, "other": 0}
            whole, said = path.read_bytes(), _text(read(path))
            for i in range(number):
                json_file = path.suffix == ".json" and i % 2
                path.write_bytes((_other_field if json_file else _damaged)(whole, draw))
                try:
                    now = _text(read(path))
                except ValueError as error:
                    seen["refused"] += 1
                    named = path.parent if kind == "a recording" else path  # a folder
                    if str(named) not in str(error):
                        faults.append(f"{kind} {i}: the error names no file: {error}")
                except Exception as error:
                    faults.append(f"{kind} {i}: {type(error).__name__}: {error}")
                else:
                    seen["same" if now == said else "other"] += 1
                    if now != said and signed:
                        faults.append(f"{kind} {i}: accepted with other contents")
            path.write_bytes(whole)
            print(f"mutants of {kind}: {number}, {seen}", flush=True)
    return faults


def _files(home: Path) -> dict[str, tuple[Path, Callable[[Path], Any], bool]]:
    """A file of every kind, how it is read, and whether it is signed."""
    folder = home / "run"
    policy = load_policy(folder)
    exported = export_npz(policy, home / "policy.npz")
    cell = cells.Cell("nearest", suite("paper-12"), num_arenas=4, steps=20, seed=0)
    cells.make_cells(home / "cells", [cell], progress=False)
    SweepRecord((0, 1), 2).write(home)
    old = home / "old"
    shutil.copytree(folder, old)
    files = {
        "a policy": (
            folder / "policy.safetensors",
            lambda path: load_policy(path).state_dict(),
            True,
        ),
        "a checkpoint": (list_checkpoints(folder)[-1], read_checkpoint, True),
        "an exported policy": (exported, lambda path: ExportedPolicy(path, 0)._weights, True),
        "a cell": (home / "cells" / cell.file_name, lambda path: _cell(path, cell), True),
        "config.json": (old / "config.json", lambda path: repr(read_config(path.parent)), False),
        "run.json": (old / "run.json", lambda path: repr(read_record(path.parent)), False),
        "sweep.json": (home / "sweep.json", lambda path: repr(read_sweep(path.parent)), False),
        "a curve": (old / "scalars" / "reward.csv", lambda path: read_curve(path).tolist(), False),
    }
    if find_spec("rosbags") is None:
        print("mutants of a recording: not tested without the extra ros")
        return files
    return files | {"a recording": _recording(home / "bag")}


def _recording(path: Path) -> tuple[Path, Callable[[Path], Any], bool]:
    """A short recording of a robot; as in ``_files``."""
    from marl_explore.ros2.recordings import Recorder, messages

    with Recorder(path, ["robot_0", "robot_1"]) as recorder:
        for second in range(50):
            recorder.receive(0, Pose(float(second), 0, 0.1 * second, 0.5, 0.0), float(second))
            recorder.answer(0, Velocity(0.1, 0.0), second + 0.5)
    (bag,) = path.glob("*.mcap")
    return bag, lambda file: repr(list(messages(file.parent))), False


def _cell(path: Path, cell: cells.Cell) -> Any:
    found = cells.read(path, cell)
    if found is None:  # of another format or other code, so nobody takes its numbers
        raise ValueError(f"{path} is measured again")
    return found


def _damaged(whole: bytes, draw: random.Random) -> bytes:
    """A file with a flipped bit, cut off, or with a part overwritten."""
    mutant = bytearray(whole)
    at = draw.randrange(len(mutant))
    how = draw.choice(("bit", "bit", "bit", "cut", "noise"))
    if how == "bit":
        mutant[at] ^= 1 << draw.randrange(8)
    elif how == "cut":
        del mutant[at:]
    else:
        mutant[at : at + 16] = np.random.default_rng(at).bytes(16)
    return bytes(mutant)


def _other_field(whole: bytes, draw: random.Random) -> bytes:
    """A JSON file with another value, or without one, somewhere in it; or nested deeply."""
    if draw.random() < 0.05:
        return b'{"a":' * 100_000 + b"1" + b"}" * 100_000
    content = json.loads(whole)
    place = content
    while True:
        key = draw.choice([*place])
        if not isinstance(place[key], dict) or not place[key] or draw.random() < 0.3:
            break
        place = place[key]
    if draw.random() < 0.1:
        del place[key]
    else:
        place[key] = draw.choice(VALUES)
    return json.dumps(content).encode()
