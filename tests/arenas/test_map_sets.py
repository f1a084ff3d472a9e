"""Sets of maps that do not come with the package: what is known of them, and copies of them."""

from __future__ import annotations

import hashlib
import re
import shutil
from dataclasses import replace

import pytest

from marl_explore import ArenaConfig
from marl_explore.arenas import map_sets
from marl_explore.arenas.dungeons import write_dungeons
from marl_explore.arenas.map_sets import DUNGEONS, MapSet, file_digest, find_set
from marl_explore.arenas.sources import suite_of
from marl_explore.cli import maps


def drawn_set(folder, number=3, **size):
    """A set of drawn dungeons, whose files lie in a folder."""
    paths = write_dungeons(folder, number, **size)

    class Drawn(MapSet):
        digests = {path.name: file_digest(path) for path in sorted(paths)}  # noqa: RUF012

    return Drawn("drawn", "a generator", "DungeonMaps/test", DUNGEONS.reading)


@pytest.fixture
def dungeons(tmp_path):
    return drawn_set(tmp_path / "clone" / "DungeonMaps" / "test", rows=6, columns=8)


def test_the_known_set_is_a_hundred_files_in_the_order_of_their_names():
    names = [*DUNGEONS.digests]
    assert len(names) == 100
    assert names == sorted(names)
    assert all(re.fullmatch(r"img_\d+\.png", name) for name in names)
    assert all(re.fullmatch(r"[0-9a-f]{64}", sha) for sha in DUNGEONS.digests.values())
    assert len(set(DUNGEONS.digests.values())) == 100
    assert find_set("dungeons") is DUNGEONS


def test_digests_are_sha_256(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    assert file_digest(tmp_path / "a") == hashlib.sha256(b"abc").hexdigest()


def test_a_clone_or_the_folder_inside_it_is_whole(dungeons, tmp_path):
    for place in (tmp_path / "clone", tmp_path / "clone" / "DungeonMaps" / "test"):
        dungeons.require(place)
        assert [path.name for path in dungeons.source(place).paths] == [*dungeons.digests]
    (tmp_path / "clone" / "DungeonMaps" / "test" / "img_1.png").write_text("others do not matter")
    dungeons.require(tmp_path / "clone")
    suite = suite_of(dungeons.source(tmp_path / "clone"), "three", ArenaConfig())
    assert (suite.num_arenas, suite.config.height, suite.config.width) == (3, 12, 16)


def test_what_is_missing_or_different_is_told(dungeons, tmp_path):
    folder = tmp_path / "clone" / "DungeonMaps" / "test"
    (folder / "dungeon_1.png").unlink()
    shutil.copy(folder / "dungeon_0.png", folder / "dungeon_2.png")
    assert dungeons.compare(folder) == (("dungeon_1.png",), ("dungeon_2.png",))
    message = (
        "1 of the 3 maps of 'drawn' are missing: dungeon_1.png; 1 of the 3 maps of 'drawn' are "
        "different: dungeon_2.png. They come from a generator"
    )
    with pytest.raises(ValueError, match=message):
        dungeons.source(tmp_path / "clone")
    with pytest.raises(ValueError, match=r"dungeon_0.png, dungeon_1.png, dungeon_2.png\."):
        dungeons.require(tmp_path / "nowhere")
    many = drawn_set(tmp_path / "many", 5, rows=6, columns=8)
    with pytest.raises(ValueError, match=r"dungeon_2.png and 2 more\. They"):
        many.require(tmp_path / "nowhere")


def test_the_command_checks_a_folder(dungeons, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(map_sets.MAP_SETS, "drawn", dungeons)
    maps.run(maps.parse(["check", str(tmp_path / "clone"), "--set", "drawn"]))
    assert "test has all 3 maps of 'drawn'" in capsys.readouterr().out
    with pytest.raises(ValueError, match="100 of the 100 maps of 'dungeons' are missing"):
        maps.run(maps.parse(["check", str(tmp_path)]))
    with pytest.raises(ValueError, match="set='other' is not allowed: use one of"):
        maps.run(maps.parse(["check", str(tmp_path), "--set", "other"]))


@pytest.mark.parametrize(
    ("words", "status"), [([], 2), (["burn"], 2), (["--help"], 0), (["check"], 2)]
)
def test_other_words_end_the_program(words, status, capsys):
    with pytest.raises(SystemExit) as stop:
        maps.parse(words)
    assert stop.value.code == status
    assert "usage: marl-explore maps" in "".join(capsys.readouterr()) or words == ["check"]


def test_where_robots_may_start_belongs_to_a_suite(dungeons, tmp_path):
    source = dungeons.source(tmp_path / "clone")
    marked, free = (
        suite_of(one, "three", ArenaConfig())
        for one in (source, replace(source, reading=replace(source.reading, start_value=None)))
    )
    assert marked.arenas.maps.equal(free.arenas.maps)
    assert marked.digest != free.digest
