"""BenchMARL's algorithms on the exploration task, and HAPPO on its own tasks, in short."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest
import torch

# first: it makes the others fit this TorchRL
from marl_explore.adapters.benchmarl import ExplorationTask, HappoConfig  # isort: skip

from benchmarl.algorithms import IppoConfig, MappoConfig, QmixConfig
from benchmarl.environments import VmasTask
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models import GruConfig, MlpConfig
from torch import nn

from marl_explore import ArenaConfig
from marl_explore.utils.tables import number

pytestmark = pytest.mark.filterwarnings("ignore")  # BenchMARL's and VMAS's own

ROOT = Path(__file__).parents[3]
SMALL = ArenaConfig(height=6, width=6, num_agents=3)


def task(**config):
    return ExplorationTask({"config": SMALL, "max_steps": 20, "reward": "team", **config})


class Recorder(Callback):
    """Keeps what every update gives BenchMARL to log."""

    def __init__(self):
        super().__init__()
        self.updates = []

    def on_train_end(self, training_td, group):
        self.updates.append((group, training_td))


def network():
    return MlpConfig(num_cells=[16], activation_class=nn.Tanh, layer_class=nn.Linear)


def experiment(task, algorithm, folder, callbacks=(), model=None, **changes):
    """A small experiment, not yet run."""
    config = ExperimentConfig.get_from_yaml()
    settings = {
        "max_n_iters": 2,
        "max_n_frames": None,
        "on_policy_collected_frames_per_batch": 200,
        "on_policy_n_envs_per_worker": 10,
        "on_policy_n_minibatch_iters": 2,
        "on_policy_minibatch_size": 100,
        "off_policy_collected_frames_per_batch": 200,
        "off_policy_n_envs_per_worker": 10,
        "off_policy_n_optimizer_steps": 2,
        "off_policy_train_batch_size": 32,
        "off_policy_memory_size": 1000,
        "loggers": [],
        "create_json": False,
        "evaluation": False,
        "render": False,
        "save_folder": str(folder),
    }
    for name, value in (settings | changes).items():
        assert hasattr(config, name), name
        setattr(config, name, value)
    return Experiment(
        task=task,
        algorithm_config=algorithm,
        model_config=model or network(),
        critic_model_config=network(),
        seed=0,
        config=config,
        callbacks=[*callbacks],
    )


def assert_learns(task, algorithm, folder, **changes):
    """Every loss is finite, and every parameter of every group moves and stays finite."""
    recorder = Recorder()
    run = experiment(task, algorithm, folder, callbacks=[recorder], **changes)
    before = {group: weights(loss) for group, loss in run.losses.items()}
    policies = weights(run.policy)
    run.run()
    assert [group for group, _ in recorder.updates] == [*run.losses] * 2
    for _, logged in recorder.updates:
        assert any(key.startswith("loss") for key in logged.keys())  # noqa: SIM118
        assert all(value.isfinite().all() for value in logged.values())
    assert unmoved(run.policy, policies) == []
    for group, loss in run.losses.items():
        moving = [name for name in before[group] if "target" not in name]
        assert not set(moving) & set(unmoved(loss, before[group]))
    return run, [logged for _, logged in recorder.updates]


def weights(module):
    return {name: parameter.clone() for name, parameter in module.named_parameters()}


def unmoved(module, before):
    after = dict(module.named_parameters())
    assert all(parameter.isfinite().all() for parameter in after.values())
    return [name for name, parameter in after.items() if parameter.equal(before[name])]


@pytest.mark.parametrize("algorithm", [MappoConfig, IppoConfig, QmixConfig, HappoConfig])
def test_algorithms_train_on_the_exploration_task(tmp_path, algorithm):
    run, _ = assert_learns(task(), algorithm.get_from_yaml(), tmp_path)
    assert run.total_frames == 400


@pytest.mark.parametrize("algorithm", [MappoConfig, HappoConfig])
def test_algorithms_train_where_robots_fail(tmp_path, algorithm):
    wide = {
        **asdict(SMALL),
        "sensing_range": [1.5, 2.0, 2.0],
        "sensing_shape": "disc",
        "line_of_sight": True,
        "failure_rate": 0.05,
        "num_walkers": 1,
    }
    run, _ = assert_learns(task(config=wide), algorithm.get_from_yaml(), tmp_path)
    assert run.total_frames == 400


def test_happo_trains_continuous_actions(tmp_path):
    run, _ = assert_learns(VmasTask.BALANCE.get_from_yaml(), HappoConfig.get_from_yaml(), tmp_path)
    assert run.continuous_actions
    assert len(run.losses["agents"].names) == 4


def test_happo_trains_groups_apart_with_discrete_actions(tmp_path):
    run, _ = assert_learns(
        VmasTask.SIMPLE_TAG.get_from_yaml(),
        HappoConfig.get_from_yaml(),
        tmp_path,
        prefer_continuous_actions=False,
    )
    assert not run.continuous_actions
    assert set(run.losses) == {"adversary", "agent"}


def test_what_happo_logs(tmp_path):
    _, updates = assert_learns(task(), HappoConfig.get_from_yaml(), tmp_path)
    actors = {"loss_objective", "entropy", "kl_approx", "clip_fraction"}
    factor = {f"factor_{name}" for name in ("mean", "min", "max", "ess")}
    critic = {"loss_critic", "explained_variance", "grad_norm_loss_critic"}
    for logged in updates:
        assert set(logged.keys()) == actors | factor | critic
        assert (logged["factor_min"] > 0).all()
        assert (logged["factor_min"] < logged["factor_mean"]).all()
        assert (logged["factor_mean"] < logged["factor_max"]).all()
        assert (logged["factor_ess"] > 0).all()
        assert (logged["factor_ess"] < 1).all()


def test_happo_is_evaluated_and_goes_on_from_a_checkpoint(tmp_path):
    options = {"evaluation": True, "evaluation_interval": 200, "evaluation_episodes": 3}
    first = experiment(
        task(),
        HappoConfig.get_from_yaml(),
        tmp_path,
        loggers=["csv"],
        checkpoint_at_end=True,
        **options,
    )
    first.run()
    (measured,) = tmp_path.rglob("eval_reward_episode_reward_mean.csv")
    assert len(measured.read_text().splitlines()) == 2
    (checkpoint,) = tmp_path.rglob("checkpoint_*.pt")
    second = Experiment.reload_from_file(str(checkpoint))
    assert second.n_iters_performed == 2
    for name, parameter in weights(first.policy).items():
        assert parameter.equal(weights(second.policy)[name])


def test_a_team_s_reward_is_its_mean_and_its_end_the_environment_s(tmp_path):
    run = experiment(VmasTask.BALANCE.get_from_yaml(), HappoConfig.get_from_yaml(), tmp_path)
    batch = next(iter(run.collector))
    after = batch["next"]
    after["agents", "reward"] = torch.rand(*batch.shape, 4, 1)
    after["agents", "done"] = torch.ones(*batch.shape, 4, 1, dtype=torch.bool)
    ended = after["done"].clone()
    run.algorithm.process_batch("agents", batch)
    torch.testing.assert_close(after["reward"], after["agents", "reward"].mean(-2))
    assert torch.equal(after["done"], ended)


def test_actors_are_updated_one_after_the_other(tmp_path, monkeypatch):
    run = experiment(task(), HappoConfig.get_from_yaml(), tmp_path, max_n_iters=1)
    loss, seen = run.losses["agents"], []
    monkeypatch.setattr(loss, "update_order", lambda *_: ["agents_2", "agents_0", "agents_1"])
    original = loss.actor_loss

    def watched(data, name):
        factor = data.get("factor", torch.ones(1))
        seen.append((name, bool((factor != 1).any())))
        return original(data, name)

    monkeypatch.setattr(loss, "actor_loss", watched)
    run.run()
    steps = [("agents_2", False)] * 4 + [("agents_0", True)] * 4 + [("agents_1", True)] * 4
    assert seen == steps  # two passes over two minibatches each


def test_the_team_acts_as_its_actors_do(tmp_path):
    run = experiment(task(), HappoConfig.get_from_yaml(), tmp_path)
    batch = next(iter(run.collector))
    team = run.algorithm.get_policy_for_loss("agents")
    for i, (name, actor) in enumerate(team.actors.items()):
        apart = team.split(batch, [*team.in_keys, *team.out_keys])
        log_prob = actor.get_dist(apart).log_prob(apart[name, "action"])
        torch.testing.assert_close(log_prob[..., 0], batch["agents", "log_prob"][..., i])
        assert batch["agents", "action_mask"].gather(-1, batch["agents", "action"][..., None]).all()


def test_wrong_arguments_are_named(tmp_path):
    with pytest.raises(ValueError, match="max_steps=0"):
        task(max_steps=0)
    with pytest.raises(ValueError, match="height=0"):
        ExplorationTask({"config": {"height": 0}})
    wrong = {"share_param_critic": False, "critic_coef": 0.5, "loss_critic_type": "l1"}
    for name, value in (wrong | {"minibatch_advantage": True}).items():
        algorithm = HappoConfig.get_from_yaml()
        setattr(algorithm, name, value)
        with pytest.raises(ValueError, match=f"{name}={value!r} is not allowed"):
            experiment(task(), algorithm, tmp_path)
    recurrent = GruConfig.get_from_yaml()
    with pytest.raises(ValueError, match="model_config=.*is recurrent"):
        experiment(task(), HappoConfig.get_from_yaml(), tmp_path, model=recurrent)


def test_the_recipe_prints_and_keeps_returns(tmp_path):
    out = tmp_path / "out"
    options = "--algorithms qmix happo --iterations 2 --out".split()
    command = [sys.executable, str(ROOT / "recipes" / "benchmarl_exploration.py"), *options, out]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    returns = json.loads((out / "run.json").read_text())["returns"]
    assert [*returns] == ["qmix", "happo"]
    rows = [
        line.split() for line in done.stdout.splitlines() if line.split()[:1] != ["BenchMARL's"]
    ]
    shown = {row[0]: row[1:3] for row in rows}
    for name, curve in returns.items():
        assert len(curve) == 2
        assert shown[name] == [number(value) for value in curve]
    again = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert again.returncode == 1
    assert again.stderr.splitlines()[-1].startswith("error: output folder")
