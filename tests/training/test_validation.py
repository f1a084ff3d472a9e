"""Validation during training: fixed arenas, nothing changed by it, the best policy kept."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from marl_explore.arenas import suite
from marl_explore.config.run import RunConfig
from marl_explore.evaluation.registry import trained_on
from marl_explore.evaluation.results import evaluate
from marl_explore.policies.io import load_policy, policy_info
from marl_explore.training import runs, validation
from marl_explore.training.trainer import Trainer
from marl_explore.training.validation import Validation
from tests.helpers.killing import CONFIG, RUN


def test_it_measures_the_policy_on_arenas_of_its_own(tmp_path):
    policy = Trainer(CONFIG).policy
    validate = Validation(CONFIG, RUN, tmp_path)
    before = torch.get_rng_state()
    one = validate(policy, 1)
    assert torch.equal(torch.get_rng_state(), before)
    torch.rand(3)
    assert repr(validate(policy, 2)) == repr(one)
    on_its_arenas, on_test = (
        evaluate(policy, CONFIG.arena, num_arenas=4, steps=10, stream=stream)
        for stream in ("validation", "test")
    )
    assert one["validation_overlap"] == pytest.approx(on_its_arenas["overlap"], abs=1e-6)
    assert one["validation_overlap"] != on_test["overlap"]


def test_the_best_policy_is_kept(tmp_path, monkeypatch):
    policy = Trainer(CONFIG).policy
    validate = Validation(CONFIG, replace(RUN, select_by="steps_to_90"), tmp_path)
    kept = []
    scores = [(9.0, 0.5), (7.0, 0.8), (8.0, 0.9), (7.0, 0.8), (7.0, 0.7), (7.5, 1.0)]
    for update, (score, coverage) in enumerate(scores, start=1):
        measures = {"steps_to_90": score, "final_largest_coverage": coverage}
        monkeypatch.setattr(validation, "evaluate", lambda *a, m=measures, **k: m)
        assert validate(policy, update) == {"validation_steps_to_90": score}
        kept.append(policy_info(tmp_path / "best.safetensors")["best"]["update"])
    assert kept == [1, 2, 2, 4, 4, 4]  # of equal ones the later, unless it covers less
    best = {"update": 4, "measure": "steps_to_90", "score": 7.0, "coverage": 0.8}
    assert validate.best == best
    assert load_policy(tmp_path / "best.safetensors").config == policy.config


def test_it_changes_nothing_about_the_run(tmp_path):
    policies = [
        runs.train(CONFIG, tmp_path / str(every), replace(RUN, validate_every=every), False)
        for every in (0, 1, 5)
    ]
    for other in policies[1:]:
        for name, weight in policies[0].state_dict().items():
            assert torch.equal(weight, other.state_dict()[name])
    assert not (tmp_path / "0" / "best.safetensors").exists()
    rows = (tmp_path / "5" / "scalars" / "validation_complete.csv").read_text().splitlines()
    assert [int(row.split(",")[0]) for row in rows] == [100, 200, 240]  # and after the last update
    record = json.loads((tmp_path / "5" / "run.json").read_text())
    assert record["execution"]["validate_every"] == 5


def test_settings_that_make_no_run_are_refused():
    for name, value in (
        ("select_by", "fame"),
        ("collector", "threads"),
        ("logger", "paper"),
        ("validate_every", -1),
        ("validation_arenas", 0),
        ("keep_checkpoints", 0),
    ):
        with pytest.raises(ValueError, match=f"^{name}="):
            RunConfig(**{name: value})
    with pytest.raises(ValueError, match="ray_address='auto' needs collector='ray'"):
        RunConfig(ray_address="auto")


def test_the_best_policy_keeps_the_arenas_it_was_trained_on(tmp_path):
    config = replace(CONFIG, arenas="corridor-24-v1", arena=suite("corridor-24").config)
    policy = Trainer(config).policy
    Validation(config, replace(RUN, validation_steps=2), tmp_path)(policy, 1)
    assert trained_on(str(tmp_path / "best.safetensors"))[1] == "corridor-24-v1"
