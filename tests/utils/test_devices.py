"""Devices by name; what runs on others than the CPU is not tested."""

from __future__ import annotations

import pytest
import torch

from marl_explore import ArenaConfig, TrainConfig
from marl_explore.cli.main import main
from marl_explore.config.run import RunConfig
from marl_explore.evaluation.episodes import record
from marl_explore.planners.random import RandomWalk
from marl_explore.training.trainer import Trainer
from marl_explore.utils.devices import find_device

NONE = {
    "tpu": "it must be cpu, cuda, or cuda:1, ...",
    "cuda:": "it must be cpu, cuda, or cuda:1, ...",
    "cpu:0": "it must be cpu, cuda, or cuda:1, ...",
    "meta": "it must be cpu, cuda, or cuda:1, ...",
    "cuda:200": "torch finds .* CUDA devices here",
}


@pytest.mark.parametrize(("name", "allowed"), NONE.items())
def test_devices_that_there_are_not_are_refused_by_name(name, allowed):
    for use in (
        find_device,
        lambda device: Trainer(TrainConfig(episodes=8), RunConfig(device=device)),
        lambda device: record(RandomWalk(), ArenaConfig(), 1, 1, device=device),
    ):
        with pytest.raises(ValueError, match=f"device='{name}' is not allowed: {allowed}"):
            use(name)


def test_the_cpu_is_a_device():
    assert find_device("cpu") == torch.device("cpu")


def test_workers_collect_on_the_cpu():
    with pytest.raises(ValueError, match="device='cuda' is not allowed with collector='multisync'"):
        RunConfig(collector="multisync", workers=2, device="cuda")


@pytest.mark.parametrize("command", [("evaluate", "random"), ("leaderboard", "random")])
def test_commands_refuse_a_device_before_they_begin(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="device='cuda:200' is not allowed"):
        main([*command, "--device", "cuda:200"])
    assert not any(tmp_path.rglob("*.json"))
