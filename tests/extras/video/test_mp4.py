"""MP4 animations by a real ffmpeg."""

from __future__ import annotations

import shutil
import subprocess

import pytest

from marl_explore import ArenaConfig
from marl_explore.evaluation import plots
from marl_explore.evaluation.episodes import watch
from marl_explore.evaluation.registry import find_policy


def test_episode_animation_writes_an_mp4_with_a_frame_per_step(tmp_path):
    if shutil.which("ffprobe") is None:
        pytest.fail("this test needs ffmpeg: run tests/extras/install.sh (make test-all does)")
    config = ArenaConfig(height=5, width=7, num_agents=2)
    steps = watch(find_policy("nearest-timer", config), config, steps=8)
    path = plots.episode_animation(steps, tmp_path / "episode.mp4")
    probe = "ffprobe -v error -count_frames -show_entries stream=codec_name,nb_read_frames -of csv"
    found = subprocess.run([*probe.split(), path], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == f"stream,h264,{len(steps)}"
