"""Runs in processes of their own that are killed at chosen moments.

The processes are forked from a server that has imported everything, so that each takes
milliseconds to start.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from pathlib import Path

from torchrl.record.loggers.csv import CSVExperiment

from marl_explore.config.run import RunConfig
from marl_explore.training import checkpoint, learners, loop, run_folder, runs, trainer, validation
from marl_explore.utils import files, tensor_files
from tests.helpers.configs import tiny

CONFIG = tiny(terminate_at_coverage=0.9, rollout_steps=5, num_minibatches=2, lr_decay=True)
RUN = RunConfig(checkpoint_every=3, validate_every=4, validation_arenas=4, validation_steps=10)

MOMENTS = {
    "collecting": (trainer.Trainer, "collect"),
    "in an update": (learners.Learner, "_step"),
    "logging": (CSVExperiment, "add_scalar"),
    "validating": (validation, "evaluate"),
    "before a checkpoint": (loop, "write_checkpoint"),
    "writing a checkpoint": (tensor_files, "save_file"),
    "putting a file in its place": (files.os, "replace"),
    "removing a checkpoint": (checkpoint.Path, "unlink"),
    "writing the policy": (runs, "save_policy"),
}
"""Functions during whose n-th call a run may be killed."""

SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(["tests.helpers.killing"])


def go_on(folder: Path, moment: str | None = None, call: int = 1) -> None:
    """Start a run, or go on with it, and kill this process at a moment."""
    if moment is not None:
        _arm(*MOMENTS[moment], call)
    if (folder / run_folder.CONFIG_FILE).exists():
        runs.resume(folder, progress=False)
    else:
        runs.train(CONFIG, folder, RUN, progress=False)


def start(folder: Path, *options: object) -> multiprocessing.Process:
    """``go_on`` in a process of its own."""
    process = SERVER.Process(target=go_on, args=(folder, *options))
    process.start()
    return process


def _arm(owner: object, name: str, call: int) -> None:
    original, calls = getattr(owner, name), 0

    def armed(*args: object, **kwargs: object) -> object:
        nonlocal calls
        calls += 1
        if calls == call:
            if owner is tensor_files and name == "save_file":  # half of the file
                original(*args, **kwargs)
                os.truncate(args[1], os.path.getsize(args[1]) // 2)
            os.kill(os.getpid(), signal.SIGKILL)
        return original(*args, **kwargs)

    setattr(owner, name, armed)
