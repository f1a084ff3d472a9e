"""Figures: they are written, and show what they are given."""

from __future__ import annotations

import pytest
import torch
from PIL import Image

from marl_explore import ArenaConfig, ExplorationEnv, plots
from marl_explore.evaluation import find_policy, play

SMALL = ArenaConfig(height=5, width=7, num_agents=2)


def colors(image):
    return {"#{:02X}{:02X}{:02X}".format(*rgb) for _, rgb in image.convert("RGB").getcolors(10**6)}


def an_episode(steps=6):
    env = ExplorationEnv(SMALL, num_envs=2)
    return list(play(find_policy("nearest-timer", SMALL), env, steps))


def test_coverage_figure_draws_every_policy_in_its_color(tmp_path):
    curves = {name: torch.rand(5, 20).sort(-1).values for name in ("a", "b", "c")}
    path = plots.coverage_figure(curves, tmp_path / "coverage.png")
    assert set(plots.COLORS[:3]) <= colors(Image.open(path))


def test_episode_animation_has_a_frame_per_step(tmp_path):
    steps = an_episode()
    with Image.open(plots.episode_animation(steps, tmp_path / "episode.gif")) as image:
        assert image.n_frames == len(steps) == 7


def test_an_animation_of_another_ending_or_without_its_program_is_refused(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"path='a.avi' .* must end in .gif or .mp4"):
        plots.episode_animation(an_episode(1), "a.avi")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(RuntimeError, match="takes ffmpeg on the PATH"):
        plots.episode_animation(an_episode(1), tmp_path / "a.mp4")
    assert list(tmp_path.iterdir()) == []


def test_episode_figure_shows_unknown_free_and_occupied_cells(tmp_path):
    path = plots.episode_figure(an_episode(1), tmp_path / "episode.png")
    shades = {plots.UNKNOWN_COLOR, plots.FREE_COLOR, plots.OBSTACLE_COLOR, *plots.COLORS[:2]}
    assert shades <= colors(Image.open(path))
