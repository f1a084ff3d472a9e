"""What command lines start from."""

from __future__ import annotations

import pytest

from marl_explore import ArenaConfig, cli
from marl_explore.policies import Policy, PolicySpec, save_policy


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ([], None),
        (["random"], None),
        (["random", "--arenas", "rooms-32"], "rooms-32"),
        (["--arenas=rooms-32", "random"], "rooms-32"),
        (["--arenas"], None),
        (["--num-arenas", "5"], None),
    ],
)
def test_arenas_named_on_a_command_line(words, named):
    assert (cli.named_arenas(words) or None) == named


def test_a_task_starts_from_the_policys_robots_and_the_suites_size(tmp_path):
    spec = PolicySpec(ArenaConfig(height=9, width=9, num_agents=3), "mlp", (8,), "relative")
    policy = Policy(spec, spec.make_actors())
    file = save_policy(
        policy, tmp_path / "a.safetensors", info={"config": {"arenas": "open-24-v1"}}
    )
    assert cli.default_task([]) == (ArenaConfig(), "uniform")
    assert cli.default_task(["random", str(file)]) == (spec.arena, "open-24-v1")
    arena, arenas = cli.default_task(["--arenas", "rooms-32", str(file)])
    assert arenas == "rooms-32"
    assert arena == ArenaConfig(height=32, width=32, obstacle_density=0.15, num_agents=3)
