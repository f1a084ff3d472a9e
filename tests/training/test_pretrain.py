"""Policies that come with the package: made from a run, and replayed to their recorded scores."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import pytest
import torch

from marl_explore import list_policies, load_policy
from marl_explore.config.run import RunConfig
from marl_explore.policies.io import policy_info
from marl_explore.policies.networks import MLP
from marl_explore.training import run_folder, runs
from marl_explore.training.config import TrainConfig
from marl_explore.training.presets import PRESETS
from marl_explore.training.pretrain import bundle, recorded_replay, replay_score
from tests.helpers.configs import tiny

TINY = tiny(network=MLP(hidden=(8, 8)), episodes=4, num_envs=2, ppo_epochs=5)


def test_best_is_a_run_of_its_preset():
    trained = TrainConfig.from_json(policy_info("best")["config"])
    assert trained == replace(PRESETS["best"], seed=trained.seed)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    runs.train(TINY, folder, RunConfig(validate_every=0), progress=False)
    return folder


def test_a_bundled_policy_replays_to_what_is_recorded_with_it(run, tmp_path):
    path = bundle(run, "tiny", tmp_path)
    assert path == tmp_path / "tiny.safetensors"
    first, again = (replay_score(load_policy(path)) for _ in range(2))
    assert first == again == recorded_replay(path)
    assert len(first["steps_to_100"]) == 20
    assert len(set(first["steps_to_100"])) > 5


def test_a_bundled_policy_says_where_it_comes_from(run, tmp_path):
    info = policy_info(bundle(run, "tiny", tmp_path))
    assert info["config"] == json.loads((run / "config.json").read_text())
    assert torch.__version__.startswith(info["run"]["starts"][0]["versions"]["torch"])
    assert [frames for frames, _ in info["curves"]["entropy"]] == [20, 40]
    assert 0 < info["score"]["steps_to_100"] <= 301


def test_it_is_the_runs_policy_in_half_precision(run, tmp_path):
    ours, theirs = (load_policy(path).state_dict() for path in (bundle(run, "t", tmp_path), run))
    for key, value in theirs.items():
        assert ours[key].equal(value.half().float()), key


def test_another_policy_replays_to_another_score(run, tmp_path):
    path = bundle(run, "tiny", tmp_path)
    policy = load_policy(path)
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.mul_(-1)
    assert replay_score(policy) != recorded_replay(path)


def test_it_is_scored_on_arenas_of_the_kind_it_was_trained_on(tmp_path):
    arena = replace(TINY.arena, height=12, width=12)
    folder = tmp_path / "run"
    runs.train(replace(TINY, arena=arena, arenas="mixed"), folder, RunConfig(), progress=False)
    path = bundle(folder, "mixed", tmp_path)
    assert replay_score(load_policy(path), arenas="mixed") == recorded_replay(path)
    assert replay_score(load_policy(path)) != recorded_replay(path)


def test_an_unfinished_run_is_refused(run, tmp_path):
    run_folder.prepare(TINY, tmp_path / "new", RunConfig())
    shutil.copy(run / "policy.safetensors", tmp_path / "new")
    with pytest.raises(ValueError, match="is not finished"):
        bundle(tmp_path / "new", "tiny", tmp_path)
    assert not (tmp_path / "tiny.safetensors").exists()


def test_every_policy_of_the_package_replays_to_its_exact_score():
    for name in list_policies():
        assert replay_score(load_policy(name)) == recorded_replay(name), name
