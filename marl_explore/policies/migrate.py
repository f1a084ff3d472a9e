"""Translates settings of version 0.1 to today's names; to be removed once all is retrained.

Run folders, policy files and records of 0.1 used other settings for the network and its options.
``migrated`` is the only place that knows the old names.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

RENAMED = {
    "architecture": "network",
    "without": "ablate",
    "critic_reads": "critic_input",
    "start_from": "init_from",
    "minibatches": "num_minibatches",
}
"""Settings that have been renamed."""
REWARDS = {"case2-literal": "case2-lone-idle"}
"""Rewards that have been renamed."""
OPTIONS = {
    "mlp": ("hidden", "norm_last"),
    "cnn": (),
    "deepset": ("hidden", "norm_last", "communicate_every", "communicate_after"),
}
"""Settings that are now options of a network; those of other networks are dropped."""


def migrated(fields: Mapping[str, Any]) -> dict[str, Any]:
    """The JSON settings of a run or a policy of any version, in today's format.

    Raises:
        ValueError: when they are of version 0.1, and name no network of that version.
    """
    if "architecture" not in fields:
        return dict(fields)
    old = dict(fields)
    kind, hidden = old["architecture"], old.get("hidden")
    if (
        not isinstance(kind, str)
        or kind not in OPTIONS
        or not isinstance(hidden, list)
        or not hidden
    ):
        raise ValueError(
            f"architecture={kind!r} with hidden={hidden!r} is not allowed: it must be one of "
            f"{[*OPTIONS]} with a list of widths"
        )
    options = {name: old[name] for name in OPTIONS[kind] if name in old}
    if kind == "cnn":  # the last width was the actor's layer, all of them the state critic's
        options = {"hidden": old["hidden"][-1], "state_hidden": old["hidden"]}
    for name in {name for names in OPTIONS.values() for name in names} & set(old):
        del old[name]
    if str(old.get("reward")) in REWARDS:
        old["reward"] = REWARDS[old["reward"]]
    return {RENAMED.get(name, name): value for name, value in old.items()} | {"options": options}
