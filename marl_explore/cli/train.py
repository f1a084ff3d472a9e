"""Train a team with HAPPO, MAPPO or IPPO, or resume a stopped run.

marl-explore train fast

marl-explore train paper-cnn-case2 --seed 1 --out runs/cnn-case2-seed1

marl-explore train fast --arenas rooms-32

marl-explore resume runs/cnn-case2-seed1

marl-explore train fast --seeds 0-4 --out runs/fast
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import tyro

from marl_explore.cli.common import fitted, flag_value, parse_words
from marl_explore.cli.config_file import take_config
from marl_explore.cli.resume import Resume
from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require_integer
from marl_explore.config.run import RunConfig, parse_seeds
from marl_explore.policies.networks import NETWORKS
from marl_explore.training.config import TrainConfig
from marl_explore.training.presets import PRESETS


@dataclass(frozen=True)
class Start:
    """Options of ``marl-explore train``."""

    train: TrainConfig = field(default_factory=TrainConfig)
    network: Literal[tuple(NETWORKS)] = "mlp"  # type: ignore[valid-type]
    """Kind of network; its options are separate flags."""
    run: RunConfig = field(default_factory=RunConfig)
    out: Path | None = None
    """New run folder; default: runs/ followed by the time."""
    seeds: str | None = None
    """One run per seed, each in its own folder: 0-4 or 0,2,7; replaces seed."""
    jobs: int | None = None
    """Number of runs side by side, with seeds; default: as many as the cores allow."""

    def __post_init__(self) -> None:
        """Check the arguments."""
        if self.seeds is not None:
            parse_seeds(self.seeds)
        if self.jobs is not None:
            require_integer("jobs", self.jobs, 1)


Arguments = Start | Resume


INSTEAD_OF_SCENES = ("--algorithm", "--num-agents", "--height", "--width")
"""Besides another kind of arenas or network: flags that say what a preset's scenes would."""


def parse(
    words: Sequence[str],
    prog: str = "marl-explore train",
    about: str | None = __doc__,
    run: RunConfig | None = None,
) -> Arguments:
    """Parse a command line: a preset and changes to it, or a run to resume.

    A suite fixes size and density, which other flags then cannot change. With another network, the
    flags of its options replace those of the preset's network. A preset's scenes are left out when
    other arenas, another team, network or algorithm are asked for. With ``--config FILE``, such as
    another run's ``config.json``, a preset need not be named.
    """
    words, file = take_config(words)
    run = run or RunConfig()
    arenas, network = flag_value(words, "--arenas"), flag_value(words, "--network")
    if file is not None:
        arenas, network = arenas or file.get("arenas"), network or file.get("network")

    chosen = words[0] if words and not words[0].startswith("-") else None
    presets = PRESETS
    if arenas or network or any(flag_value(words, flag) for flag in INSTEAD_OF_SCENES):
        presets = {name: replace(config, scenes=()) for name, config in PRESETS.items()}
    defaults = {
        name: _start(config, arenas or "uniform", network, run) for name, config in presets.items()
    }
    if file and chosen is None:  # the file says it all
        start = file.fill(_start(TrainConfig(), arenas or "uniform", network, run))
        return parse_words(Start, words, prog, about, start)
    if file and chosen == "resume":
        raise ValueError("--config is not allowed with train resume: use marl-explore resume")
    if file and chosen in defaults:
        defaults[chosen] = file.fill(defaults[chosen])
    choices: list[Any] = [
        Annotated[
            Start,
            tyro.conf.subcommand(
                name,
                default=defaults[name],
                description=f"{config.network.name}, reward {config.reward}, "
                f"{config.episodes} episodes",
            ),
        ]
        for name, config in PRESETS.items()
    ]
    choices.append(Annotated[Resume, tyro.conf.subcommand("resume")])
    kinds: Any = Union[tuple(choices)]  # noqa: UP007 - made at run time
    return parse_words(kinds, words, prog, about)


def _start(config: TrainConfig, arenas: str, network: str | None, run: RunConfig) -> Start:
    """The defaults of a preset, with a kind of arenas and a network by name."""
    config = replace(config, arena=fitted(config.arena, arenas))
    kind = NETWORKS.get(network or config.network.name, type(config.network))
    taken = {
        field.name for of in (Start, TrainConfig, ArenaConfig, RunConfig) for field in fields(of)
    }
    if clash := taken & {*kind.option_names()}:
        raise ValueError(
            f"network={kind.name!r} cannot be chosen on the command line: its option "
            f"{min(clash)!r} has the name of another setting"
        )
    if not isinstance(config.network, kind):
        critic_input = config.critic_input
        if critic_input not in kind().critic_inputs:
            critic_input = kind().critic_inputs[0]
        config = replace(config, network=kind(), critic_input=critic_input)
    return Start(config, config.network.name, run)


def run(arguments: Arguments) -> None:
    """Train, and print where the results are."""
    from marl_explore.cli import resume
    from marl_explore.training import runs, seeds

    summary = None
    if isinstance(arguments, Resume):
        resume.run(arguments)
        return
    folder = arguments.out or Path("runs") / time.strftime("%Y%m%d-%H%M%S")
    if arguments.seeds is not None:
        wanted = parse_seeds(arguments.seeds)
        summary = seeds.sweep(arguments.train, folder, wanted, arguments.run, arguments.jobs)
    else:
        runs.train(arguments.train, folder, arguments.run)
    resume.report(folder, summary)
