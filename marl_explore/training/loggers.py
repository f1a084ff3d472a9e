"""Logging of metrics: to CSV files and, by name, to one of TorchRL's other loggers."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from errno import ENOENT
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from torchrl.record.loggers import Logger, MLFlowLogger
from torchrl.record.loggers.utils import get_logger

from marl_explore.config.run import LoggerName
from marl_explore.utils.curves import rewind
from marl_explore.utils.files import naming

PACKAGES: dict[str, tuple[str, ...]] = {
    "tensorboard": ("tensorboard",),
    "wandb": ("wandb",),
    "mlflow": ("mlflow", "omegaconf"),
}
"""Packages that a logger needs in addition to this package's dependencies."""
PROJECT = "marl_explore"


def require_logger(name: LoggerName) -> None:
    """Raise an error for a logger whose package is not installed.

    Raises:
        ValueError: naming the package to install.
    """
    missing = [package for package in PACKAGES.get(name, ()) if find_spec(package) is None]
    if missing:
        packages = " ".join(missing)
        raise ValueError(f"logger={name!r} needs {packages}: pip install {packages}")


class Loggers:
    """Writes every metric to ``scalars/NAME.csv`` of a run folder, and to another logger.

    Args:
        name: "tensorboard", "wandb" or "mlflow"; "csv" for no other logger.
        folder: of the run.
        settings: of the run, nested; logged as hyper-parameters.
        frames: steps of single arenas already done. Later rows of the CSV files are dropped: they
            are of updates that were lost and will be repeated.
    """

    def __init__(
        self, name: LoggerName, folder: Path, settings: Mapping[str, Any], frames: int
    ) -> None:
        self._scalars = folder / "scalars"
        for file in self._scalars.glob("*.csv"):
            rewind(file, frames)
        with naming(self._scalars):
            self._loggers = [_open("csv", folder)]
        with suppress(OSError):  # TorchRL makes it; it stays when an earlier run filled it
            (folder / "videos").rmdir()
        if name != "csv":
            self._loggers.append(_open(name, folder))
        for logger in self._loggers:
            logger.log_hparams(_flat(settings))

    def close(self) -> None:
        """Close the CSV files; what a full disk could not take is dropped by ``resume``."""
        files = self._loggers[0].experiment.files
        for file in files.values():
            with suppress(OSError):
                file.close()
        files.clear()

    def log(self, metrics: Mapping[str, float], frames: int) -> None:
        """Write the metrics of an update.

        Raises:
            OSError: naming the file, when one cannot be written.
        """
        if not self._scalars.is_dir():  # TorchRL would make it again, without the earlier rows
            raise FileNotFoundError(ENOENT, "the folder was removed", str(self._scalars))
        for logger in self._loggers:
            for name, value in metrics.items():
                with naming(self._scalars / f"{name}.csv"):
                    logger.log_scalar(name, value, frames)
        # TorchRL's CSV logger keeps everything in memory, which adds up in long runs
        self._loggers[0].experiment.scalars.clear()


def _open(name: str, folder: Path) -> Logger:
    if name == "mlflow":  # get_logger uses MLflow's file store, which MLflow no longer supports
        default = f"sqlite:///{folder.absolute()}/mlflow.db"
        return MLFlowLogger(folder.name, os.environ.get("MLFLOW_TRACKING_URI", default))
    place = folder if name == "wandb" else folder.parent  # the others add the run's name
    return get_logger(name, str(place), folder.name, wandb_kwargs={"project": PROJECT})


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            scalar = isinstance(value, (bool, int, float, str))
            flat[prefix + key] = value if scalar else str(value)
    return flat
