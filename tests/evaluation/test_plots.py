"""Figures: they are written, and show what they are given."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from marl_explore import ArenaConfig, ExplorationEnv, MapArenas
from marl_explore.evaluation import plots, stats
from marl_explore.evaluation.episodes import play, watch
from marl_explore.evaluation.plots.style import line_styles
from marl_explore.evaluation.registry import find_policy
from marl_explore.utils.palette import UNKNOWN_COLOR, robot_color

SMALL = ArenaConfig(height=5, width=7, num_agents=2)


def colors(image):
    return {"#{:02X}{:02X}{:02X}".format(*rgb) for _, rgb in image.convert("RGB").getcolors(10**6)}


def an_episode(steps=6):
    env = ExplorationEnv(SMALL, num_envs=2)
    return list(play(find_policy("nearest-timer", SMALL), env, steps))


@pytest.fixture
def drawn(monkeypatch, tmp_path):
    """The figures that would have been written."""
    figures = []

    def keep(figure, path, **_):
        figures.append(figure)
        Path(path).touch()

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Figure, "savefig", keep)
    return figures


def line(axes, label):
    (found,) = [line for line in axes.lines if line.get_label() == label]
    return found.get_xdata().tolist(), found.get_ydata().tolist()


def shaded(axes, i=0):
    """Edges of the i-th shaded region at each x: {x: (low, high)}."""
    vertices = axes.collections[i].get_paths()[0].vertices
    return {
        x: (vertices[vertices[:, 0] == x, 1].min(), vertices[vertices[:, 0] == x, 1].max())
        for x in vertices[:, 0].tolist()
    }


def test_coverage_figure_draws_mean_and_quartiles_in_percent(drawn):
    curves = torch.tensor([[0.1, 0.2], [0.1, 0.3], [0.1, 0.4], [0.1, 0.5], [0.1, 1.0]])
    plots.coverage_figure({"a": curves, "b": stats.middle_half(0.5 * curves)}, "unused")
    axes = drawn[0].axes[0]
    assert line(axes, "a") == ([0, 1], pytest.approx([10, 48]))
    assert line(axes, "b") == ([0, 1], pytest.approx([5, 24]))
    assert shaded(axes)[1] == pytest.approx((30, 50))
    assert shaded(axes, 1)[1] == pytest.approx((15, 25))
    assert [text.get_text() for text in drawn[0].legends[0].get_texts()] == ["a", "b"]


def test_the_coverage_figure_ends_when_all_but_the_slowest_are_done(drawn):
    steps = torch.arange(301) / 300
    curves = {f"{end}": (300 / end * steps).clamp(max=1).expand(2, -1) for end in (20, 50)}
    plots.coverage_figure(curves | {"walk": 0.9 * steps.expand(2, -1)}, "unused")
    plots.coverage_figure({"walk": 0.9 * steps.expand(2, -1)}, "unused")
    first, second = (figure.axes[0] for figure in drawn)
    assert first.get_xlim() == (0, 55)
    assert line(first, "walk (90% at 300)")[1][-1] == pytest.approx(90)
    assert second.get_xlim() == (0, 300)
    assert line(second, "walk")


def test_every_line_has_a_style_of_its_own():
    names = [str(i) for i in range(20)]
    styles = {(style["color"], style["linestyle"]) for _, style in line_styles(names)}
    assert len(styles) == 20


def test_lab_figure_draws_best_and_merged_maps(drawn):
    coverage = {"best": torch.tensor([[0.2, 0.6], [0.4, 0.8]]), "merged": torch.ones(2, 2)}
    plots.lab_figure(coverage, "unused")
    axes = drawn[0].axes[0]
    assert line(axes, "best map") == ([0, 1], pytest.approx([30, 70]))
    assert line(axes, "merged map") == ([0, 1], pytest.approx([100, 100]))
    assert axes.get_ylabel() == "known target cells (%)"


def test_communication_figure_draws_means_and_quantiles_of_the_episodes_with_any(drawn):
    share = torch.tensor([0.0, 0.1, 0.2, 0.3, 0.9])
    useful = torch.tensor([math.nan, 0.5, 0.5, 0.5, 0.7])
    none = {"communication_share": 0 * share, "useful_share": math.nan * share}
    both = {"a": {"communication_share": share, "useful_share": useful}, "silent": none}
    plots.communication_figure(both, "unused")
    left, right = drawn[0].axes
    assert [x.get_xdata()[0] for x in left.lines] == pytest.approx([30, 0])
    assert [x.get_xdata()[0] for x in right.lines] == pytest.approx([55])
    assert [text.get_text().strip() for text in right.texts] == ["none"]
    thin, thick = (bar.get_segments()[0][:, 0].tolist() for bar in left.collections[:2])
    assert thick == pytest.approx([10, 30])
    assert thin == pytest.approx([2, 78])
    assert [text.get_text() for text in left.get_yticklabels()] == ["a", "silent"]


def test_seeds_figure_draws_every_seed_their_mean_and_its_interval(drawn):
    plots.seeds_figure({"two": [0.2, 0.4], "one": [0.5]}, "unused", "covered", scale=100)
    axes = drawn[0].axes[0]
    assert [x.get_xdata() for x in axes.lines] == [
        pytest.approx([20, 40]),
        pytest.approx([30]),
        pytest.approx([50]),
        pytest.approx([50]),
    ]
    (interval,) = axes.collections  # one seed has none
    assert interval.get_segments()[0].tolist() == [pytest.approx([20, 0]), pytest.approx([40, 0])]
    assert [text.get_text() for text in axes.get_yticklabels()] == ["two", "one"]
    assert axes.get_xlabel() == "covered"


def test_enlargement_figure_draws_the_share_above_each_size(drawn):
    added = {"a": torch.tensor([0, 0, 1, 3]), "silent": torch.tensor([], dtype=torch.int64)}
    plots.enlargement_figure(added, 2, "unused")
    axes = drawn[0].axes[0]
    assert line(axes, "a") == ([0, 1, 2, 3], [50, 25, 25, 0])
    assert axes.lines[-1].get_xdata() == [2, 2]  # e_max
    assert axes.texts[0].get_text().endswith("= 2")


def test_tradeoff_figure_draws_coverage_over_cells_sent(drawn):
    sent, covered = torch.tensor([0.0, 0, 40, 90]), torch.tensor([0.1, 0.3, 0.5, 1])
    plots.tradeoff_figure({"a": (sent, covered)}, "unused")
    axes = drawn[0].axes[0]
    assert line(axes, "a") == ([0, 0, 40, 90], pytest.approx([10, 30, 50, 100]))
    assert axes.lines[0].get_markevery() == []


def a_run(folder, **scalars):
    (folder / "scalars").mkdir(parents=True)
    for name, rows in scalars.items():
        lines = "\n".join(f"{frames},{value}" for frames, value in rows)
        (folder / "scalars" / f"{name}.csv").write_text(lines + "\n")
    return folder


def test_training_figure_draws_the_mean_over_seeds_and_its_interval(drawn, tmp_path):
    runs = [
        a_run(tmp_path / "0", reward=[(100, 1), (200, 2), (300, 3)]),
        a_run(tmp_path / "1", reward=[(100, 5), (200, math.nan), (300, 9), (400, 100)]),
    ]
    measures = {"reward": "reward"}
    plots.training_figure({"both": runs, "one": runs[:1]}, "unused", measures, steps="frames")
    axes = drawn[0].axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("frames", "reward")
    # between 5 and 9 the second seed is interpolated; what the first has not reached is left out
    assert line(axes, "both") == ([100, 200, 300], [3, 4.5, 6])
    assert shaded(axes)[200] == (2, 7)  # one draw in four has one seed twice
    assert line(axes, "one") == ([100, 200, 300], [1, 2, 3])
    assert len(axes.collections) == 1  # one seed says nothing of others


def test_a_folder_without_the_measure_is_refused(tmp_path):
    with pytest.raises(ValueError, match="is not a run folder with 'reward'"):
        plots.training_figure({"a": [tmp_path]}, "unused", {"reward": "reward"})
    empty = a_run(tmp_path / "run", useful_share=[(100, math.nan)])
    with pytest.raises(ValueError, match=r"useful_share.csv has no value"):
        plots.training_figure({"a": [empty]}, "unused", {"useful_share": "useful"})


def test_figures_are_written_in_the_format_of_their_ending_and_repeat(tmp_path):
    curves = {name: torch.rand(5, 20).sort(-1).values for name in ("a", "b", "c")}
    image = Image.open(plots.coverage_figure(curves, tmp_path / "coverage.png"))
    assert set(plots.COLORS[:3]) <= colors(image)
    one, two = (plots.coverage_figure(curves, tmp_path / f"{i}.svg").read_bytes() for i in "12")
    assert one.startswith(b"<?xml")
    assert one == two
    with pytest.raises(ValueError, match="'abc' is not supported"):
        plots.coverage_figure(curves, tmp_path / "1.abc")
    assert {path.name for path in tmp_path.iterdir()} == {"coverage.png", "1.svg", "2.svg"}


def test_episode_animation_has_a_frame_per_step(tmp_path):
    steps = an_episode()
    with Image.open(plots.episode_animation(steps, tmp_path / "episode.gif")) as image:
        assert image.n_frames == len(steps) == 7


def test_an_animation_of_another_ending_or_without_its_program_is_refused(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"path='a.avi' .* must end in .gif or .mp4"):
        plots.episode_animation(an_episode(1), "a.avi")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(RuntimeError, match="needs ffmpeg on the PATH"):
        plots.episode_animation(an_episode(1), tmp_path / "a.mp4")
    assert list(tmp_path.iterdir()) == []


def test_episode_figure_shows_unknown_free_and_occupied_cells(tmp_path):
    path = plots.episode_figure(an_episode(1), tmp_path / "episode.png")
    shades = {plots.UNKNOWN_COLOR, plots.FREE_COLOR, plots.OBSTACLE_COLOR, *plots.COLORS[:2]}
    assert shades <= colors(Image.open(path))


def test_episode_figure_draws_the_arena_every_map_and_every_path(drawn):
    steps = an_episode(6)
    plots.episode_figure(steps, "unused", arena=1)
    truth, *own = drawn[0].axes
    assert (truth.images[0].get_array() == steps[-1]["obstacles"][1].int().numpy()).all()
    for robot, axes in enumerate(own):
        assert (axes.images[0].get_array() == steps[-1]["agents", "map"][1, robot].numpy()).all()
        way = torch.stack([step["agents", "position"][1, robot] for step in steps])
        assert axes.lines[0].get_ydata().tolist() == way[:, 0].tolist()
        assert axes.lines[0].get_xdata().tolist() == way[:, 1].tolist()


def test_every_robot_of_a_large_team_has_a_colour_of_its_own():
    colors = [robot_color(robot) for robot in range(24)]
    assert len({*colors}) == 24
    assert all(len(color) == 7 for color in colors)
    assert UNKNOWN_COLOR not in colors


@pytest.mark.parametrize(("robots", "size"), [(10, (12, 12)), (3, (9, 40)), (2, (40, 9))])
def test_episode_figures_stay_readable(drawn, robots, size):
    config = ArenaConfig(*size, num_agents=robots)
    plots.episode_figure(watch(find_policy("random", config), config, steps=2), "unused")
    (figure,) = drawn
    width, height = figure.get_size_inches()
    assert width <= 14
    assert height <= 14
    shown = [axes for axes in figure.axes if axes.axison]
    assert len(shown) == robots + 1
    assert [axes.get_title().split(":")[0] for axes in shown[1:]] == [
        f"robot {robot}" for robot in range(robots)
    ]


def test_a_robot_with_a_complete_map_is_said_to_know_all_of_it(drawn):
    obstacles = torch.zeros(1, 5, 8, dtype=torch.bool)
    obstacles[..., 5:] = True  # nobody will ever see the inside of this wall
    arenas = MapArenas(ArenaConfig(5, 8, 0, num_agents=1), maps=obstacles)
    policy = find_policy("nearest", arenas.config)
    plots.episode_figure(watch(policy, None, steps=60, arenas=arenas), "unused")
    assert drawn[0].axes[1].get_title() == "robot 0: 100% known"


def test_the_explored_area_has_the_colour_of_whom_was_first_there(drawn):
    steps = an_episode(5)
    maps, cells = (torch.stack([s["agents", k][0] for s in steps]) for k in ("map", "position"))
    plots.explored_figure(steps[0]["obstacles"][0], maps, cells, "unused", moments=2)
    for column, time in enumerate((0, 5)):
        shown = drawn[0].axes[2 + column].images[0].get_array()
        for row in range(SMALL.height):
            for cell in range(SMALL.width):
                known = (maps[: time + 1, :, row, cell] >= 0).int()
                color = tuple(round(255 * part) for part in shown[row, cell].tolist())
                if not known.any():
                    assert "#{:02X}{:02X}{:02X}".format(*color) == UNKNOWN_COLOR
                elif not steps[0]["obstacles"][0, row, cell]:
                    when = known.argmax(0).masked_fill(~known.bool().any(0), 99)
                    own = robot_color(int(when.argmin()))
                    pale = [
                        round(255 * (0.75 + 0.25 * int(own[i : i + 2], 16) / 255))
                        for i in (1, 3, 5)
                    ]
                    assert color == pytest.approx(pale, abs=1)
