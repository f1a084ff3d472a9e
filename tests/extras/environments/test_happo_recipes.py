"""HAPPO beside TorchRL's MAPPO on VMAS (continuous) and PettingZoo (unlike agents), in short."""

from __future__ import annotations

import csv
import importlib
import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch
from torch.testing import assert_close

# of TorchRL, of VMAS's gym, and of MPE's pygame
pytestmark = pytest.mark.filterwarnings("ignore")

ROOT = Path(__file__).parents[3]
RECIPES = ("happo_vmas", "happo_pettingzoo")
ALGORITHMS = ("happo", "mappo")


@pytest.fixture(autouse=True)
def _recipes_are_found(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "recipes")


@pytest.fixture(params=RECIPES)
def recipe(request) -> ModuleType:
    return importlib.import_module(request.param)


def learner(recipe, sequential=True):
    """A small run of HAPPO, or of MAPPO."""
    arguments = recipe.Arguments(max_steps=5)
    if hasattr(arguments, "num_envs"):
        arguments = replace(arguments, num_envs=10)
    settings = {"frames": 100, "updates": 2, "epochs": 2, "hidden": (16,), "num_minibatches": 1}
    train = replace(arguments.train, **settings)
    torch.manual_seed(0)
    shared = importlib.import_module("happo_mappo")
    return shared.Learner(arguments.make_env(0), 5, train, sequential)


def networks(learner):
    return {**learner.loss.actor_losses, "critic": learner.loss.critic}


def weights(module):
    return [parameter.detach().clone() for parameter in module.parameters()]


def moved(module, before):
    pairs = zip(module.parameters(), before, strict=True)
    return [not torch.equal(now, then) for now, then in pairs]


@pytest.mark.parametrize("sequential", [True, False], ids=ALGORITHMS)
def test_every_network_moves_and_stays_finite(recipe, sequential):
    run = learner(recipe, sequential=sequential)
    before = {name: weights(network) for name, network in networks(run).items()}
    steps = [(frames, metrics) for frames, metrics in run.run()]
    assert [frames for frames, _ in steps] == [100, 200]
    for _, metrics in steps:
        assert all(map(math.isfinite, metrics.values()))
        assert metrics["episode_steps"] <= 5
        assert ("factor_ess" in metrics) == sequential
    for name, network in networks(run).items():
        assert all(p.isfinite().all() for p in network.parameters())
        assert all(moved(network, before[name])), name


def test_happo_s_first_actor_learns_as_mappo_s_does_and_the_others_do_not(recipe):
    """Its factor is 1; after it, ratios of the actors before weigh the samples."""
    happo, mappo = (learner(recipe, sequential=sequential) for sequential in (True, False))
    order = happo.loss.names[::-1]
    happo.loss.update_order = lambda *_: order
    batch = collect(happo)
    for run in (happo, mappo):
        run.update(batch.clone())
    first, *others = order
    for mine, theirs in zip(*(actor(run, first) for run in (happo, mappo)), strict=True):
        assert_close(mine, theirs)
    for name in others:
        pairs = zip(*(actor(run, name) for run in (happo, mappo)), strict=True)
        assert not all(torch.allclose(a, b, rtol=1e-5, atol=1e-7) for a, b in pairs), name


def actor(run, name):
    return weights(run.loss.actor_losses[name])


def collect(run):
    """The first batch of a run, as it is before an update."""
    batches = []
    run.update = lambda batch: batches.append(batch.clone()) or {}
    next(run.run())
    del run.update
    return batches[0]


def test_the_last_step_of_an_episode_is_a_truncation(recipe):
    batch = collect(learner(recipe))
    last = batch["next", "step_count"] == 5
    assert last.any()
    assert batch["next", "truncated"][last].all()
    assert not batch["next", "terminated"][last].any()


def test_the_team_gets_the_mean_reward(recipe):
    run = learner(recipe)
    batch, groups = collect(run), run.loss.names
    assert len(groups) >= 2
    mean = sum(batch["next", group, "reward"].squeeze(-1) for group in groups) / len(groups)
    assert_close(batch["next", "reward"], mean)


