"""Replays: the data give back what was recorded, and the page stands alone."""

from __future__ import annotations

import json
import re

import pytest
import torch

from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.core.frontier import feature_table
from marl_explore.core.grid import COMMUNICATE
from marl_explore.core.links import within_range
from marl_explore.core.mapping import target_cells
from marl_explore.evaluation import plots
from marl_explore.evaluation.episodes import play, record
from marl_explore.evaluation.metrics import coverage
from marl_explore.evaluation.registry import find_policy
from marl_explore.evaluation.replay import write_replay
from marl_explore.evaluation.replay.data import episode_data
from tests.helpers import world_oracle

CONFIG = ArenaConfig(height=8, width=10, num_agents=3, communication_range=1.6)
ARENA, STEPS = 1, 40


def an_episode(config=CONFIG, policy="nearest-timer", steps=STEPS, num_envs=2):
    torch.manual_seed(0)
    env = ExplorationEnv(config, num_envs, max_steps=steps)
    return list(play(find_policy(policy, config), env, steps))


@pytest.fixture(scope="module")
def steps():
    return an_episode()


@pytest.fixture(scope="module")
def data(steps):
    # through text, as the page gets them
    return json.loads(json.dumps(episode_data(steps, CONFIG, ARENA)))


def test_decoded_maps_are_the_recorded_ones_at_every_step(steps, data):
    since = torch.tensor(data["known_since"])
    walls = torch.zeros(CONFIG.num_cells, dtype=torch.int8)
    walls[data["obstacles"]] = 1
    for t, step in enumerate(steps):
        decoded = torch.where(since <= t, walls, -1).view(3, 8, 10)
        assert torch.equal(decoded, step["agents", "map"][ARENA])


def test_robots_are_where_they_were_and_did_what_they_did(steps, data):
    for t, step in enumerate(steps):
        agents = step["agents"]
        row, column = agents["position"][ARENA].unbind(-1)
        assert data["cell"][t] == (row * 10 + column).tolist()
        assert data["refused"][t] == agents["dangerous"][ARENA].tolist()
        assert data["received"][t] == agents["received"][ARENA].tolist()
        assert data["action"][t] == (agents["action"][ARENA].tolist() if t else [])
    assert any(sum(row) for row in data["refused"])


def test_links_are_pairs_in_range_and_those_of_merging_robots(steps, data):
    for t, step in enumerate(steps):
        reach = within_range(step["agents", "position"][ARENA], CONFIG.communication_cells)
        pairs = [[i, j] for i in range(3) for j in range(i + 1, 3) if reach[i, j]]
        assert data["linked"][t] == pairs
        talking = step["agents", "action"][ARENA] == COMMUNICATE if t else [False] * 3
        assert data["merging"][t] == [[i, j] for i, j in pairs if talking[i] and talking[j]]
        merged = step["agents", "merged"][ARENA].nonzero().flatten().tolist()
        assert sorted({robot for pair in data["merging"][t] for robot in pair}) == merged
    assert any(data["merging"])


def test_arrows_are_the_raw_feature_table(steps, data):
    for t, step in enumerate(steps):
        table = feature_table(step["agents", "map"], step["agents", "position"], None)[ARENA]
        assert data["paths"][t] == table[..., 0].tolist()
        assert data["path_length"][t] == pytest.approx(table[..., 1].numpy(), abs=0.0051)


def test_coverage_is_that_of_the_metrics():
    steps = an_episode(policy="nearest", num_envs=1)
    data = episode_data(steps, CONFIG)
    episodes = record(
        find_policy("nearest", CONFIG), CONFIG, num_arenas=1, steps=STEPS, stream="train"
    )
    curves = coverage(episodes)
    targets = data["num_targets"]
    assert targets == int(target_cells(steps[0]["obstacles"], steps[0]["agents", "position"]).sum())
    largest = [max(known) / targets for known in data["known_targets"]]
    assert largest == pytest.approx(curves["largest"][0].tolist())
    merged = [known / targets for known in data["union_targets"]]
    assert merged == pytest.approx(curves["merged"][0].tolist())


def test_an_episode_of_the_reset_only_can_be_shown(steps, tmp_path):
    page = write_replay({"start": steps[:1]}, tmp_path / "r.html", config=CONFIG).read_text()
    assert len(_data(page)["episodes"][0]["cell"]) == 1


def _data(page):
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)
    return json.loads(text)


def test_the_page_holds_every_episode_and_nothing_from_elsewhere(steps, tmp_path):
    episodes = {"one": steps, "two": an_episode(policy="random")}
    path = write_replay(episodes, tmp_path / "replay.html", config=CONFIG, arena=ARENA)
    page = path.read_text()
    shown = _data(page)["episodes"]
    assert [episode.pop("name") for episode in shown] == ["one", "two"]
    assert shown[0] == json.loads(json.dumps(episode_data(steps, CONFIG, ARENA)))
    assert not re.findall(r"https?:|\burl\(|@import|\bimport\b|\bfetch\(|XMLHttp|innerHTML", page)
    assert set(re.findall(r"\b(?:src|href)=(\S+)", page)) == {'"data:,">'}


