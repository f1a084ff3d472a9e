"""Policies and runs of version 0.1 are read under the names of today."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch

from marl_explore.policies.io import list_policies, load_policy, policy_info
from marl_explore.policies.migrate import migrated
from marl_explore.policies.networks import CNN, MLP, DeepSet
from marl_explore.training import runs
from marl_explore.training.config import TrainConfig
from marl_explore.training.run_folder import read_config, read_record

OLD_RUN = Path(__file__).parents[1] / "data" / "run-0.1"
"""Stopped after three of six updates, and what version 0.1 made of the rest."""


def test_a_run_of_a_frozen_copy_resumes_to_the_weights_it_would_have_had(tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(OLD_RUN, folder)
    policy = runs.resume(folder, progress=False)
    finished = load_policy(OLD_RUN / "finished.safetensors")
    assert policy.config == finished.config
    for ours, theirs in zip(policy.parameters(), finished.parameters(), strict=True):
        torch.testing.assert_close(ours, theirs)  # the last bits are the processor's
    assert load_policy(folder).config == finished.config


def test_a_run_folder_says_what_it_was():
    config, run = read_config(OLD_RUN), read_record(OLD_RUN).execution
    assert config.network == MLP(hidden=(4,))
    assert (config.ablate, config.num_minibatches, config.init_from) == (("net",), 2, None)
    assert run.checkpoint_every == 3


@pytest.mark.parametrize("name", list_policies())
def test_the_bundled_policies_are_read(name):
    config = TrainConfig.from_json(policy_info(name)["config"])
    assert load_policy(name).config.network == config.network


OLD = {"arena": {}, "architecture": "mlp", "hidden": [8, 4], "norm_last": True}


@pytest.mark.parametrize(
    ("changes", "network"),
    [
        ({}, MLP(hidden=(8, 4), norm_last=True)),
        ({"communicate_every": 1, "communicate_after": 0}, MLP(hidden=(8, 4), norm_last=True)),
        ({"architecture": "cnn"}, CNN(hidden=4, state_hidden=(8, 4))),
        (
            {"architecture": "deepset", "communicate_every": 3, "communicate_after": 4},
            DeepSet((8, 4), norm_last=True, communicate_every=3, communicate_after=4),
        ),
    ],
)
def test_options_go_to_the_network(changes, network):
    new = migrated(OLD | {"critic_reads": "state", "minibatches": 3} | changes)
    config = TrainConfig.from_json(new)
    assert config.network == network
    assert (config.critic_input, config.num_minibatches) == ("state", 3)


def test_settings_of_today_are_left_alone():
    told = json.loads(json.dumps(TrainConfig().to_json()))
    assert migrated(told) == told


def test_rewards_of_0_1_have_todays_names():
    old = {"architecture": "mlp", "hidden": [8], "reward": "case2-literal"}
    assert migrated(old)["reward"] == "case2-lone-idle"
