"""Wrong command lines: each ends in one error, soon, and leaves nothing behind."""

from __future__ import annotations

import random
import tempfile
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from benchmarks.faults import programs
from benchmarks.faults.isolated import run
from marl_explore.cli import train

WRONG: dict[Any, tuple[str, ...]] = {
    int: ("-1", "1.5", "x", "1e3", str(10**23), "nan"),
    float: ("nan", "-1", "x", "-inf", "1e400x"),
    bool: ("maybe", "2"),
}
"""Values that no option of a type takes."""
GIANT = (
    ("train", "fast", "--height", "1000000", "--width", "1000000"),
    ("train", "fast", "--num-envs", "100000000"),
    ("train", "fast", "--rollout-steps", "1000000000", "--episodes", "10000000000"),
    ("train", "fast", "--hidden", "10000000000", "10000000000"),
    ("train", "fast", "--num-agents", "100000", "--height", "1000", "--width", "1000"),
    ("train", "fast", "--hidden", str(2**62), str(2**62)),
    ("evaluate", "random", "--height", "3000000", "--width", "3000000"),
    ("evaluate", "random", "--num-arenas", "1000000000000"),
    ("evaluate", "random", "--steps", "1000000000000"),
    ("evaluate", "random", "--num-agents", "100000", "--height", "1000", "--width", "1000"),
    ("leaderboard", "random", "--suites", "paper-12", "--num-arenas", "1000000000000"),
    ("lab", "best", "--layouts", "1000000000000"),
    ("train", "fast", "--seeds", "0-99999999999"),
    ("train", "fast", "--seeds", f"{10**30}-{10**30 + 2}"),
    ("train", "fast", "--threads", "100000000"),
    ("evaluate", "random", "--sensing-range", "1e300"),
    ("evaluate", "random", "--cell-size", "1e-300"),
)
OTHERS = (
    ("nothing",),
    ("train",),
    ("train", "slow"),
    ("train", "fast", "--out", ""),
    ("train", "fast", "--out="),
    ("train", "fast", "--out", "/proc/nowhere/run"),
    ("train", "fast", "--out", "file.txt/run"),
    ("train", "fast", "--out", "full"),
    ("train", "fast", "--nothing", "1"),
    ("train", "fast", "--config"),
    ("train", "fast", "--config", "missing.yaml"),
    ("train", "fast", "--config", "file.txt"),
    ("train", "fast", "--config", "full"),
    ("train", "fast", "--config", "wrong.yaml"),
    ("train", "fast", "--config", "deep.json"),
    ("train", "fast", "--config", "a.yaml", "--config", "b.yaml"),
    ("train", "fast", "--init-from", "nobody"),
    ("train", "fast", "--arenas", "nowhere"),
    ("train", "fast", "--reward", "none"),
    ("train", "fast", "--network", "cnn", "--hidden", "8", "8"),
    ("train", "fast", "--collector", "multisync", "--workers", "7"),
    ("train", "fast", "--workers", "2"),
    ("train", "fast", "--ray-address", "auto"),
    ("train", "fast", "--seeds", "1-"),
    ("train", "fast", "--seeds", "a"),
    ("train", "fast", "--seeds", "3-1"),
    ("train", "fast", "--jobs", "0", "--seeds", "0-1"),
    ("resume",),
    ("resume", "nowhere"),
    ("resume", "file.txt"),
    ("resume", "full"),
    ("resume", "."),
    ("resume", "full", "--episodes", "0"),
    ("evaluate",),
    ("evaluate", "nobody"),
    ("evaluate", "file.txt"),
    ("evaluate", "full"),
    ("evaluate", "random", "--arenas", "nowhere"),
    ("evaluate", "random", "--arenas", "file.txt"),
    ("evaluate", "random", "--out", "full"),
    ("evaluate", "random:argmax"),
    ("evaluate", "best:argmin"),
    ("evaluate", "../best"),
    ("evaluate", "best", "--sensing-range", "3.0"),
    ("evaluate", "paper-cnn-case2", "--num-agents", "3"),
    ("explore", "nowhere.png"),
    ("explore", "file.txt"),
    ("explore", "full"),
    ("explore", "file.txt", "--starts", "1,2,3"),
    ("explore", "file.txt", "--free", "300"),
    ("replay",),
    ("replay", "nobody"),
    ("replay", "random", "--arena-index", str(10**22)),
    ("replay", "random", "--out", "full"),
    ("replay", "random", "--out", "/proc/nowhere/x.html"),
    ("export", "random"),
    ("export", "best", "--kinds"),
    ("export", "best", "--kinds", "zip"),
    ("export", "paper-cnn-case2", "--out", "file.txt"),
    ("lab", "nobody"),
    ("lab", "random"),
    ("lab", "paper-cnn-case2", "--out", "full"),
    ("leaderboard", "nobody"),
    ("leaderboard", "a=random,nearest"),
    ("leaderboard", "a=random,random"),
    ("leaderboard", "a="),
    ("leaderboard", "=random"),
    ("leaderboard", "random", "random"),
    ("leaderboard", "random", "--suites"),
    ("leaderboard", "random", "--suites", "nowhere"),
    ("leaderboard", "random", "--out", "full"),
    ("variants",),
    ("variants", "a"),
    ("variants", "a=nobody"),
    ("variants", "a=best", "a=best"),
    ("variants", "a=random"),
    ("paper",),
    ("paper", "mlp"),
    ("paper", "mlp-case1=nobody"),
    ("paper", "mlp-case1=random"),
    ("paper", "mlp-case9=best"),
    ("bundle",),
    ("bundle", "a"),
    ("bundle", "a=nowhere"),
    ("bundle", "a/../x=full", "--out", "o"),
    ("bundle", "../x=full", "--out", "o"),
    ("bundle", "=full"),
    ("demo", "--out", "full"),
    ("demo", "--out", ""),
    ("demo", "--episodes", "0"),
)
PREFIXES = {
    "train": ("train", "fast"),
    "demo": ("demo",),
    "evaluate": ("evaluate", "random"),
    "explore": ("explore", "map.map"),
    "export": ("export", "best"),
    "lab": ("lab", "paper-cnn-case2"),
    "leaderboard": ("leaderboard", "random", "--suites", "paper-12"),
    "replay": ("replay", "random"),
    "variants": ("variants", "a=best"),
    "paper": ("paper", "mlp-case1=best"),
}


