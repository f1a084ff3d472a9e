"""The results file of a benchmark: what others can send, and what is checked of it."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from marl_explore.config.arena import ArenaConfig
from marl_explore.evaluation.benchmark.protocol import SEED, Benchmark, Prepared, find_benchmark
from marl_explore.evaluation.leaderboard.cells import Result
from marl_explore.evaluation.metrics import THRESHOLDS
from marl_explore.evaluation.outside import version_of
from marl_explore.evaluation.registry import is_outside
from marl_explore.utils.files import write_text
from marl_explore.utils.json_files import digest, read_json

FORMAT = "marl_explore.benchmark/1"
KEPT = ("planner", "reference", "sees", "scores", "shares")
"""Of a cell's result; curves and counts stay in the cell."""
TIMES = [f"steps_to_{round(100 * share)}" for share in THRESHOLDS]
SHARES = re.compile(r".*(coverage|ratio).*|complete|finishable|knowledge_lost")
"""Measures in [0, 1]; all others are at least 0."""
_SHA256 = re.compile(r"[0-9a-f]{64}")


def make_results(
    prepared: Prepared,
    entries: Mapping[str, Sequence[Result]],
    checked: Collection[str],
    run: Mapping[str, Any],
) -> dict[str, Any]:
    """What a results file holds.

    Args:
        prepared: the benchmark and its maps.
        entries: of policies by name, the results of one cell per training seed.
        checked: policies of other packages that were tested to be decentralised.
        run: command, versions and machine.
    """
    return {
        "format": FORMAT,
        "benchmark": prepared.benchmark.name,
        "settings": _settings(prepared.benchmark, prepared.suite.config),
        "fingerprint": prepared.suite.digest,
        "maps": [{"name": name, "sha256": sha} for name, sha in prepared.maps.items()],
        "entries": {
            name: [_policy(result, checked) for result in results]
            for name, results in entries.items()
        },
        "run": dict(run),
    }


def _settings(benchmark: Benchmark, config: ArenaConfig) -> dict[str, Any]:
    """All that the numbers depend on but maps and policies; JSON knows no infinity."""
    arena = {name: str(x) if x == math.inf else x for name, x in asdict(config).items()}
    return {"arena": arena, "steps": benchmark.steps, "seed": SEED}


def _policy(result: Result, checked: Collection[str]) -> dict[str, Any]:
    settings = result["settings"]
    policy = settings["policy"]
    return {
        "policy": policy,
        "version": version_of(policy) if is_outside(policy) else None,
        "weights": settings["weights"],
        "code": settings["code"],
        "checked": policy in checked,
        "seconds": result["run"]["seconds"],
        **{name: result[name] for name in KEPT},
    }


def write_results(path: Path, content: Mapping[str, Any]) -> None:
    """Write a results file, with a SHA-256 of what it holds; a line for each part."""
    parts = {"sha256": digest(content), **content}
    lines = (f'"{name}": {json.dumps(part, allow_nan=False)}' for name, part in parts.items())
    write_text(path, "{\n" + ",\n".join(lines) + "\n}\n")


def read_results(path: str | Path) -> dict[str, Any]:
    """What a results file holds, if it is whole and keeps to the protocol.

    Raises:
        ValueError: naming the file and all that is wrong with it.
    """
    content = read_json(Path(path))
    signed = content.pop("sha256", None)
    faults = list(_faults(content, signed))
    if faults:
        raise ValueError(f"{path} is not a benchmark's results: {'; '.join(faults)}")
    return content


def _faults(content: dict[str, Any], signed: object) -> Iterator[str]:
    """What is wrong with a results file, in words."""
    if content.get("format") != FORMAT:
        yield f"its format is {content.get('format')!r} and not {FORMAT!r}"
        return
    if signed != digest(content):
        yield "its contents do not match its SHA-256"
    try:
        benchmark = find_benchmark(content.get("benchmark"))
        yield from _map_faults(benchmark, content["maps"])
        yield from _setting_faults(benchmark, content["settings"])
        if not content["entries"]:
            yield "it has no entries"
        for name, policies in content["entries"].items():
            for policy in policies:
                for fault in _score_faults(policy, len(content["maps"]), benchmark.steps):
                    yield f"entry {name!r}: {fault}"
    except ValueError as error:
        yield str(error)
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        yield f"it is incomplete or of another form ({type(error).__name__}: {error})"


def _map_faults(benchmark: Benchmark, maps: list[dict[str, str]]) -> Iterator[str]:
    found = {entry["name"]: entry["sha256"] for entry in maps}
    if not maps or len(found) < len(maps):
        yield "it has no maps, or one twice"
    if not all(_SHA256.fullmatch(sha) for sha in found.values()):
        yield "a map has no SHA-256"
    if benchmark.map_set is None:
        return
    known = benchmark.map_set.digests
    names = [*known][: benchmark.num_maps]
    if [*found] != names:
        missing = len(set(names) - set(found))
        yield f"its maps are not the {len(names)} of {benchmark.name} in order ({missing} missing)"
    wrong = [name for name, sha in found.items() if name in known and known[name] != sha]
    if wrong:
        yield f"the files of {len(wrong)} maps, such as {wrong[0]}, are not those of the set"


def _setting_faults(benchmark: Benchmark, settings: dict[str, Any]) -> Iterator[str]:
    arena = settings["arena"]
    config = benchmark.config(arena["cell_size"] if benchmark.map_set is None else 0.5)
    wanted = _settings(benchmark, config)
    own = ("height", "width", "obstacle_density")  # of the maps
    expected = {k: v for k, v in wanted.pop("arena").items() if k not in own} | wanted
    given = arena | settings
    for name, value in expected.items():
        if given.get(name) != value:
            yield f"{name} is {given.get(name)!r} and not {value!r}"


def _score_faults(policy: dict[str, Any], num_maps: int, steps: int) -> Iterator[str]:
    scores: dict[str, list[float]] = policy["scores"]
    missing = [name for name in (*TIMES, "complete") if name not in scores]
    if missing:
        yield f"it has no {missing[0]}"
        return
    for name, values in scores.items():
        most = steps + 1 if "steps_to" in name else 1 if SHARES.fullmatch(name) else math.inf
        if len(values) != num_maps:
            yield f"{name} has {len(values)} values for {num_maps} maps"
        elif not all(0 <= x <= most for x in values):
            yield f"{name} has values outside [0, {most}]"
    for name, counts in policy["shares"].items():
        pairs = list(zip(counts["part"], counts["whole"], strict=False))
        if len(pairs) != num_maps or not all(0 <= part <= whole for part, whole in pairs):
            yield f"{name} is no share of events on {num_maps} maps"
    times = list(zip(*(scores[name] for name in TIMES), strict=False))
    if any(list(row) != sorted(map(int, row)) for row in times):
        yield "steps are no integers, or a larger coverage is reached before a smaller one"
    if [row[-1] <= steps for row in times] != scores["complete"]:  # True is 1
        yield "complete contradicts steps_to_100"
