"""The files of a run folder that say what the run is and how far it came."""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from marl_explore.arenas import full_name
from marl_explore.config.checks import require_integer
from marl_explore.config.fields import check_types, read_fields
from marl_explore.config.run import RunConfig
from marl_explore.policies.migrate import migrated
from marl_explore.training.config import TrainConfig
from marl_explore.utils.json_files import read_json, write_json
from marl_explore.utils.locks import owned
from marl_explore.utils.records import new_folder

CONFIG_FILE, RECORD_FILE = "config.json", "run.json"

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunRecord:
    """How a run was made: the content of ``run.json``."""

    execution: RunConfig
    starts: tuple[dict[str, Any], ...] = ()
    """Of every start, command, versions and time, and the updates done before."""
    seconds: float | None = None
    """Time that a finished run took."""
    frames: int | None = None
    """Steps of single arenas that a finished run did."""
    finished: bool = False

    def __post_init__(self) -> None:
        """Raise an error for fields that are not allowed."""
        check_types(self)

    def finishes(self, config: TrainConfig) -> bool:
        """Whether all updates of a configuration are done."""
        return self.finished and self.frames == config.updates * config.batch_frames

    def to_json(self) -> dict[str, Any]:
        """The content of the file; what is not known yet is left out."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    def write(self, folder: Path) -> None:
        """Write the file of a run folder."""
        write_json(folder / RECORD_FILE, self.to_json())


def prepare(config: TrainConfig, folder: str | Path, run: RunConfig) -> Path:
    """Make a run folder without checkpoints, which ``resume`` starts from the beginning.

    Raises:
        ValueError: when the folder is in use.
        OSError: when it cannot be written.
    """
    config = replace(config, arenas=full_name(config.arenas))
    folder = new_folder(folder)
    RunRecord(run).write(folder)
    write_json(folder / CONFIG_FILE, config.to_json())  # last: it makes the folder that of a run
    return folder


def read_config(folder: Path) -> TrainConfig:
    """What the run in a folder learns.

    Raises:
        ValueError: naming file and field, when it is not a run folder or a setting is wrong.
    """
    path = folder / CONFIG_FILE
    if not path.is_file():
        raise ValueError(f"{folder} is not a run folder: it has no {CONFIG_FILE}")
    return TrainConfig.from_json(migrated(read_json(path)), str(path))


def read_record(folder: Path) -> RunRecord:
    """How the run in a folder was made; a run without ``run.json`` has the default settings.

    Raises:
        ValueError: naming file and field, when a field is wrong.
    """
    path = folder / RECORD_FILE
    if not path.exists():
        logger.warning("%s is missing: the run goes on with the default execution settings", path)
        return RunRecord(RunConfig())
    return read_fields(RunRecord, read_json(path), str(path))


def is_finished(folder: Path) -> bool:
    """Whether the run in a folder has done all its updates.

    Raises:
        ValueError: as for ``read_config`` and ``read_record``.
    """
    return read_record(folder).finishes(read_config(folder))


def lengthen(folder: str | Path, episodes: int) -> None:
    """Make a run longer, whether it is finished or not; ``resume`` does the rest.

    The result is that of a run of this length from the start. With ``lr_decay`` it is not:
    learning rates keep the schedule of the first length, and then stay at their final value.

    Args:
        folder: of the run.
        episodes: of the whole run, at least as many as now.

    Raises:
        ValueError: for fewer episodes, or too few for another update, when it is not a run folder,
            or another process owns it.
    """
    folder = Path(folder)
    longer(folder, episodes)
    with owned(folder):
        write_longer(folder, episodes)


def longer(folder: Path, episodes: int) -> TrainConfig:
    """The configuration of a run with this length; errors as for ``lengthen``."""
    config = read_config(folder)
    require_integer("episodes", episodes, 1)
    new = replace(config, episodes=max(episodes, config.episodes))
    if episodes < config.episodes or (new != config and new.updates == config.updates):
        update = config.batch_frames / config.episode_steps
        raise ValueError(
            f"episodes={episodes} is not allowed: the run in {folder} has {config.episodes}, and "
            f"can only be made longer, by whole updates of {update:g} episodes"
        )
    return new


def write_longer(folder: Path, episodes: int) -> None:
    """As ``lengthen``, by a process that owns the folder."""
    config = longer(folder, episodes)
    if config != read_config(folder):
        write_json(folder / CONFIG_FILE, config.to_json())