def test_no_text_breaks_out_of_its_place(steps, tmp_path):
    name = "</script></title><b>&\"'<!-- $style \u2028"
    path = write_replay({name: steps}, tmp_path / "r.html", config=CONFIG, about=name)
    page = path.read_text(encoding="utf-8")
    assert _data(page)["episodes"][0]["name"] == name
    assert page.count("</script>") == page.count("<script") == 3
    assert page.count("</title>") == 1
    assert "<b>" not in page


def test_a_failure_leaves_the_earlier_file_and_nothing_else(steps, tmp_path, monkeypatch):
    path = tmp_path / "replay.html"
    path.write_text("earlier")
    with pytest.raises(ValueError, match="episodes is empty"):
        write_replay({}, path, config=CONFIG)

    def fail(*_):
        raise OSError("disk is full")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="disk is full"):
        write_replay({"a": steps}, path, config=CONFIG)
    assert path.read_text() == "earlier"
    assert [p.name for p in tmp_path.iterdir()] == ["replay.html"]


def test_a_large_episode_stays_small(tmp_path):
    config = ArenaConfig(height=48, width=48, num_agents=8)
    steps = an_episode(config, steps=300, num_envs=1)
    path = write_replay({"large": steps}, tmp_path / "replay.html", config=config)
    assert path.stat().st_size < 500_000


def test_wrong_episodes_are_refused(steps):
    with pytest.raises(ValueError, match="steps is empty"):
        episode_data([], CONFIG)
    with pytest.raises(ValueError, match="arena=2 is not a row of a batch of 2"):
        episode_data(steps, CONFIG, arena=2)
    with pytest.raises(ValueError, match=r"\(4, 12, 12\), those of the episode \(3, 8, 10\)"):
        episode_data(steps, ArenaConfig())
    for wrong in (steps[::-1], [*steps, *an_episode(steps=2)[:1]]):
        with pytest.raises(ValueError, match="not one episode in order"):
            episode_data(wrong, CONFIG)


# ---------------------------------------------------------------- the wider world

WIDE = ArenaConfig(
    10,
    10,
    num_agents=3,
    sensing_range=(1.5, 2.0, 2.5),
    sensing_shape="disc",
    line_of_sight=True,
    message_loss=0.3,
    failure_rate=0.03,
    num_walkers=2,
)


@pytest.fixture(scope="module")
def wide_steps():
    return an_episode(WIDE, steps=30)


def seen_cells(digits, side):
    """Offsets of the cells in a window of hexadecimal digits."""
    bits = "".join(f"{int(digit, 16):04b}" for digit in digits)[: side * side]
    return {
        (at // side - side // 2, at % side - side // 2) for at, b in enumerate(bits) if b == "1"
    }


def test_sight_is_that_of_each_robot(wide_steps):
    data = episode_data(wide_steps, WIDE, ARENA)
    obstacles = wide_steps[0]["obstacles"][ARENA].tolist()
    settings = world_oracle.Settings(
        10, 10, 3, sensing_range=WIDE.sensing_range, sensing_shape="disc", line_of_sight=True
    )
    for step, row in zip(wide_steps, data["seen"], strict=True):
        for robot, (place, digits) in enumerate(
            zip(step["agents", "position"][ARENA].tolist(), row, strict=True)
        ):
            expected = world_oracle.seen_cells(settings, robot, obstacles, tuple(place))
            found = {(place[0] + r, place[1] + c) for r, c in seen_cells(digits, WIDE.fov_size)}
            assert found == expected


def test_failures_and_walkers_are_those_that_were(wide_steps):
    data = episode_data(wide_steps, WIDE, ARENA)
    alive = torch.stack([step["agents", "alive"][ARENA] for step in wide_steps])
    assert not alive.all()
    for t, step in enumerate(wide_steps):
        assert [t < since for since in data["failed_since"]] == alive[t].tolist()
        row, column = step["walkers"][ARENA].unbind(-1)
        assert data["walkers"][t] == (row * 10 + column).tolist()
        living = [n for n, lives in zip(data["known_targets"][t], alive[t], strict=True) if lives]
        assert data["largest_targets"][t] == max(living, default=0)


def test_merging_pairs_are_those_whose_messages_arrived(wide_steps):
    data = episode_data(wide_steps, WIDE, ARENA)
    for t, step in enumerate(wide_steps):
        since = step["agents", "steps_since_merge"][ARENA]
        assert all(since[i, j] == 0 for i, j in data["merging"][t])
    assert any(data["merging"])


def test_sight_of_whole_windows_is_left_out(data):
    assert data["seen"] is None
    assert data["walkers"] == []
    assert data["failed_since"] == [STEPS + 1] * 3


def test_figures_show_failures_and_walkers(wide_steps, tmp_path):
    assert plots.episode_figure(wide_steps, tmp_path / "episode.png", ARENA).stat().st_size
