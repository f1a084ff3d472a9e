"""Policies as files: saved and loaded whole, with their features, or refused."""

from __future__ import annotations

import json

import pytest
import torch
from safetensors.torch import save_file
from torchrl.envs import ExplorationType, set_exploration_type

from marl_explore import ArenaConfig, ExplorationEnv, list_policies, load_policy, make_env
from marl_explore.core.links import within_range
from marl_explore.policies.actors import probabilistic_actor
from marl_explore.policies.io import FORMAT, policy_info, save_policy
from marl_explore.policies.networks import DeepSet
from marl_explore.policies.policy import Policy, PolicyConfig
from marl_explore.utils.tensor_files import write_tensors
from tests.helpers.configs import NETWORKS


def a_policy(network="mlp", fpr="proximity", ablate=(), shared=False, **arena):
    torch.manual_seed(0)
    config = PolicyConfig(ArenaConfig(**arena), NETWORKS[network], fpr, ablate, shared)
    policy = Policy(config, config.make_actors())
    for parameter in policy.parameters():  # away from the nearly uniform start
        torch.nn.init.normal_(parameter, std=0.5)
    return policy


@pytest.mark.parametrize("options", [{}, {"ablate": ("fpr", "communication")}, {"shared": True}])
@pytest.mark.parametrize("network", ["mlp", "cnn"])
def test_a_loaded_policy_acts_as_the_saved_one(tmp_path, network, options):
    policy = a_policy(network, **options)
    path = save_policy(policy, tmp_path / "team.safetensors", info={"seed": 3})
    loaded = load_policy(path)
    assert loaded.config == policy.config
    assert policy_info(path) == {"seed": 3}
    td = ExplorationEnv(num_envs=30).rollout(10)[:, -1]
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = policy(td.clone())["agents", "action"]
        assert torch.equal(loaded(td.clone())["agents", "action"], expected)


def test_a_policy_computes_the_features_it_was_trained_on():
    policy = a_policy(fpr="proximity")
    trained_on = make_env(num_envs=30, fpr="proximity").rollout(10)[:, -1]
    elsewhere = trained_on.exclude(
        ("agents", "observation", "fpr"), ("agents", "observation", "net")
    )
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = probabilistic_actor(policy.team.stacked)(trained_on.clone())["agents", "action"]
        assert torch.equal(policy(elsewhere)["agents", "action"], expected)


def test_a_policy_adds_nothing_but_actions():
    td = ExplorationEnv(num_envs=2).reset()
    keys = set(td.keys(True, True))
    assert set(a_policy()(td).keys(True, True)) == keys | {("agents", "action")}


def test_a_policy_acts_on_larger_arenas():
    env = ExplorationEnv(ArenaConfig(height=20, width=30), num_envs=2)
    assert env.rollout(3, a_policy())["agents", "action"].shape == (2, 3, 4)


def test_a_policy_hears_as_far_as_the_radio_reaches():
    config = ArenaConfig(communication_range=0.5)
    policy = a_policy(fpr="relative")
    td = make_env(config, num_envs=50).rollout(3)[:, -1]
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = policy.team(td.clone())["agents", "action"]
        assert torch.equal(policy(td.clone())["agents", "action"], expected)


def test_a_run_folder_stands_for_its_policy(tmp_path):
    save_policy(a_policy(), tmp_path)
    assert load_policy(tmp_path).config.fpr == "proximity"
    assert [p.name for p in tmp_path.iterdir()] == ["policy.safetensors"]


@pytest.mark.parametrize(
    ("arena", "message"),
    [
        ({"num_agents": 3}, "trained for num_agents=4, and the environment has 3 robots"),
        ({"sensing_range": 1.8}, "trained for fov_radius=1, .* 5 x 5"),
    ],
)
def test_another_team_or_sensor_is_refused(arena, message):
    env = ExplorationEnv(ArenaConfig(**arena), num_envs=2)
    with pytest.raises(ValueError, match=message):
        a_policy()(env.reset())


def test_bundled_policies_load():
    for name in list_policies():
        load_policy(name)


