"""Map files of every format, and every way in which they can be broken."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from marl_explore.arenas import load_map

RIGHT = """\
..#.
#..#
"""
OBSTACLES = [[0, 0, 1, 0], [1, 0, 0, 1]]
ROS = """\
image: floor.pgm
resolution: 0.1
origin: [0.0, 0.0, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""
MOVINGAI = "type octile\nheight 2\nwidth 4\nmap\n.G@S\nT..W\n"


def written(folder, name, content):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def image(folder, name, pixels, mode=None):
    path = folder / name
    Image.fromarray(np.array(pixels)).convert(mode).save(path)
    return path


def bits(obstacles):
    return obstacles.int().tolist()


GREY = np.array([[255, 200, 0, 128], [127, 255, 255, 10]], np.uint8)


# ------------------------------------------------------------------------ formats


@pytest.mark.parametrize("text", [RIGHT, RIGHT + "\n\n", RIGHT.replace("\n", "\r\n"), RIGHT[:-1]])
def test_ascii(tmp_path, text):
    assert bits(load_map(written(tmp_path, "room.txt", text))) == OBSTACLES


def test_digits_are_free(tmp_path):
    assert bits(load_map(written(tmp_path, "room.txt", "1.#0\n#2.#\n"))) == OBSTACLES


@pytest.mark.parametrize("text", [MOVINGAI, MOVINGAI.replace("\n", "\r\n") + "\n"])
def test_movingai(tmp_path, text):
    assert bits(load_map(written(tmp_path, "room.map", text))) == OBSTACLES


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "LA", "P"])
def test_dark_pixels_of_a_png_are_obstacles(tmp_path, mode):
    assert bits(load_map(image(tmp_path, "room.png", GREY, mode))) == OBSTACLES


def test_a_pgm_and_a_black_and_white_png_are_read_alike(tmp_path):
    assert bits(load_map(image(tmp_path, "room.PGM", GREY))) == OBSTACLES
    assert bits(load_map(image(tmp_path, "room.png", GREY > 127))) == OBSTACLES


def test_a_jpeg_is_read(tmp_path):
    blocks = np.kron(1 - np.array(OBSTACLES), np.ones((16, 16))).astype(np.uint8) * 255
    path = image(tmp_path, "room.jpg", blocks)
    assert bits(load_map(path, cell_size=1.6, resolution=0.1, max_occupied=0.4)) == OBSTACLES


def test_sixteen_bits_of_grey_are_scaled(tmp_path):
    deep = GREY.astype(np.uint16) * 257
    assert bits(load_map(image(tmp_path, "room.png", deep))) == OBSTACLES
    pgm = b"P5 4 2 65535\n" + deep.astype(">u2").tobytes()
    assert bits(load_map(written(tmp_path, "room.pgm", pgm))) == OBSTACLES


def test_the_threshold_is_a_darkness(tmp_path):
    path = image(tmp_path, "room.png", GREY)
    assert bits(load_map(path, threshold=0.1)) == [[0, 1, 1, 1], [1, 0, 0, 1]]
    assert bits(load_map(path, threshold=1.0)) == [[0, 0, 1, 0], [0, 0, 0, 0]]


def test_transparent_pixels_are_obstacles(tmp_path):
    pixels = np.array([[[255, 255], [255, 0]]], np.uint8)
    assert bits(load_map(image(tmp_path, "room.png", pixels))) == [[0, 1]]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, [[0, 1, 1]]),  # 205 is map_server's grey of unknown cells, 0.1961 dark
        ({"free_thresh: 0.196": "free_thresh: 0.25"}, [[0, 0, 1]]),
        ({"negate: 0": "negate: true"}, [[1, 1, 0]]),
        ({"negate: 0": "negate: 0\nmode: scale"}, [[0, 1, 1]]),
    ],
)
def test_ros_maps_are_free_where_they_are_surely_free(tmp_path, changes, expected):
    image(tmp_path, "floor.pgm", np.array([[254, 205, 0]], np.uint8))
    text = ROS
    for old, new in changes.items():
        text = text.replace(old, new)
    path = written(tmp_path, "floor.yaml", text)
    assert bits(load_map(path, cell_size=0.1)) == expected


def test_a_ros_map_knows_its_resolution(tmp_path):
    pixels = np.full((10, 15), 254, np.uint8)
    pixels[7, 12] = 0
    image(tmp_path, "floor.pgm", pixels)
    path = written(tmp_path, "floor.yml", ROS)
    assert bits(load_map(path, cell_size=0.5)) == [[0, 0, 0], [0, 0, 1]]
    with pytest.raises(ValueError, match=r"resolution=0.05 is not allowed.*says 0.1"):
        load_map(path, resolution=0.05)


# -------------------------------------------------------------------- broken files

