"""Files that are written whole or not at all, and what is read of damaged ones."""

from __future__ import annotations

import errno
import json

import numpy as np
import pytest
import torch

from marl_explore.utils import files, tensor_files
from marl_explore.utils.curves import read_curve, rewind
from marl_explore.utils.files import atomic_write, write_text
from marl_explore.utils.json_files import digest, parse_object, read_json
from marl_explore.utils.memory import machine_memory, require_memory, weights_memory
from marl_explore.utils.tensor_files import read_tensors, write_tensors


def full_disk(*_, **__):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_an_error_while_writing_names_the_file_and_keeps_the_earlier_one(tmp_path, monkeypatch):
    path = tmp_path / "notes.txt"
    write_text(path, "before")
    monkeypatch.setattr(files.os, "replace", full_disk)
    with pytest.raises(OSError, match=f"No space left on device: '{path}'") as raised:
        write_text(path, "after")
    assert raised.value.errno == errno.ENOSPC
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_is_gone_is_named(tmp_path):
    path = tmp_path / "gone" / "notes.txt"
    with pytest.raises(FileNotFoundError, match=f"'{path}'"), atomic_write(path) as unfinished:
        unfinished.write_text("x")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not JSON"),
        ("[1]", "is not a JSON object: it is a list"),
        ('{"a": 1, "a": 2}', "is not JSON: a key stands there twice"),
        ('{"a":' * 50_000 + "1" + "}" * 50_000, "is nested too deeply"),
        ('{"a": 1', "is not JSON"),
    ],
)
def test_what_is_no_json_object_is_refused_by_its_name(tmp_path, text, message):
    with pytest.raises(ValueError, match=f"the spec {message}"):
        parse_object(text, "the spec")
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"{path} {message}"):
        read_json(path)


def test_files_that_cannot_be_read_as_text_are_refused(tmp_path):
    (tmp_path / "a.json").write_bytes(b"\xff\xfe")
    for name in ("a.json", "none.json"):
        with pytest.raises(ValueError, match=f"{name} cannot be read"):
            read_json(tmp_path / name)


def test_a_digest_is_that_of_the_content_not_of_its_order():
    assert digest({"a": 1, "b": [2.5, None]}) == digest({"b": [2.5, None], "a": 1})
    assert digest({"a": 1}) != digest({"a": 2})
    assert digest(json.loads(json.dumps({"a": 0.1 + 0.2}))) == digest({"a": 0.1 + 0.2})


TENSORS = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.tensor(3, dtype=torch.int64)}


def test_every_flipped_bit_of_a_tensor_file_is_noticed(tmp_path):
    path = tmp_path / "t.safetensors"
    write_tensors(path, "kind/2", {"spec": "{}"}, TENSORS)
    texts, tensors = read_tensors(path, ("kind/2",), "test")
    assert texts == {"spec": "{}"}
    assert all(torch.equal(tensors[name], TENSORS[name]) for name in TENSORS)
    whole = path.read_bytes()
    for bit in range(8 * len(whole)):
        mutant = bytearray(whole)
        mutant[bit // 8] ^= 1 << bit % 8
        path.write_bytes(mutant)
        try:
            texts, tensors = read_tensors(path, ("kind/2",), "test")
        except ValueError:
            continue
        assert [*texts.values()] == ["{}"], bit  # a key has another name: its reader misses it
        assert all(torch.equal(tensors[name], TENSORS[name]) for name in TENSORS)


def test_formats_without_a_digest_are_read_where_they_are_allowed(tmp_path):
    path = tmp_path / "old.safetensors"
    tensor_files.save_file(TENSORS, path, {"format": "kind/1", "spec": "{}"})
    with pytest.raises(ValueError, match="'kind/1', expected 'kind/2'"):
        read_tensors(path, ("kind/2",), "test")
    with pytest.raises(ValueError, match="do not match its SHA-256"):
        read_tensors(path, ("kind/2", "kind/1"), "test")
    read_tensors(path, ("kind/2", "kind/1"), "test", unsigned=("kind/1",))


def test_a_full_disk_under_a_tensor_file_is_one_error(tmp_path, monkeypatch):
    def fail(*_):
        raise tensor_files.SafetensorError("I/O error: No space left on device")

    monkeypatch.setattr(tensor_files, "save_file", fail)
    path = tmp_path / "t.safetensors"
    with pytest.raises(OSError, match=f"{path} cannot be written: .*No space"):
        write_tensors(path, "kind/2", {}, TENSORS)
    assert not list(tmp_path.iterdir())


def test_curves_are_read_without_their_unfinished_row(tmp_path):
    path = tmp_path / "reward.csv"
    path.write_text("10,0.5\n20,nan\n30,1.25\n40,7")
    np.testing.assert_equal(read_curve(path), [[10, 0.5], [20, np.nan], [30, 1.25]])
    rewind(path, 20)
    assert path.read_text() == "10,0.5\n20,nan\n"


@pytest.mark.parametrize("row", ["20", "20,x", "x,1.0", "20,1.0,3", "\x00\x00", "9" * 400 + ",1"])
def test_rows_that_are_none_are_refused_by_their_line(tmp_path, row):
    path = tmp_path / "reward.csv"
    path.write_text(f"10,0.5\n{row}\n30,1.25\n")
    for read in (read_curve, lambda path: rewind(path, 100)):
        with pytest.raises(ValueError, match=f"{path}, line 2 is not a row of a curve"):
            read(path)


def test_what_does_not_fit_this_machine_is_refused():
    require_memory("nothing", 0.0)
    with pytest.raises(ValueError, match=r"two suns would need about .* GiB .* this machine has"):
        require_memory("two suns", 2.0 * machine_memory())


def test_the_size_of_weights_is_known_without_making_them():
    assert weights_memory(lambda: torch.nn.Linear(3, 5)) == 4 * (15 + 5)
    assert weights_memory(lambda: torch.nn.Linear(10**9, 10**9)) == 4 * (10**18 + 10**9)
    assert weights_memory(lambda: torch.nn.Linear(2**62, 2**62)) == float("inf")
