"""Maps as the field draws them: values by interval, start pixels, odd but valid files, limits."""

from __future__ import annotations

import tracemalloc
import zlib

import numpy as np
import pytest
import torch

from marl_explore.arenas import MapArenas, load_map
from marl_explore.arenas.maps import Reading, resample
from marl_explore.config.arena import ArenaConfig
from tests.arenas.test_map_files import GREY, MOVINGAI, OBSTACLES, RIGHT, ROS, bits, image, written


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"free": "195-255", "occupied": "0-127"}, [1, 1, 1, 1, 0, 0, 0]),
        ({"free": "50-80,195-255"}, [1, 0, 1, 1, 0, 0, 0]),
        ({"occupied": "0-127"}, [1, 1, 1, 0, 0, 0, 0]),
        ({"occupied": [(0, 49), (127, 127)]}, [1, 0, 1, 0, 0, 0, 0]),
        ({}, [1, 1, 1, 0, 0, 0, 0]),
        ({"occupied": "0-208", "start_value": 203}, [1, 1, 1, 1, 1, 0, 0]),
    ],
)
def test_grey_values_mean_what_intervals_say(tmp_path, options, expected):
    row = np.array([[0, 60, 127, 128, 195, 203, 255]], np.uint8)
    assert bits(load_map(image(tmp_path, "a.png", row), **options)) == [expected]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"free": "300"}, "free='300' is not allowed: use grey values from 0 to 255"),
        ({"free": "9-3"}, "free='9-3'"),
        ({"occupied": ""}, "occupied=''"),
        ({"occupied": [(1, 2, 3)]}, r"occupied=\[\(1, 2, 3\)\]"),
        ({"free": "100-255", "occupied": "0-127"}, "overlap at 100"),
        ({"free": "9", "threshold": 0.3}, "threshold=0.3 is not allowed beside intervals"),
        ({"start_value": 256}, "start_value=256"),
        ({"start_value": 77}, "a.png: expected pixels of start_value=77, got none; most have "),
    ],
)
def test_values_that_mean_nothing_are_refused(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        load_map(image(tmp_path, "a.png", GREY), **options)


def test_values_belong_to_images(tmp_path):
    path = written(tmp_path, "a.txt", RIGHT)
    with pytest.raises(ValueError, match=r"free=.* is not allowed: .*a.txt is not a plain image"):
        load_map(path, free="1")
    with pytest.raises(ValueError, match=r"start_value=1 is not allowed: .*a.txt is not an image"):
        load_map(path, start_value=1)


def test_start_pixels_are_cells_where_robots_may_start(tmp_path):
    pixels = np.full((4, 6), 255, np.uint8)
    pixels[2:, 4:] = 208
    pixels[:, 2] = 0
    loaded = Reading(resolution=0.5, start_value=208).load(image(tmp_path, "a.png", pixels), 1.0)
    assert bits(loaded.obstacles) == [[0, 1, 0], [0, 1, 0]]
    assert bits(loaded.starts) == [[0, 0, 0], [0, 0, 1]]


@pytest.mark.parametrize("name", ["a.bmp", "a.tif", "a.tiff", "a.gif", "a.BMP"])
def test_further_image_formats(tmp_path, name):
    assert bits(load_map(image(tmp_path, name, GREY))) == OBSTACLES


@pytest.mark.parametrize(
    ("text", "ending"),
    [
        ("\ufeff" + RIGHT, "txt"),
        (RIGHT.replace("\n", " \t\n"), "txt"),
        (RIGHT.replace(".", "$").replace("$#\n", "@#\n", 0), "txt"),
        ("\ufeff" + MOVINGAI, "map"),
        (MOVINGAI.replace("height 2\nwidth 4", "width 4\nheight 2"), "map"),
        (MOVINGAI.replace("height 2", "height\t2 ").replace("T..W", "T..W  "), "map"),
    ],
)
def test_odd_but_valid_texts(tmp_path, text, ending):
    assert bits(load_map(written(tmp_path, f"a.{ending}", text))) == OBSTACLES


def test_pogemas_symbols(tmp_path):
    loaded = Reading().load(written(tmp_path, "a.txt", "!.@\n$#.\n"), 0.5)
    assert bits(loaded.obstacles) == [[0, 0, 0], [0, 1, 0]]
    assert bits(loaded.starts) == [[1, 0, 1], [0, 0, 0]]


def ros(tmp_path, **changes):
    image(tmp_path, "floor.pgm", np.array([[255, 254, 0]], np.uint8))
    text = "".join(
        f"{line.split(':')[0]}: {changes[line.split(':')[0]]}\n"
        if line.split(":")[0] in changes
        else f"{line}\n"
        for line in ROS.splitlines()
    )
    return written(tmp_path, "a.yaml", text)


def test_a_free_threshold_of_0_leaves_what_is_white(tmp_path):
    assert bits(load_map(ros(tmp_path, free_thresh="0.0"), cell_size=0.1)) == [[0, 1, 1]]


@pytest.mark.parametrize("yaw", ["0", "6.283185307179586"])
def test_an_origin_that_is_not_rotated_changes_nothing(tmp_path, yaw):
    path = ros(tmp_path, origin=f"[-3.5, 2, {yaw}]")
    assert load_map(path, cell_size=0.1).shape == (1, 3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"origin": "[0, 0, 1.57]"}, "a.yaml: expected an origin that is not rotated, got a yaw"),
        ({"origin": "north"}, r"a.yaml: expected origin to be \[x, y, yaw\], got 'north'"),
        ({"image": "[1]"}, "a.yaml: expected image to be a file name, got"),
        ({"resolution": "1e308"}, "a.yaml: .* cells of 0.5 m are too many"),
        ({"resolution": "&a 1\nx: *a"}, "line 3: expected plain YAML, without aliases"),
        ({"image": "[" * 30000}, "a.yaml, line 1: expected plain YAML"),
        ({"mode": "x", "negate": "[" + "9, " * 999 + "9]"}, "expected negate to be one of"),
    ],
)
def test_yaml_that_cannot_be_meant_is_one_short_error(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message) as caught:
        load_map(ros(tmp_path, **changes))
    assert len(str(caught.value)) < 400


