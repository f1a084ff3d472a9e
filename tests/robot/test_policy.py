"""Exported policies that are broken are refused when they are read."""

from __future__ import annotations

import json

import numpy as np
import pytest

from marl_explore.robot import ExportedPolicy
from marl_explore.robot.policy import save_arrays
from tests.helpers.policy_file import policy_file


def changed(folder, spec=None, arrays=None):
    """A policy file with other entries of its spec and other arrays; None: without them."""
    path = policy_file(folder)
    read, old = arrays_of(path)
    told = json.loads(read) | (spec or {})
    new = {name: array for name, array in (old | (arrays or {})).items() if array is not None}
    told = {name: value for name, value in told.items() if value is not None}
    with path.open("wb") as file:
        save_arrays(file, json.dumps(told), new)
    return path


def arrays_of(path):
    """Spec and weights of a policy file."""
    with np.load(path) as file:
        return str(file["spec"]), {n: file[n] for n in file.files if n not in ("spec", "sha256")}


def test_a_whole_file_is_taken(tmp_path):
    assert ExportedPolicy(changed(tmp_path), 0).arena.num_agents == 4


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ({"arena": None}, "its spec has no 'arena'"),
        ({"ablate": None}, "its spec has no 'ablate'"),
        ({"twin": None}, "its spec has no 'twin'"),
        ({"twin": "gnn"}, "twin='gnn' is not allowed: .*mlp"),
        ({"fpr": "nearest"}, "fpr='nearest' is not allowed: .*relative"),
        ({"ablate": ["sight"]}, r"ablate=\['sight'\] is not allowed: .*fov"),
        ({"arena": {"heigth": 12}}, "heigth"),
        ({"arena": {"height": 0}}, "height=0 is not allowed"),
    ],
)
def test_a_spec_that_lacks_something_is_refused(tmp_path, spec, message):
    with pytest.raises(ValueError, match=f"policy.npz is not an exported policy: .*{message}"):
        ExportedPolicy(changed(tmp_path, spec), 0)


BIAS, WEIGHT, LAST = (f"0.actor.layers.{name}" for name in ("0.bias", "0.weight", "2.weight"))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({BIAS: None}, r"layers.0.bias .* \(16,\)"),
        ({BIAS: np.zeros(1, np.float32)}, r"layers.0.bias of shape \(1,\) .* \(16,\)"),
        ({WEIGHT: None}, "layers.0.weight"),
        ({WEIGHT: np.zeros((16, 36), np.float32)}, "36"),
        ({WEIGHT: np.full((16, 37), np.nan, np.float32)}, "layers.0.weight .*finite"),
        ({LAST: np.zeros((9, 16), np.float32)}, r"layers.2.bias of shape \(10,\) .* \(9,\)"),
    ],
)
def test_weights_that_do_not_fit_are_refused(tmp_path, arrays, message):
    path = changed(tmp_path, arrays=arrays)
    with pytest.raises(ValueError, match=f"policy.npz is not an exported policy: .*{message}"):
        ExportedPolicy(path, 0)
    ExportedPolicy(path, 1)  # whose actor is whole


def test_an_actor_that_is_not_there_is_refused(tmp_path):
    path = policy_file(tmp_path)
    spec, arrays = arrays_of(path)
    with path.open("wb") as file:
        save_arrays(file, spec, {n: a for n, a in arrays.items() if not n.startswith("2.")})
    with pytest.raises(ValueError, match="robot 2 .*10 logits"):
        ExportedPolicy(path, 2)