def test_agents_of_pettingzoo_differ_in_observations_and_actions():
    batch = collect(learner(importlib.import_module("happo_pettingzoo")))
    speaker, listener = batch["speaker_0"], batch["listener_0"]
    assert speaker["observation"].shape[-1] == 3
    assert listener["observation"].shape[-1] == 11
    assert speaker["action"].max() == 2
    assert listener["action"].max() == 4


def test_actions_of_vmas_are_continuous_and_within_their_bounds():
    action = collect(learner(importlib.import_module("happo_vmas")))["agent_0", "action"]
    assert action.is_floating_point()
    assert action.shape[-1] == 2
    assert -1 <= action.min() < 0 < action.max() <= 1


@pytest.mark.parametrize("name", RECIPES)
def test_the_command_writes_runs_curves_and_a_summary(tmp_path, name):
    out = tmp_path / "out"
    short = (
        "--max-steps 5 --frames 100 --updates 2 --num-minibatches 1 --epochs 1 --seeds 0,3".split()
    )
    envs = ["--num-envs", "10"] if name == "happo_vmas" else []
    command = [sys.executable, str(ROOT / "recipes" / f"{name}.py"), *short, *envs, "--out", out]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    first = []
    for algorithm in ALGORITHMS:
        for seed in (0, 3):
            file = out / algorithm / f"seed-{seed}" / "scalars" / "episode_return.csv"
            rows = list(csv.reader(file.read_text().splitlines()))
            assert [int(frames) for frames, _ in rows] == [100, 200]
            first.append(float(rows[0][1]))
    assert first[:2] == first[2:]  # both begin with the same weights and random numbers
    assert first[0] != first[1]
    assert (out / "curves.png").read_bytes().startswith(b"\x89PNG")
    summary = json.loads((out / "summary.json").read_text())
    assert summary["happo"]["episode_return"]["seeds"] == 2
    assert json.loads((out / "run.json").read_text())["settings"]["seeds"] == "0,3"
    again = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert again.returncode == 1
    assert "exists and is not empty" in again.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    ("steps", "label"),
    [("5", "return of an episode"), ("100", "reward")],
    ids=["episodes end", "no episode ends"],
)
@pytest.mark.parametrize("name", RECIPES)
def test_a_single_seed_has_no_interval(tmp_path, name, steps, label):
    short = f"--max-steps {steps} --frames 20 --updates 3 --num-minibatches 1 --epochs 1 --seeds 4"
    envs = ["--num-envs", "2"] if name == "happo_vmas" else []
    command = [sys.executable, str(ROOT / "recipes" / f"{name}.py"), *short.split(), *envs]
    done = subprocess.run(
        [*command, "--out", tmp_path / "out"], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    for algorithm in ALGORITHMS:
        assert ("episode_return" in summary[algorithm]) == (label != "reward")
        (line,) = (row for row in done.stdout.splitlines() if row.startswith(f"{algorithm}: "))
        head, _, value = line.rpartition(" ")
        assert head == f"{algorithm}: {label}"
        assert math.isfinite(float(value))
        assert f"{algorithm}, seed 4: 100%" in done.stderr  # the progress bar
        assert "60/60" in done.stderr
    assert (tmp_path / "out" / "curves.png").read_bytes().startswith(b"\x89PNG")


def test_wrong_settings_and_missing_packages_are_named(recipe):
    with pytest.raises(ValueError, match="updates=0"):
        recipe.Settings(updates=0)
    with pytest.raises(ValueError, match="seeds='x'"):
        recipe.Settings(seeds="x")
    with pytest.raises(ValueError, match="max_steps=0"):
        recipe.Arguments(max_steps=0)
    shared = importlib.import_module("happo_mappo")
    with pytest.raises(ValueError, match=r'needs nothing: pip install "\.\[all\]"'):
        shared.run(recipe.Arguments(), "nothing", "all")
