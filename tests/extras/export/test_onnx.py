"""ONNX graphs by a real onnxruntime: the same numbers as torch's and numpy's."""

from __future__ import annotations

import json

import numpy as np
import onnx
import onnxruntime
import pytest

from marl_explore import load_policy
from marl_explore.policies.export import (
    GOAL_OUTPUTS,
    INPUTS,
    OUTPUTS,
    example_candidates,
    example_inputs,
    export_npz,
    export_onnx,
)
from marl_explore.robot import ExportedPolicy
from tests.helpers.goal_policies import goal_policy
from tests.policies.test_export import expected
from tests.policies.test_policies import a_policy

pytestmark = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning"
)  # of the exporter's own


def run(path, inputs):
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    named = {name: entry.numpy() for name, entry in zip(INPUTS, inputs, strict=True)}
    return session.run(list(OUTPUTS), named)


@pytest.mark.parametrize(
    "options",
    [{}, {"ablate": ("fpr", "communication")}, {"shared": True}],
    ids=["full", "without", "shared"],
)
@pytest.mark.parametrize("network", ["mlp", "cnn"])
def test_onnxruntime_agrees_on_1000_observations(tmp_path, network, options):
    policy = a_policy(network, **options)
    paths = export_onnx(policy, tmp_path / "new")
    npz = export_npz(policy, tmp_path / "policy.npz")
    assert [path.name for path in paths] == [f"robot_{i}.onnx" for i in range(4)]
    for robot, path in enumerate(paths):
        onnx.checker.check_model(path)
        for rows in (1, 1000):
            inputs = example_inputs(policy.config.arena, rows, seed=robot)
            action, logits = expected(policy, robot, inputs)
            ours = run(path, inputs)
            np.testing.assert_allclose(ours[1], logits, rtol=1e-5, atol=1e-4)
            assert (ours[0] == action).mean() >= 0.999
        by_numpy = ExportedPolicy(npz, robot).masked_logits(*(x.numpy() for x in inputs))
        np.testing.assert_allclose(by_numpy, ours[1], rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("name", ["paper-mlp-case2", "paper-cnn-case2"])
def test_bundled_policies_of_moves_are_graphs(tmp_path, name):
    policy = load_policy(name)
    for robot, path in enumerate(export_onnx(policy, tmp_path)):
        inputs = example_inputs(policy.config.arena, 50, seed=robot)
        action, logits = expected(policy, robot, inputs)
        ours = run(path, inputs)
        np.testing.assert_allclose(ours[1], logits, rtol=1e-5, atol=1e-4)
        assert (ours[0] == action).mean() >= 0.98


def test_a_graph_tells_what_it_is_and_what_it_lacks(tmp_path):
    policy = a_policy(fpr="proximity")
    model = onnx.load(export_onnx(policy, tmp_path)[3])
    told = {entry.key: entry.value for entry in model.metadata_props}
    assert told["robot"] == "3"
    assert json.loads(told["spec"])["fpr"] == "proximity"
    assert "to sample" in told["not in the graph"]
    assert [entry.name for entry in model.graph.input] == list(INPUTS)
    assert [entry.name for entry in model.graph.output] == list(OUTPUTS)


@pytest.mark.parametrize("name", ["drawn", "best"])
def test_actors_that_choose_among_goals_agree_in_any_team(tmp_path, name):
    policy = goal_policy() if name == "drawn" else load_policy(name)
    path = export_onnx(policy, tmp_path)[1]
    onnx.checker.check_model(path)
    told = {entry.key: entry.value for entry in onnx.load(path).metadata_props}
    assert "docs/goals.md" in told["not in the graph"]
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    for arenas, team in ((1, 1), (7, 4), (3, 12)):
        found = example_candidates(arenas, team, steps=20)
        named = {name: entry.numpy() for name, entry in found._asdict().items()}
        choice, logits = session.run(list(GOAL_OUTPUTS), named)
        expected = policy.actor_of(1)(*found).detach().numpy()
        valid = logits > -np.inf
        np.testing.assert_allclose(logits[valid], expected[valid], rtol=1e-4, atol=1e-4)
        assert (choice == expected.argmax(-1)).mean() > 0.97