def wrong_lines() -> list[tuple[str, ...]]:
    """Every wrong value of every option, then giants and other faults."""
    lines = [(*prefix, *fault) for name, prefix in PREFIXES.items() for fault in _faults(name)]
    return [*GIANT, *OTHERS, *lines]


def refuse_lines(number: int) -> list[str]:
    """Run ``number`` wrong command lines; returns those that were not refused in one error."""
    first, rest = [*GIANT, *OTHERS], wrong_lines()[len(GIANT) + len(OTHERS) :]
    lines = (first + random.Random(0).sample(rest, len(rest)))[:number]
    faults: list[str] = []
    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        _furnish(home)
        before = _tree(home)
        for line in lines:
            outcome = run(programs.command, *line, folder=home)
            said = f"{' '.join(line)!r}: {outcome.status}, {outcome.output[-300:]}"
            if outcome.crashed or not outcome.refused or "dummy" in outcome.output:
                faults.append(said)
            if (after := _tree(home)) != before:
                faults.append(f"{' '.join(line)!r} left {sorted(after ^ before)}")
                before = after
    print(f"command lines: {len(lines)}, {len(faults)} faults")
    return faults


def _furnish(home: Path) -> None:
    """Files and folders that wrong lines name."""
    (home / "full").mkdir()
    (home / "full" / "something").write_text("x")
    (home / "file.txt").write_text("x\n")
    (home / "map.map").write_text("type octile\nheight 2\nwidth 2\nmap\n..\n..\n")
    for name in ("a.yaml", "b.yaml"):
        (home / name).write_text("seed: 1\n")
    (home / "wrong.yaml").write_text("actor_lr: fast\nunknown: 1\n")
    (home / "deep.json").write_text('{"a":' * 100_000 + "1" + "}" * 100_000)


def _tree(home: Path) -> set[str]:
    return {str(path.relative_to(home)) for path in home.rglob("*")}


def _faults(name: str) -> Iterator[tuple[str, ...]]:
    kinds = {"train": train.Start}
    module = import_module(f"marl_explore.cli.{name}")
    for option, hint in _options(kinds.get(name, getattr(module, "Arguments", None))):
        flag = "--" + option.replace("_", "-")
        values = WRONG.get(hint, ())
        if get_origin(hint) is Literal:
            values = ("nothing", "")
        for value in values:
            yield flag, value
        if values:
            yield (flag,)  # without a value


def _options(kind: Any) -> Iterator[tuple[str, Any]]:
    """Names and types of the options of a command, those of its groups included."""
    hints = get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        hint = hints[field.name]
        if get_origin(hint) is Annotated:
            continue  # an argument without a flag
        if get_origin(hint) in (Union, UnionType):
            hint = next(part for part in get_args(hint) if part is not type(None))
        if is_dataclass(hint) and field.name != "network":
            yield from _options(hint)
        else:
            yield field.name, hint
