"""What command lines start from."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest

from marl_explore.cli import common as cli
from marl_explore.cli import train
from marl_explore.config.arena import ArenaConfig
from marl_explore.policies.io import save_policy
from marl_explore.policies.networks import CNN, MLP, NETWORKS
from marl_explore.policies.policy import Policy, PolicyConfig
from marl_explore.training.presets import PRESETS
from recipes import train_ray


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
    assert cli.flag_value(words, "--arenas") == named


def test_a_task_starts_from_the_policys_robots_and_the_suites_size(tmp_path):
    spec = PolicyConfig(ArenaConfig(height=9, width=9, num_agents=3), MLP(hidden=(8,)))
    policy = Policy(spec, spec.make_actors())
    file = save_policy(
        policy, tmp_path / "a.safetensors", info={"config": {"arenas": "open-24-v1"}}
    )
    assert cli.default_task([]) == (ArenaConfig(), "uniform")
    assert cli.default_task(["random", str(file)]) == (spec.arena, "open-24-v1")
    arena, arenas = cli.default_task(["--arenas", "rooms-32", str(file)])
    assert arenas == "rooms-32"
    assert arena == ArenaConfig(height=32, width=32, obstacle_density=0.15, num_agents=3)


def test_a_network_on_the_command_line_brings_its_options():
    words = "paper-mlp-case1 --network cnn --hidden 7 --channels 2 3".split()
    assert train.parse(words).train.network == CNN(hidden=7, channels=(2, 3))
    kept = train.parse("best --communicate-every 6 --reward team".split()).train
    assert kept.network == replace(PRESETS["best"].network, communicate_every=6)
    assert train.parse(["best", "--network", "deepset"]).train.critic_input == "state"
    assert train.parse(["paper-mlp-case1", "--network=deepset"]).train.critic_input == "state"


@pytest.mark.parametrize(
    "words", ["--network deepset", "--algorithm happo", "--arenas open-24", "--num-agents 5"]
)
def test_scenes_of_a_preset_make_way_for_what_is_asked_for(words):
    assert train.parse(["best"]).train.scenes == PRESETS["best"].scenes
    assert train.parse(["best", *words.split()]).train.scenes == ()
    asked = train.parse(["best", "--arenas", "open-24", "--scenes", "uniform/2", "uniform/4"])
    assert asked.train.scenes == ("uniform/2", "uniform/4")


def test_the_ray_recipe_asks_for_two_workers_of_ray_unless_told():
    run = train.parse(train_ray.words(["fast"])).run
    assert (run.collector, run.workers) == ("ray", 2)
    assert train.parse(train_ray.words(["fast", "--workers", "5"])).run.workers == 5
    assert train_ray.words(["resume", "runs/a"]) == ["resume", "runs/a"]


def test_an_option_with_the_name_of_another_setting_is_refused(monkeypatch):
    @dataclass(frozen=True)
    class Wide(MLP):
        width: int = 3
        name = "wide"

    monkeypatch.setitem(NETWORKS, "wide", Wide)
    with pytest.raises(ValueError, match="network='wide' .* option 'width' has the name"):
        train.parse(["fast", "--network", "wide"])
