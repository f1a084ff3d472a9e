"""Policies for numpy: the same numbers as torch's, and files that are refused."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torchrl.envs import ExplorationType, set_exploration_type

from marl_explore import ArenaConfig, list_policies, load_policy, make_env
from marl_explore.policies.argmax import ArgmaxPolicy
from marl_explore.policies.export import (
    Deployed,
    example_inputs,
    export_npz,
    robot_observation,
)
from marl_explore.policies.networks import MLP
from marl_explore.policies.policy import Policy
from marl_explore.robot import ExportedPolicy, Observation
from marl_explore.robot.policy import save_arrays
from tests.helpers.configs import NETWORKS
from tests.policies.test_policies import a_policy
from tests.robot.test_policy import arrays_of


def with_last_norm():
    network = replace(NETWORKS["mlp"], norm_last=True)
    config = replace(a_policy().config, network=network)
    return Policy(config, config.make_actors())


def expected(policy, robot, inputs):
    with torch.no_grad():
        return [out.numpy() for out in Deployed(policy.actor_of(robot))(*inputs)]


@pytest.mark.parametrize(
    "options",
    [{}, {"ablate": ("fov", "net", "communication")}, {"shared": True}],
    ids=["full", "without", "shared"],
)
@pytest.mark.parametrize("network", ["mlp", "cnn"])
def test_numpy_agrees_with_torch_on_1000_observations(tmp_path, network, options):
    policy = a_policy(network, **options)
    path = export_npz(policy, tmp_path / "policy.npz")
    for robot in range(4):
        inputs = example_inputs(policy.config.arena, 1000, seed=robot)
        action, logits = expected(policy, robot, inputs)
        exported = ExportedPolicy(path, robot, sample=False)
        ours = exported.masked_logits(*(entry.numpy() for entry in inputs))
        assert np.isneginf(ours).sum() == np.isneginf(logits).sum() > 1000
        np.testing.assert_allclose(ours, logits, rtol=1e-5, atol=1e-4)
        assert (ours.argmax(-1) == action).mean() >= 0.999  # ties of rounding
        one = (
            ours[:1]
            if ours.ndim == 1
            else exported.masked_logits(*(entry[0].numpy() for entry in inputs))
        )
        np.testing.assert_allclose(one, logits[0], rtol=1e-5, atol=1e-4)


def test_a_normalised_last_layer(tmp_path):
    policy = with_last_norm()
    path = export_npz(policy, tmp_path / "policy.npz")
    inputs = example_inputs(policy.config.arena, 100)
    ours = ExportedPolicy(path, 2).masked_logits(*(entry.numpy() for entry in inputs))
    np.testing.assert_allclose(ours, expected(policy, 2, inputs)[1], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("network", "layer", "stretched", "message"),
    [
        ("mlp", "layers.5", np.s_[:1], r"layers.5.weight of shape \(1,\) must have \(16,\)"),
        ("cnn", "encoder.fov.2", np.s_[:, :1], "shape-mismatch"),
    ],
)
def test_weights_that_numpy_would_stretch_are_refused(tmp_path, network, layer, stretched, message):
    policy = with_last_norm() if network == "mlp" else a_policy(network)
    path = export_npz(policy, tmp_path / "policy.npz")
    spec, arrays = arrays_of(path)
    weight, bias = (f"0.{layer}.{kind}" for kind in ("weight", "bias"))
    arrays[weight] = arrays[weight][stretched]
    arrays[bias] = arrays[bias][: len(arrays[weight])]
    with path.open("wb") as file:
        save_arrays(file, spec, arrays)
    with pytest.raises(ValueError, match=f"robot 0 does not fit its spec: {message}"):
        ExportedPolicy(path, 0)


def an_observation(mask):
    fov, fpr, net, _ = (entry[0].numpy() for entry in example_inputs(a_policy().config.arena, 1))
    empty = np.zeros(4, np.int64)
    return Observation(fov, fpr, net, mask, np.zeros((12, 12), np.int8), (0, 0), empty, empty)


def test_actions_are_drawn_with_the_policys_probabilities(tmp_path):
    path = export_npz(a_policy(), tmp_path / "policy.npz")
    mask = np.ones(10, bool)
    mask[[0, 3]] = False
    observation = an_observation(mask)
    policy = ExportedPolicy(path, 1, seed=5)
    logits = policy.masked_logits(*observation[:4])
    counts = np.bincount([policy(observation) for _ in range(4000)], minlength=10)
    chances = np.exp(logits - logits.max())
    chances /= chances.sum()
    assert counts[~mask].sum() == 0
    deviation = np.sqrt(4000 * chances * (1 - chances))
    assert (np.abs(counts - 4000 * chances) <= 4 * deviation + 1).all()
    first, again = (ExportedPolicy(path, 1, seed=5) for _ in range(2))
    assert [first(observation) for _ in range(20)] == [again(observation) for _ in range(20)]


def test_the_likeliest_action_is_taken_on_demand(tmp_path):
    path = export_npz(a_policy(), tmp_path / "policy.npz")
    policy = ExportedPolicy(path, 0, sample=False)
    observation = an_observation(np.ones(10, bool))
    assert policy(observation) == policy.masked_logits(*observation[:4]).argmax()


def test_what_is_no_exported_policy_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"must end in \.npz"):
        export_npz(a_policy(), tmp_path / "policy.onnx")
    with pytest.raises(ValueError, match="existing folder"):
        export_npz(a_policy(), tmp_path / "none" / "policy.npz")
    with pytest.raises(ValueError, match="not an exported policy"):
        ExportedPolicy(tmp_path / "none.npz", 0)
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(ValueError, match="not an exported policy"):
        ExportedPolicy(tmp_path / "text.npz", 0)
    np.savez(tmp_path / "other.npz", spec=np.array('{"format": "other"}'))
    with pytest.raises(ValueError, match="'other', expected 'marl_explore.actors/2'"):
        ExportedPolicy(tmp_path / "other.npz", 0)
    path = export_npz(a_policy(), tmp_path / "policy.npz")
    damaged = bytearray(path.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    (tmp_path / "damaged.npz").write_bytes(damaged)
    with pytest.raises(ValueError, match=r"damaged.npz is not an exported policy: "):
        ExportedPolicy(tmp_path / "damaged.npz", 0)
    with pytest.raises(ValueError, match="robot=4 is not allowed: .* of 4"):
        ExportedPolicy(path, 4)


def test_actors_that_read_more_than_robots_compute_are_refused(tmp_path):
    policy = a_policy("deepset", shared=True)
    with pytest.raises(
        ValueError, match=r"actors that read \('fov', .*'local'\) cannot be exported"
    ):
        export_npz(policy, tmp_path / "policy.npz")
    assert not list(tmp_path.iterdir())


def test_a_network_without_a_numpy_twin_is_refused(tmp_path):
    @dataclass(frozen=True)
    class Twinless(MLP):
        name = "twinless"
        exported_as = None

    config = replace(a_policy().config, network=Twinless(hidden=(4,)))
    with pytest.raises(ValueError, match=r"twinless actors cannot be exported as \.npz"):
        export_npz(Policy(config, config.make_actors()), tmp_path / "policy.npz")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", list_policies())
def test_every_bundled_policy_decides_on_robots_as_in_torch(name, tmp_path):
    policy = load_policy(name)
    path = export_npz(policy, tmp_path / "policy.npz")
    robots = [ExportedPolicy(path, robot, sample=False) for robot in range(4)]
    env = make_env(ArenaConfig(), num_envs=1, seed=1, fpr=policy.config.fpr)
    careful = ArgmaxPolicy(policy)
    td, same = env.reset(), []
    for _ in range(30):
        ours = torch.tensor([r(robot_observation(td, 0, i)) for i, r in enumerate(robots)])
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            theirs = policy(td.clone())["agents", "action"][0]
        yields = td["agents", "dangerous"][0]  # by chance
        same += (theirs == ours)[~yields].tolist()
        td = env.step(careful(td))["next"]
    assert len(same) > 90
    assert np.mean(same) > 0.97  # ties of rounding, and who gives way
