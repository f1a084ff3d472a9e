"""Run folders: what was done, with what, how it went, and what came out."""

from __future__ import annotations

import json
import platform
import shlex
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from torchrl.record import CSVLogger
from tqdm import tqdm

from marl_explore.arenas import full_name
from marl_explore.config import TrainConfig
from marl_explore.files import whole_file
from marl_explore.policies import Policy, save_policy
from marl_explore.trainer import Trainer

PACKAGES = ("marl-explore", "torch", "torchrl", "tensordict")


def new_folder(path: str | Path) -> Path:
    """Make a folder for results.

    Raises:
        ValueError: when it exists and holds something.
    """
    path = require_new(path)
    path.mkdir(parents=True, exist_ok=True)
    return path


def require_new(path: str | Path) -> Path:
    """Refuse a folder that exists and holds something.

    Raises:
        ValueError: naming it.
    """
    path = Path(path)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise ValueError(f"output folder {str(path)!r} exists and is not empty: choose another")
    return path


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a file whole or not at all."""
    with whole_file(path) as unfinished:
        unfinished.write_text(json.dumps(content, indent=2, allow_nan=True) + "\n")


def provenance() -> dict[str, Any]:
    """What is needed to do a run again: command, versions and machine."""
    return {
        "command": shlex.join([Path(sys.executable).name, *sys.argv]),
        "versions": {"python": platform.python_version()} | {p: version(p) for p in PACKAGES},
        "platform": platform.platform(),
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
    }


def train(config: TrainConfig, folder: str | Path, progress: bool = True) -> Policy:
    """Train a policy and keep everything about the run in a new folder.

    The folder gets ``config.json``, ``run.json`` (command, versions, time), ``scalars/*.csv``
    (update's frames, value) and ``policy.safetensors``.

    Args:
        config: the run.
        folder: must not exist, or be empty.
        progress: whether to show a progress bar.

    Raises:
        ValueError: before anything is written, when the folder is in use.
    """
    config = replace(config, arenas=full_name(config.arenas))
    trainer = Trainer(config)  # wrong settings end here, before a folder is made
    folder = new_folder(folder)
    record = provenance()
    write_json(folder / "config.json", asdict(config))
    write_json(folder / "run.json", record)
    logger = CSVLogger(folder.name, str(folder.parent))
    latest: dict[str, str] = {}
    metrics: dict[str, float] = {}
    with tqdm(
        total=config.updates * config.batch_frames,
        unit=" steps",
        disable=not progress,
        mininterval=0.2 if sys.stderr.isatty() else 15,  # a log file wants few lines
    ) as bar:
        for metrics in trainer.run():
            for name, value in metrics.items():
                logger.log_scalar(name, value, int(metrics["frames"]))
            latest.update(_headline(metrics))
            bar.set_postfix(latest, refresh=False)
            bar.update(config.batch_frames)
    record |= {"seconds": round(metrics["seconds"], 1), "frames": metrics["frames"]}
    save_policy(trainer.policy, folder, info={"config": asdict(config), **record})
    write_json(folder / "run.json", record)
    return trainer.policy.eval()


def _headline(metrics: Mapping[str, float]) -> dict[str, str]:
    """The progress bar's numbers, as far as the update has them."""
    columns = {
        "return": ("episode_return", "{:.1f}"),
        "coverage": ("final_coverage", "{:.1%}"),
        "communicate": ("communication_share", "{:.0%}"),
    }
    return {
        title: form.format(metrics[key]) for title, (key, form) in columns.items() if key in metrics
    }