RIGHT_IMAGE = b"P5 1 1 255\n\xff"
BROKEN = [
    ("a.txt", "", "line 1: expected rows of cells, got none"),
    ("a.txt", "...\n..\n", "line 2: expected 3 cells, got 2"),
    ("a.txt", "...\n\n...\n", "line 2: expected 3 cells, got 0"),
    ("a.txt", "...\n.x.\n", r"line 2, column 2: expected one of '#.0123456789\$@!', got 'x'"),
    ("a.txt", b"..\n.\xff\n", "line 2, column 2: expected one of"),
    ("a.txt", "0.2\n", r"expected robots 0, 1, 2 \.\.\. once each, got \['0', '2'\]"),
    ("a.txt", "0.1\n..1\n", r"once each, got \['0', '1', '1'\]"),
    ("a.map", "", "line 1: expected 'type <name>', got ''"),
    ("a.map", "type octile\nwidth 4\n", "line 3: expected 'height <rows>', got ''"),
    ("a.map", "type octile\nheight 2\nwidth x\n", "line 3: expected 'width <columns>', got 'width"),
    ("a.map", "type octile\nheight 2\nwidth 4\n....\n", "line 4: expected 'map', got '....'"),
    ("a.map", MOVINGAI + "....\n", "expected 2 rows after line 4, got 3"),
    ("a.map", MOVINGAI.replace(".G@S", ".G@"), "line 5: expected 4 cells, got 3"),
    ("a.map", MOVINGAI.replace("T..W", "T.#W"), "line 6, column 3: expected one of '.GS@OTW', got"),
    ("a.map", "type octile\nheight 0\nwidth 0\nmap\n", "line 5: expected rows of cells, got none"),
    ("a.png", b"P5", "expected a PNG, PGM, JPEG, BMP, TIFF or GIF image"),
    ("a.png", "", "expected a PNG, PGM, JPEG, BMP, TIFF or GIF image"),
    ("a.pgm", b"P5 3 3 255\n\xff", "expected a PNG, PGM, JPEG, BMP, TIFF or GIF image"),
    ("a.pgm", b"P5 x y z\n\xff", "expected a PNG, PGM, JPEG, BMP, TIFF or GIF image"),
    ("a.yaml", "", r"expected the keys .* missing: \['image', 'resolution', 'negate'"),
    ("a.yaml", "- 1\n", "expected the keys"),
    ("a.yaml", ROS + "mode: [\n", "line 8: expected YAML"),
    ("a.yaml", ROS.replace("negate: 0\n", ""), r"missing: \['negate'\]"),
    ("a.yaml", ROS.replace("0.1", "fine"), "expected a number resolution, positive, got 'fine'"),
    ("a.yaml", ROS.replace("0.1\n", "-.inf\n"), "expected a number resolution, positive, got -inf"),
    ("a.yaml", ROS.replace("0.1\n", ".nan\n"), "expected a number resolution, positive, got nan"),
    ("a.yaml", ROS.replace("0.196", "19"), r"expected a number free_thresh, in \[0, 1\], got 19"),
    ("a.yaml", ROS.replace("0.65", "yes"), "expected a number occupied_thresh, .* got True"),
    ("a.yaml", ROS.replace("negate: 0", "negate: 2"), "expected negate to be one of"),
    ("a.yaml", ROS + "mode: raw\n", "expected mode to be one of .*'scale'.*, got 'raw'"),
    ("a.doc", "GIF", r"expected a file that ends in one of .*'\.map'"),
]


@pytest.mark.parametrize(("name", "content", "message"), BROKEN)
def test_broken_files_are_named_with_what_was_expected(tmp_path, name, content, message):
    written(tmp_path, "floor.pgm", RIGHT_IMAGE)
    path = written(tmp_path, name, content)
    with pytest.raises(ValueError, match=f"{name}.*{message}") as caught:
        load_map(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("name", ["a.txt", "a.map", "a.png", "a.yaml"])
def test_files_that_do_not_exist_are_named(tmp_path, name):
    with pytest.raises(FileNotFoundError, match=name):
        load_map(tmp_path / name)


def test_a_ros_map_without_its_image_names_the_image(tmp_path):
    with pytest.raises(FileNotFoundError, match="floor.pgm"):
        load_map(written(tmp_path, "a.yaml", ROS))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"cell_size": 0}, "cell_size=0 .* positive"),
        ({"resolution": -1.0}, "resolution=-1.0 .* positive"),
        ({"max_occupied": 1.0}, r"max_occupied=1.0 .* \[0, 1\)"),
        ({"threshold": 2}, r"threshold=2 .* \(0, 1\]"),
        ({"threshold": 0.3}, "threshold=0.3 .* not a plain image"),
    ],
)
def test_arguments_out_of_range_are_refused(tmp_path, arguments, message):
    with pytest.raises(ValueError, match=message):
        load_map(written(tmp_path, "room.txt", RIGHT), **arguments)
