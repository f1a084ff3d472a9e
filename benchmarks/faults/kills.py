"""Runs and sweeps that are killed again and again end like those that never were."""

from __future__ import annotations

import random
import shutil
import tempfile
from pathlib import Path

from benchmarks.faults import programs
from benchmarks.faults.isolated import run, start, wait_for
from marl_explore.policies.io import load_policy
from marl_explore.training.checkpoint import list_checkpoints, read_checkpoint
from marl_explore.training.run_folder import CONFIG_FILE, is_finished
from marl_explore.training.seeds import SUMMARY_FILE

TIMES = ("seconds", "rate")


def content(folder: Path) -> dict[str, str]:
    """Everything that a run made but times, as text."""
    found = {
        f"scalars/{file.name}": file.read_text()
        for file in sorted((folder / "scalars").glob("*.csv"))
        if file.stem not in TIMES
    }
    state = read_checkpoint(list_checkpoints(folder)[-1])
    del state["trainer"]["seconds"]
    found["checkpoint"] = _text(state)
    for name in ("policy.safetensors", "best.safetensors"):
        found[name] = _text(load_policy(folder / name).state_dict())
    return found


def kill_runs(number: int) -> list[str]:
    """Kill runs at random times, ``number`` times in all; returns what differed at the end."""
    draw, faults, kills = random.Random(0), [], 0
    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        run(programs.begin_or_resume, "whole", folder=home, limit=600)
        whole = content(home / "whole")
        while kills < number:
            shutil.rmtree(home / "killed", ignore_errors=True)
            while not _finished(home / "killed"):
                process = start(
                    programs.begin_or_resume, "killed", folder=home, output=home / "output"
                )
                # longer and longer: a busy machine must come to the next checkpoint in the end
                process.join(draw.uniform(0.05, 1.0) * (1 + kills % 20 / 5))
                kills += process.exitcode is None
                process.kill()
                process.join()
            faults += _differences(whole, content(home / "killed"), f"after kill {kills}")
    print(f"kills: {kills} kills, {len(faults)} differences")
    return faults


def kill_sweeps(number: int) -> list[str]:
    """Kill the parent of sweeps and resume them at once; returns what differed at the end."""
    draw, faults = random.Random(0), []
    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        run(programs.begin_or_resume_sweep, "whole", folder=home, limit=600)
        whole = {seed: content(home / "whole" / f"seed-{seed}") for seed in (0, 1)}
        for sweep in range(number):
            folder, output = home / f"sweep-{sweep}", home / "output"
            process = start(programs.begin_or_resume_sweep, folder.name, folder=home, output=output)
            curve = folder / f"seed-{draw.randrange(2)}" / "scalars" / "reward.csv"
            wait_for(lambda curve=curve: curve.exists() and curve.stat().st_size > 0)
            process.join(draw.uniform(0.0, 2.0))
            process.kill()
            process.join()
            ended = run(programs.begin_or_resume_sweep, folder.name, folder=home, limit=600)
            if ended.status != 0 or not (folder / SUMMARY_FILE).exists():
                faults.append(f"sweep {sweep} ended with {ended.status}: {ended.output[-300:]}")
                continue
            for seed in (0, 1):
                there = content(folder / f"seed-{seed}")
                faults += _differences(whole[seed], there, f"sweep {sweep}, seed {seed}")
    print(f"sweeps: {number} killed and resumed at once, {len(faults)} differences")
    return faults


def _finished(folder: Path) -> bool:
    return (folder / CONFIG_FILE).exists() and is_finished(folder)


def _differences(whole: dict[str, str], there: dict[str, str], where: str) -> list[str]:
    names = whole.keys() | there.keys()
    return [f"{where}: {n}" for n in sorted(names) if whole.get(n) != there.get(n)]


def _text(value: object) -> str:
    """A nested state as text, keys in order, tensors with all their bytes."""
    if isinstance(value, dict):
        entries = sorted(value.items(), key=lambda entry: str(entry[0]))
        return "{" + ", ".join(f"{k}: {_text(v)}" for k, v in entries) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_text, value)) + "]"
    if hasattr(value, "numpy"):
        return f"{value.dtype} {tuple(value.shape)} {value.numpy().tobytes().hex()}"
    return repr(value)
