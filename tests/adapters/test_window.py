"""``render_mode="human"``: a window where there is a display, text where there is none."""

from __future__ import annotations

import os
import subprocess
import sys

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest

from marl_explore import ArenaConfig, parallel_env

SMALL = ArenaConfig(height=4, width=5, num_agents=2)


def pair():
    """The same episode for people, and as text."""
    envs = [parallel_env(SMALL, render_mode=mode) for mode in ("human", "ansi")]
    for env in envs:
        env.reset(seed=0)
    return envs


def stay(*envs):
    for env in envs:
        env.step(dict.fromkeys(env.agents, 8))


@pytest.fixture
def _no_display():
    before = matplotlib.get_backend()
    plt.switch_backend("agg")
    yield
    plt.switch_backend(before)


@pytest.mark.usefixtures("_no_display")
def test_without_a_display_every_step_is_printed(capsys):
    env, text = pair()
    expected = [text.render()]
    for _ in range(2):
        stay(env, text)
        expected.append(text.render())
    assert env.render() is None
    assert capsys.readouterr().out == "".join(f"{picture}\n\n" for picture in expected)
    assert not plt.get_fignums()
    env.close()
    env.close()


def test_a_backend_that_needs_a_display_is_no_error():
    program = (
        "from marl_explore import parallel_env\n"
        "env = parallel_env(render_mode='human'); env.reset(seed=0); env.close()"
    )
    hidden = {"DISPLAY", "WAYLAND_DISPLAY"}
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    environment |= {"MPLBACKEND": "tkagg"}
    command = [sys.executable, "-W", "error::UserWarning", "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.split()) == 12  # the rows of the map


@pytest.fixture
def pauses(monkeypatch):
    """Pretend that figures are windows; returns how long each picture was shown."""
    shown = []
    figure = plt.figure

    def window(*arguments, **options):
        made = figure(*arguments, **options)
        monkeypatch.setattr(made.canvas, "required_interactive_framework", "a display")
        return made

    monkeypatch.setattr(plt, "figure", window)
    monkeypatch.setattr(plt, "pause", shown.append)
    return shown


def visible():
    """What the window shows."""
    ((image,),) = (axes.images for axes in plt.gcf().axes)
    return np.asarray(image.get_array())


@pytest.mark.usefixtures("_no_display")
def test_a_window_shows_every_step(pauses, capsys):
    env, text = pair()
    text.render_mode = "rgb_array"
    for step in range(3):
        assert np.array_equal(visible(), text.render())
        assert pauses == [1 / 8] * (step + 1)
        stay(env, text)
    assert env.render() is None
    assert len(plt.get_fignums()) == 1
    plt.close("all")  # by the person who looks on
    stay(env)
    assert not plt.get_fignums()
    assert len(pauses) == 4
    env.close()
    env.reset()
    assert len(plt.get_fignums()) == 1
    env.close()
    assert not plt.get_fignums()
    assert capsys.readouterr().out == ""


@pytest.mark.usefixtures("_no_display")
@pytest.mark.parametrize(
    ("mode", "kind"), [("human", type(None)), ("rgb_array", np.ndarray), ("ansi", str)]
)
def test_every_mode_renders_what_pettingzoo_expects(mode, kind):
    env = parallel_env(SMALL, render_mode=mode)
    assert mode in env.metadata["render_modes"]
    env.reset()
    for _ in range(3):
        assert isinstance(env.render(), kind)
        stay(env)
    env.close()
