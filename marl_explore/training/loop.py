"""The training loop: from the current update until the run ends, is interrupted or fails."""

from __future__ import annotations

from contextlib import closing
from dataclasses import asdict
from pathlib import Path

from marl_explore.training.checkpoint import list_checkpoints, write_checkpoint
from marl_explore.training.loggers import Loggers
from marl_explore.training.nan_guard import NonFiniteError
from marl_explore.training.progress import Progress, Report
from marl_explore.training.trainer import Trainer
from marl_explore.training.validation import Validation
from marl_explore.training.workers import WorkerError
from marl_explore.utils.interrupts import Request, RunInterruptedError, deferred
from marl_explore.utils.versions import versions


def run_training(trainer: Trainer, validation: Validation, progress: bool | Report) -> None:
    """The rest of a run: updates, validations, logs and checkpoints.

    Args:
        trainer: from where it is.
        validation: has the folder and the execution settings.
        progress: whether to show a progress bar, or what to report to.

    Raises:
        RunInterruptedError: after a SIGINT or SIGTERM, once update and checkpoint are done.
        NonFiniteError: also naming the last good checkpoint.
        WorkerError: once a checkpoint is written.
    """
    folder, run = validation.folder, validation.run
    settings = trainer.config.to_json() | {"execution": asdict(run)}
    loggers = Loggers(run.logger, folder, settings, trainer.frames)
    steps = trainer.config.updates * trainer.config.batch_frames
    with (
        closing(loggers),
        deferred() as request,
        closing(Progress(progress, trainer.frames, steps)) as shown,
    ):
        try:
            _loop(trainer, validation, loggers, request, shown)
        except FloatingPointError as error:  # also from the loss
            kept = list_checkpoints(folder)
            last = f"the last good checkpoint is {kept[-1]}" if kept else "there is no checkpoint"
            raise NonFiniteError(f"{error}; {last}") from error
        except WorkerError as error:
            _save(trainer, validation)
            raise WorkerError(f"{error}; {_how_to_resume(trainer, folder)}") from error


def _loop(
    trainer: Trainer, validation: Validation, loggers: Loggers, request: Request, shown: Progress
) -> None:
    last, every = trainer.config.updates, validation.run.checkpoint_every
    with closing(trainer.run()) as updates:
        for metrics in updates:
            if validation.due(trainer.updates, last):
                metrics |= validation(trainer.policy, trainer.updates)
            loggers.log(metrics, trainer.frames)
            shown.update(metrics, trainer.config.batch_frames)
            stop = request.signal if trainer.updates < last else None
            if stop or trainer.updates == last or (every and trainer.updates % every == 0):
                _save(trainer, validation)
            if stop:
                raise RunInterruptedError(stop, _how_to_resume(trainer, validation.folder))


def _save(trainer: Trainer, validation: Validation) -> None:
    state = {
        "config": trainer.config.to_json(),
        "versions": versions(),
        "best": validation.best,
        "trainer": trainer.state_dict(),
    }
    write_checkpoint(
        validation.folder, trainer.updates, state, keep=validation.run.keep_checkpoints
    )


def _how_to_resume(trainer: Trainer, folder: Path) -> str:
    return (
        f"update {trainer.updates} of {trainer.config.updates} is saved; resume with: "
        f"marl-explore resume {folder}"
    )
