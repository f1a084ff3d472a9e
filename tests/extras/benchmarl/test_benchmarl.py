"""BenchMARL's algorithms on the exploration task, and HAPPO on its own tasks, in short."""

from __future__ import annotations

import pytest
import torch

# first: it makes the others fit this TorchRL
from marl_explore.adapters.benchmarl import ExplorationTask, HappoConfig  # isort: skip

from benchmarl.algorithms import IppoConfig, MappoConfig, QmixConfig
from benchmarl.environments import VmasTask
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from torch import nn

from marl_explore import ArenaConfig

pytestmark = pytest.mark.filterwarnings("ignore")  # BenchMARL's and VMAS's own

SMALL = ArenaConfig(height=6, width=6, num_agents=3)


def task(**config):
    return ExplorationTask({"config": SMALL, "max_steps": 20, "reward": "team", **config})


def experiment(task, algorithm, folder, **changes):
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
    network = MlpConfig(num_cells=[16], activation_class=nn.Tanh, layer_class=nn.Linear)
    return Experiment(
        task=task,
        algorithm_config=algorithm,
        model_config=network,
        critic_model_config=network,
        seed=0,
        config=config,
    )


def weights(module):
    return {name: parameter.clone() for name, parameter in module.named_parameters()}


def unmoved(module, before):
    after = dict(module.named_parameters())
    assert all(parameter.isfinite().all() for parameter in after.values())
    return [name for name, parameter in after.items() if parameter.equal(before[name])]


@pytest.mark.parametrize("algorithm", [MappoConfig, IppoConfig, QmixConfig, HappoConfig])
def test_algorithms_train_on_the_exploration_task(tmp_path, algorithm):
    run = experiment(task(), algorithm.get_from_yaml(), tmp_path)
    before = weights(run.policy)
    run.run()
    assert run.total_frames == 400
    assert unmoved(run.policy, before) == []


def test_happo_trains_continuous_actions_and_its_shared_critic(tmp_path):
    run = experiment(VmasTask.BALANCE.get_from_yaml(), HappoConfig.get_from_yaml(), tmp_path)
    loss = run.losses["agents"]
    before = weights(loss)
    run.run()
    assert len(loss.names) == 4
    assert unmoved(loss, before) == []


def test_actors_are_updated_one_after_the_other(tmp_path, monkeypatch):
    run = experiment(task(), HappoConfig.get_from_yaml(), tmp_path, max_n_iters=1)
    loss, seen = run.losses["agents"], []
    monkeypatch.setattr(loss, "update_order", lambda: ["agents_2", "agents_0", "agents_1"])
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
    algorithm = HappoConfig.get_from_yaml()
    algorithm.share_param_critic = False
    with pytest.raises(ValueError, match="share_param_critic=False"):
        experiment(task(), algorithm, tmp_path)
