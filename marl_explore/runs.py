"""Run folders: what was done, with what, how it went, and what came out."""

from __future__ import annotations

import json
import logging
import platform
import shlex
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from marl_explore.arenas import full_name
from marl_explore.checkpoint import (
    CheckpointError,
    list_checkpoints,
    read_checkpoint,
    set_aside,
)
from marl_explore.config import TrainConfig, from_json
from marl_explore.execution import RunConfig
from marl_explore.files import write_text
from marl_explore.loggers import require_logger
from marl_explore.policies import Policy, save_policy
from marl_explore.trainer import Trainer
from marl_explore.training_run import carry_out
from marl_explore.validation import Validation
from marl_explore.versions import versions

CONFIG_FILE, RECORD_FILE = "config.json", "run.json"

logger = logging.getLogger(__name__)


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
    write_text(path, json.dumps(content, indent=2, allow_nan=True) + "\n")


def provenance() -> dict[str, Any]:
    """What is needed to do a run again: command, versions and machine."""
    return {
        "command": shlex.join([Path(sys.executable).name, *sys.argv]),
        "versions": versions(),
        "platform": platform.platform(),
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
    }


def train(
    config: TrainConfig,
    folder: str | Path,
    run: RunConfig | None = None,
    progress: bool = True,
) -> Policy:
    """Train a policy and keep everything about the run in a new folder.

    The folder gets ``config.json`` (what is learned), ``run.json`` (how it was carried out: every
    start with command and versions, time), ``scalars/*.csv`` (frames, value),
    ``checkpoints/``, ``best.safetensors`` and, at the end, ``policy.safetensors``.

    Args:
        config: the run.
        folder: must not exist, or be empty.
        run: how it is carried out.
        progress: whether to show a progress bar.

    Raises:
        ValueError: before anything is written, when the folder is in use.
        RunInterruptedError: after a SIGINT or SIGTERM, once update and checkpoint are done.
        NonFiniteError, WorkerError: when the run cannot go on; checkpoints are kept.
    """
    run = run or RunConfig()
    config = replace(config, arenas=full_name(config.arenas))
    trainer = make_trainer(config, run)  # wrong settings end here, before a folder is made
    folder = prepare(config, folder, run)
    return _carry_out(trainer, Validation(config, run, folder), progress)


def make_trainer(config: TrainConfig, run: RunConfig, fresh: bool = True) -> Trainer:
    """The trainer of a run, once everything that it needs is there; sets torch's CPU threads.

    Args:
        config: the run.
        run: how it is carried out.
        fresh: as for ``Trainer``.

    Raises:
        ValueError: naming the setting that does not fit, or the package that is missing.
    """
    require_logger(run.logger)
    torch.set_num_threads(run.threads)
    return Trainer(config, run, fresh)


def prepare(config: TrainConfig, folder: str | Path, run: RunConfig) -> Path:
    """A new run folder that ``resume`` starts from the beginning.

    Raises:
        ValueError: when the folder is in use.
    """
    config = replace(config, arenas=full_name(config.arenas))
    folder = new_folder(folder)
    write_json(folder / CONFIG_FILE, asdict(config))
    write_json(folder / RECORD_FILE, {"execution": asdict(run), "starts": []})
    return folder


