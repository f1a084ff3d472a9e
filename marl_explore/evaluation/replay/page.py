"""The page of a replay: data, style and player in one file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

from tensordict import TensorDictBase

from marl_explore.config.arena import ArenaConfig
from marl_explore.evaluation.replay.data import episode_data
from marl_explore.utils.files import write_text
from marl_explore.utils.palette import robot_color


def write_replay(
    episodes: Mapping[str, Sequence[TensorDictBase]],
    path: str | Path,
    *,
    config: ArenaConfig,
    arena: int = 0,
    about: str = "",
) -> Path:
    """Write episodes as one HTML file that opens from disk in any browser.

    Args:
        episodes: by name, such as the policy's, the observations of an episode in order, each
            with batch [B], as ``evaluation.play`` yields them.
        path: file to write; an earlier one is replaced.
        config: arena, robots and ranges of the episodes.
        arena: row of the batch to show.
        about: a line under the title, such as the command that made the replay.

    Returns:
        The path.

    Raises:
        ValueError: when there is no episode, or one of them does not match ``config`` and
            ``arena``; nothing is written.
    """
    if not episodes:
        raise ValueError("episodes is empty: a replay shows at least one")
    replay = {
        "colors": [robot_color(robot) for robot in range(config.num_agents)],
        "episodes": [
            {"name": name} | episode_data(steps, config, arena) for name, steps in episodes.items()
        ],
    }
    page = Template(_asset("player.html")).substitute(
        title=escape(f"{', '.join(episodes)}: exploration replay"),
        about=escape(about),
        style=_asset("player.css"),
        data=_script_json(replay),
        scene=_asset("scene.js"),
        player=_asset("player.js"),
    )
    path = Path(path)
    write_text(path, page)
    return path


def _asset(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def _script_json(value: object) -> str:
    """JSON for a script element, escaped so that no text in it can close the element."""
    return json.dumps(value, separators=(",", ":")).replace("<", r"\u003c")