def test_a_missing_image_names_its_yaml(tmp_path):
    path = ros(tmp_path, image="gone.pgm")
    with pytest.raises(FileNotFoundError, match=r"a.yaml: the image .*gone.pgm, does not exist"):
        load_map(path)


def test_one_file_needs_no_list(tmp_path):
    path = written(tmp_path, "a.txt", RIGHT)
    config = ArenaConfig(height=2, width=4, num_agents=1)
    for one in (path, str(path)):
        assert torch.equal(MapArenas.load(config, one).maps[0], load_map(path))


# ------------------------------------------------------------------------------ limits


def png_of(width, height):
    """A PNG that says it has this size, with hardly any content."""

    def chunk(kind, data):
        checked = kind + data
        return len(data).to_bytes(4, "big") + checked + zlib.crc32(checked).to_bytes(4, "big")

    size = width.to_bytes(4, "big") + height.to_bytes(4, "big")
    header = chunk(b"IHDR", size + bytes([8, 0, 0, 0, 0]))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"0")) + chunk(b"IEND", b"")


@pytest.mark.parametrize("size", [(1_000_000, 1), (1, 1_000_000), (9000, 9000), (20000, 9900)])
def test_giant_images_are_refused_before_they_take_memory(tmp_path, size):
    path = written(tmp_path, "a.png", png_of(*size))
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"a.png: .*pixels are too many: at most 20000 a side"):
        load_map(path)
    assert tracemalloc.get_traced_memory()[1] < 2e6
    tracemalloc.stop()


