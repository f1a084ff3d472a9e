"""Training runs in folders: started, resumed and finished."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from marl_explore.arenas import full_name
from marl_explore.config.run import RunConfig
from marl_explore.policies.io import save_policy
from marl_explore.policies.migrate import migrated
from marl_explore.policies.policy import Policy
from marl_explore.training.checkpoint import (
    CheckpointError,
    list_checkpoints,
    read_checkpoint,
    set_aside,
)
from marl_explore.training.config import TrainConfig
from marl_explore.training.loggers import require_logger
from marl_explore.training.loop import run_training
from marl_explore.training.progress import Report
from marl_explore.training.run_folder import (
    RunRecord,
    prepare,
    read_config,
    read_record,
    write_longer,
)
from marl_explore.training.trainer import Trainer
from marl_explore.training.validation import Validation, require_validation
from marl_explore.utils.locks import owned
from marl_explore.utils.records import provenance
from marl_explore.utils.versions import versions

logger = logging.getLogger(__name__)


def train(
    config: TrainConfig,
    folder: str | Path,
    run: RunConfig | None = None,
    progress: bool | Report = True,
) -> Policy:
    """Train a policy and keep everything about the run in a new folder.

    The folder gets ``config.json`` (what is learned), ``run.json`` (how: execution settings,
    every start with command and versions, time), ``scalars/*.csv`` (frames, value),
    ``checkpoints/``, ``best.safetensors`` and, at the end, ``policy.safetensors``.

    Args:
        config: the run.
        folder: must not exist, or be empty.
        run: execution settings.
        progress: whether to show a progress bar, or what to report to.

    Raises:
        ValueError: before anything is written, when the folder is in use.
        OSError: naming the file, when one cannot be written.
        RunInterruptedError: after a SIGINT or SIGTERM, once update and checkpoint are done.
        NonFiniteError, WorkerError: when the run cannot continue; checkpoints are kept.
    """
    run = run or RunConfig()
    config = replace(config, arenas=full_name(config.arenas))
    trainer = make_trainer(config, run)  # rejects wrong settings before a folder is made
    folder = prepare(config, folder, run)
    with owned(folder):
        return _carry_out(trainer, Validation(config, run, folder), RunRecord(run), progress)


def make_trainer(config: TrainConfig, run: RunConfig, fresh: bool = True) -> Trainer:
    """The trainer of a run, after checking its settings and packages; sets torch's CPU threads.

    Args:
        config: the run.
        run: execution settings.
        fresh: as for ``Trainer``.

    Raises:
        ValueError: naming the setting that is not allowed, or the package that is missing.
    """
    require_logger(run.logger)
    if run.validate_every:
        require_validation(config, run)
    torch.set_num_threads(run.threads)
    return Trainer(config, run, fresh)


def resume(
    folder: str | Path,
    from_previous: bool = False,
    progress: bool | Report = True,
    patience: float = 0.0,
    episodes: int | None = None,
) -> Policy:
    """Resume a run from its last checkpoint, or from the start when there is none.

    In one process the result is bit-identical to that of a run that never stopped. With other
    versions of its dependencies it may not be, and a warning says so.

    Args:
        folder: of a run that is not finished.
        from_previous: whether to resume from the checkpoint before the last one; the last one is
            ignored from then on.
        progress: whether to show a progress bar, or what to report to.
        patience: how long to wait while another process owns the run (seconds).
        episodes: new length of the run, to make it longer first, as by ``lengthen``.

    Raises:
        ValueError: when the folder is not a run, the run is finished, another process owns it (a
            ``FolderInUseError``), or its checkpoint cannot be used (a ``CheckpointError``).
        OSError: naming the file, when one cannot be written.
        RunInterruptedError, NonFiniteError, WorkerError: as for ``train``.
    """
    folder = Path(folder)
    read_config(folder)  # refuses what is not a run before it is locked
    with owned(folder, patience):
        if episodes is not None:
            write_longer(folder, episodes)
        return _resume(folder, from_previous, progress)


def _resume(folder: Path, from_previous: bool, progress: bool | Report) -> Policy:
    config, record = read_config(folder), read_record(folder)
    run = record.execution
    if record.finishes(config):
        raise ValueError(f"the run in {folder} is finished: there is nothing to resume")
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
            raise CheckpointError(f"{path} cannot be resumed from: {error}") from error
        validation.best = state["best"]
        if from_previous:
            set_aside(list_checkpoints(folder)[-1])
    return _carry_out(trainer, validation, record, progress)


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
        hint = f"; --from-previous True resumes from {earlier[-1].name}" if last else ""
        raise CheckpointError(f"{error}{hint}") from error


def _require_same(saved: Mapping[str, Any], config: TrainConfig, path: Path) -> None:
    try:  # settings that did not exist yet have their defaults
        before = TrainConfig.from_json(migrated(saved), str(path))
    except ValueError as error:
        raise CheckpointError(f"{path} belongs to another run: {error}") from error
    there, here = (json.loads(json.dumps(one.to_json())) for one in (before, config))
    if there["episodes"] < here["episodes"]:  # the run was made longer
        there["episodes"] = here["episodes"]
    different = [key for key in here if there[key] != here[key]]
    if different:
        raise CheckpointError(
            f"{path} belongs to another run: "
            + ", ".join(f"{k}={there[k]!r} there, {here[k]!r} here" for k in different)
        )


def _compare_versions(saved: Mapping[str, str], path: Path) -> None:
    now = versions()
    different = [f"{p} {saved.get(p)} (now {now[p]})" for p in now if saved.get(p) != now[p]]
    if different:
        logger.warning(
            "%s was written with %s: the run resumes, but may not be bit-exact",
            path,
            ", ".join(different),
        )


def _carry_out(
    trainer: Trainer, validation: Validation, record: RunRecord, progress: bool | Report
) -> Policy:
    """Do the rest of a run, from where the trainer is, and keep its record."""
    folder = validation.folder
    start = provenance() | {"updates": trainer.updates}
    record = replace(record, starts=(*record.starts, start), finished=False)
    record.write(folder)
    run_training(trainer, validation, progress)
    record = replace(record, seconds=round(trainer.seconds, 1), frames=trainer.frames)
    info = {"config": trainer.config.to_json(), **start, **record.to_json()}
    save_policy(trainer.policy, folder, info=info)
    replace(record, finished=True).write(folder)
    return trainer.policy.eval()