def resume(folder: str | Path, from_previous: bool = False, progress: bool = True) -> Policy:
    """Go on with a run from its last checkpoint, or from the start when there is none.

    In one process the result is that of a run that never stopped, to the last bit; with other
    versions of what it depends on it may not be, and a warning says so.

    Args:
        folder: of a run that is not finished.
        from_previous: whether to go on from the checkpoint before the last one, which then
            counts no longer.
        progress: whether to show a progress bar.

    Raises:
        ValueError: when the folder is no run, the run is finished, or its checkpoint cannot be
            used (a ``CheckpointError``).
        RunInterruptedError, NonFiniteError, WorkerError: as for ``train``.
    """
    folder = Path(folder)
    config, run = read_settings(folder)
    if is_finished(folder):
        raise ValueError(f"the run in {folder} is finished: there is nothing to go on with")
    path = _checkpoint_to_resume(folder, from_previous)
    trainer = make_trainer(config, run, fresh=path is None)
    validation = Validation(config, run, folder)
    if path is not None:
        state = _read(path)
        _require_same(state["config"], config, path)
        _compare_versions(state["versions"], path)
        try:
            trainer.load_state_dict(state["trainer"])
        except ValueError as error:
            raise CheckpointError(f"{path} cannot be gone on from: {error}") from error
        validation.best = state["best"]
        if from_previous:
            set_aside(list_checkpoints(folder)[-1])
    return _carry_out(trainer, validation, progress)


def read_settings(folder: Path) -> tuple[TrainConfig, RunConfig]:
    """What a run folder was made with.

    Raises:
        ValueError: when it is no run folder, or of another version of this package.
    """
    try:
        fields = from_json(json.loads((folder / CONFIG_FILE).read_text()))
        record = json.loads((folder / RECORD_FILE).read_text())
        return TrainConfig(**fields), RunConfig(**record["execution"])
    except OSError as error:
        raise ValueError(f"{folder} is not a run folder: {error}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{folder} is not a run folder of this version: {error!r}") from error


def is_finished(folder: Path) -> bool:
    """Whether the run in a folder did all its updates."""
    return bool(json.loads((folder / RECORD_FILE).read_text()).get("finished"))


def _checkpoint_to_resume(folder: Path, from_previous: bool) -> Path | None:
    paths = list_checkpoints(folder)
    if not from_previous:
        return paths[-1] if paths else None
    if len(paths) < 2:
        raise ValueError(f"{folder} has no checkpoint before the last one: {len(paths)} in all")
    return paths[-2]


def _read(path: Path) -> dict[str, Any]:
    try:
        state = read_checkpoint(path)
        missing = [key for key in ("config", "versions", "best", "trainer") if key not in state]
        if missing:
            raise CheckpointError(f"{path} has no entry {', '.join(missing)}")
        return state
    except CheckpointError as error:
        others = list_checkpoints(path.parent.parent)
        earlier = [other for other in others if other < path]
        last = path == others[-1] and earlier
        hint = f"; --from-previous True goes on from {earlier[-1].name}" if last else ""
        raise CheckpointError(f"{error}{hint}") from error


def _require_same(saved: Mapping[str, Any], config: TrainConfig, path: Path) -> None:
    now = json.loads(json.dumps(asdict(config)))
    different = [key for key in now if saved.get(key) != now[key]]
    if different:
        raise CheckpointError(
            f"{path} is of another run: "
            + ", ".join(f"{k}={saved.get(k)!r} there, {now[k]!r} here" for k in different)
        )


def _compare_versions(saved: Mapping[str, str], path: Path) -> None:
    now = versions()
    different = [f"{p} {saved.get(p)} (now {now[p]})" for p in now if saved.get(p) != now[p]]
    if different:
        logger.warning(
            "%s was written with %s: the run goes on, but maybe not to the same bits",
            path,
            ", ".join(different),
        )


def _carry_out(trainer: Trainer, validation: Validation, progress: bool) -> Policy:
    """The rest of a run and its record, from where the trainer is."""
    folder = validation.folder
    record = json.loads((folder / RECORD_FILE).read_text())
    record["starts"].append(provenance() | {"updates": trainer.updates})
    write_json(folder / RECORD_FILE, record)
    carry_out(trainer, validation, progress)
    record |= {"seconds": round(trainer.seconds, 1), "frames": trainer.frames}
    info = {"config": asdict(trainer.config), **record["starts"][-1], **record}
    save_policy(trainer.policy, folder, info=info)
    write_json(folder / RECORD_FILE, record | {"finished": True})
    return trainer.policy.eval()