def test_what_is_no_policy_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no policy 'nobody'"):
        load_policy("nobody")
    with pytest.raises(ValueError, match=f"no policy '{tmp_path}'"):
        load_policy(tmp_path)
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(b"not weights")
    with pytest.raises(ValueError, match=r"broken.safetensors is not a readable policy file"):
        load_policy(broken)
    foreign = tmp_path / "foreign.safetensors"
    save_file({"w": torch.zeros(1)}, foreign)
    with pytest.raises(ValueError, match=r"foreign.safetensors is not a policy of this package"):
        load_policy(foreign)
    with pytest.raises(ValueError, match="the folder does not exist"):
        save_policy(a_policy(), tmp_path / "nowhere" / "team.safetensors")
    for name, spec in (("empty", {}), ("odd", {"arena": {"depth": 3}, "hidden": []})):
        path = tmp_path / f"{name}.safetensors"
        texts = {"spec": json.dumps(spec), "info": "{}"}
        write_tensors(path, FORMAT, texts, {"w": torch.zeros(1)})
        with pytest.raises(ValueError, match=f"the spec of .*{name}.safetensors: network=None"):
            load_policy(path)
    whole = save_policy(a_policy(), tmp_path / "whole.safetensors").read_bytes()
    (tmp_path / "cut.safetensors").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"cut.safetensors is not a readable policy file"):
        load_policy(tmp_path / "cut.safetensors")


def a_policy_for_any_team():
    torch.manual_seed(0)
    spec = PolicyConfig(ArenaConfig(), NETWORKS["deepset"], "proximity", shared=True)
    policy = Policy(spec, spec.make_actors())
    for parameter in policy.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return policy


@pytest.mark.parametrize("robots", [1, 2, 8])
def test_one_policy_acts_for_any_team_on_any_arena(tmp_path, robots):
    path = save_policy(a_policy_for_any_team(), tmp_path / "team.safetensors")
    env = ExplorationEnv(ArenaConfig(height=20, width=9, num_agents=robots), num_envs=5)
    td = env.rollout(10, policy=load_policy(path))
    assert td["agents", "action"].shape == (5, 10, robots)
    chosen = td["agents", "action_mask"].gather(-1, td["agents", "action"].unsqueeze(-1))
    assert chosen.all()


@pytest.mark.parametrize(("every", "times"), [(1, range(6)), (3, (0, 3)), (6, (0,))])
def test_actors_communicate_when_the_clock_says_so(every, times):
    network = DeepSet(hidden=(8,), communicate_every=every)
    spec = PolicyConfig(ArenaConfig(), network, "proximity", shared=True)
    policy = Policy(spec, spec.make_actors())
    td = ExplorationEnv(num_envs=200).rollout(30, policy=policy)
    steps = td["step_count"].squeeze(-1)[td["agents", "action"].eq(9).any(-1)] % 6
    assert set(steps.tolist()) == set(times)


@pytest.mark.parametrize("after", [1, 4, 7])
def test_actors_communicate_some_time_after_the_last_exchange(after):
    network = DeepSet(hidden=(8,), communicate_after=after)
    spec = PolicyConfig(ArenaConfig(), network, "proximity", shared=True)
    policy = Policy(spec, spec.make_actors())
    td = ExplorationEnv(num_envs=200).rollout(30, policy=policy)
    reach = within_range(td["agents", "position"], ArenaConfig().communication_cells)
    waited = torch.where(reach, td["agents", "steps_since_merge"], -1).amax(-1)
    chosen = waited[td["agents", "action"] == 9]
    assert chosen.min() == after
    assert (waited < after).any()


def test_the_order_of_the_other_robots_does_not_matter():
    policy = a_policy_for_any_team()
    td = ExplorationEnv(num_envs=20).rollout(8)[:, -1]
    observed = policy._features(td.clone())
    inputs = [observed[key] for key in policy.team.observation_keys]
    order = torch.tensor([0, 3, 1, 2])
    other = [
        x[:, :, order] if k[-1] == "teammates" else x
        for k, x in zip(policy.team.observation_keys, inputs, strict=True)
    ]
    torch.testing.assert_close(policy.actors[0](*inputs), policy.actors[0](*other))
    assert not torch.equal(inputs[4], other[4])