def test_a_giant_text_is_refused_before_it_is_read(tmp_path):
    text = "type octile\nheight 1\nwidth 5000000\nmap\n" + "." * 5_000_000
    with pytest.raises(ValueError, match=r"a.map, line 3|1 x 5000000 pixels are too many"):
        load_map(written(tmp_path, "a.map", text))
    with pytest.raises(ValueError, match="pixels are too many"):
        load_map(written(tmp_path, "a.txt", "." * 30_000))


def test_too_many_cells_are_refused(tmp_path):
    path = image(tmp_path, "a.png", np.zeros((100, 100), np.uint8))
    with pytest.raises(ValueError, match=r"a.png: 1e\+04 x 1e\+04 cells of 0.01 m are too many"):
        load_map(path, cell_size=0.01, resolution=1.0)


def test_a_large_image_is_read_in_seconds_and_agrees_with_areas_counted_by_hand(tmp_path):
    pixels = np.random.default_rng(0).random((5000, 5000)) < 0.1
    share = resample(pixels, 8)
    expected = pixels.reshape(625, 8, 625, 8).mean((1, 3))
    np.testing.assert_allclose(share, expected, atol=1e-12)


@pytest.mark.parametrize("pixels_per_cell", [0.3, 1, 1.5, 2.25, 7, 40])
def test_areas_of_cells_are_those_of_a_sum_over_pixels(pixels_per_cell):
    pixels = np.random.default_rng(1).random((11, 23)) < 0.4
    share = resample(pixels, pixels_per_cell)
    for row in range(share.shape[0]):
        for column in range(share.shape[1]):
            total = area = 0.0
            for i in range(11):
                down = min(i + 1, (row + 1) * pixels_per_cell) - max(i, row * pixels_per_cell)
                for j in range(23):
                    right = min(j + 1, (column + 1) * pixels_per_cell)
                    right -= max(j, column * pixels_per_cell)
                    part = max(down, 0) * max(right, 0)
                    area, total = area + part, total + part * pixels[i, j]
            assert share[row, column] == pytest.approx(total / area, abs=1e-9)


def refusals(path):
    """Why a file is refused, if it is."""
    try:
        load_map(path, cell_size=0.5)
    except (ValueError, FileNotFoundError) as error:
        return [str(error)]
    return []


def test_mutated_files_are_read_or_refused_in_one_line(tmp_path):
    """Bits flipped, bytes cut, doubled and swapped: no other error than these."""
    rng = np.random.default_rng(0)
    originals = {
        "a.txt": RIGHT.encode(),
        "a.map": MOVINGAI.encode(),
        "a.png": image(tmp_path, "o.png", GREY).read_bytes(),
        "a.gif": image(tmp_path, "o.gif", GREY).read_bytes(),
        "a.bmp": image(tmp_path, "o.bmp", GREY).read_bytes(),
        "a.tif": image(tmp_path, "o.tif", GREY).read_bytes(),
        "a.pgm": image(tmp_path, "floor.pgm", GREY).read_bytes(),
        "a.yaml": ROS.encode(),
    }
    for name, content in originals.items():
        for _ in range(65):
            mutant = bytearray(content)
            for _ in range(rng.integers(1, 4)):
                place = int(rng.integers(len(mutant))) if mutant else 0
                kind = rng.integers(4)
                if kind == 0 and mutant:
                    mutant[place] ^= 1 << int(rng.integers(8))
                elif kind == 1:
                    del mutant[place : place + int(rng.integers(1, 9))]
                elif kind == 2:
                    mutant[place:place] = mutant[place : place + 5] * int(rng.integers(1, 4))
                else:
                    mutant[place:place] = bytes(rng.integers(0, 256, 3, dtype=np.uint8))
            path = written(tmp_path, name, bytes(mutant))
            for error in refusals(path):
                assert name in error or "floor" in error
                assert len(error.splitlines()) <= 2
