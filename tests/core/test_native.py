"""The native kernel beyond its numbers, which tests/core/test_frontier.py holds against torch."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import marl_explore
from marl_explore import FrontierReachability
from marl_explore.core import frontier, native
from marl_explore.core.native import operator


def random_maps(*batch, height=9, width=13, seed=0):
    generator = torch.Generator().manual_seed(seed)
    maps = torch.randint(-1, 2, (*batch, height, width), dtype=torch.int8, generator=generator)
    rows = torch.randint(0, height, batch, generator=generator)
    columns = torch.randint(0, width, batch, generator=generator)
    return maps, torch.stack((rows, columns), -1)


def open_maps(*batch, height, width, seed=0):
    """Maps with long paths: mostly free, some obstacles, few unknown cells."""
    generator = torch.Generator().manual_seed(seed)
    chance = torch.rand(*batch, height, width, generator=generator)
    maps = torch.zeros(*batch, height, width, dtype=torch.int8)
    maps[chance < 0.25], maps[chance < 0.02] = 1, -1
    return maps, random_maps(*batch, height=height, width=width, seed=seed)[1]


@pytest.mark.skipif(shutil.which("cc") is None, reason="the kernel is built where there is a cc")
def test_the_kernel_is_built_and_in_use():
    assert native.missing() is None
    assert marl_explore.backend() == "native: C kernel"


needs_kernel = pytest.mark.skipif(native.missing() is not None, reason=str(native.missing()))


@needs_kernel
@pytest.mark.parametrize(
    "size", [(32, 16), (33, 16), (32, 17), (33, 32), (64, 40), (1, 2000), (128, 128)]
)
def test_large_grids_agree_with_torch(size):
    """On both sides of the size from which the kernel searches with a queue."""
    maps, positions = open_maps(12, height=size[0], width=size[1])
    expected = frontier.feature_table(maps, positions)
    assert expected.any()
    assert operator.feature_table(maps, positions).equal(expected)


@needs_kernel
@pytest.mark.parametrize(("height", "width", "longest"), [(32, 16, 248), (31, 31, 479)])
def test_the_longest_paths_agree_with_torch(height, width, longest):
    """Nearly as long as a byte counts, where the kernel has a byte, and beyond."""
    columns = []
    for column in range(width):
        wall = torch.ones(height, dtype=torch.int8)
        wall[-1 if column % 4 == 1 else 0] = 0
        columns.append(wall if column % 2 else torch.zeros(height, dtype=torch.int8))
    maps = torch.stack(columns, -1).unsqueeze(0)
    last = width - 1 - (width + 1) % 2
    maps[0, 0 if last % 4 else -1, last] = -1  # at the end of the last free column
    positions = torch.tensor([[0, 0]])
    table = operator.feature_table(maps, positions, None)
    assert table.any()
    assert frontier.paths(maps, positions)[1].max() == longest
    assert table.equal(frontier.feature_table(maps, positions, None))


@needs_kernel
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_threads_share_the_robots(threads):
    maps, positions = random_maps(operator.ROBOTS_PER_THREAD * 3 + 1)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        table = operator.feature_table(maps, positions)
    finally:
        torch.set_num_threads(before)
    assert table.equal(frontier.feature_table(maps, positions))


@needs_kernel
def test_inputs_need_not_be_contiguous():
    maps, positions = random_maps(6, 4)
    table = operator.feature_table(maps.transpose(0, 1), positions.transpose(0, 1))
    assert table.equal(operator.feature_table(maps, positions).transpose(0, 1))


@needs_kernel
def test_the_operator_fits_torch():
    maps, positions = random_maps(5)
    torch.library.opcheck(torch.ops.marl_explore.frontier_table, (maps, positions, 1, True))


@needs_kernel
def test_vmap_over_any_dimension():
    maps, positions = random_maps(6, 4)
    expected = operator.feature_table(maps, positions)
    assert torch.vmap(operator.feature_table)(maps, positions).equal(expected)
    along = torch.vmap(operator.feature_table, in_dims=(1, 1), out_dims=1)(maps, positions)
    assert along.equal(expected)
    one_map = torch.vmap(operator.feature_table, in_dims=(None, 0))(maps[0, 0], positions[:, 0])
    for row, position in zip(one_map, positions[:, 0], strict=True):
        assert row.equal(operator.feature_table(maps[0, 0], position))


def test_fake_tensors_have_the_shape():
    from torch._subclasses.fake_tensor import FakeTensorMode

    with FakeTensorMode():
        maps, positions = torch.empty(7, 3, 5, 5, dtype=torch.int8), torch.empty(7, 3, 2).long()
        table = operator.feature_table(maps, positions)
    assert table.shape == (7, 3, 8, 3)
    assert table.dtype == torch.float32


@pytest.mark.parametrize(
    ("maps", "positions", "message"),
    [
        (torch.zeros(3, 3), torch.zeros(2).long(), "grid must be int8 on the CPU"),
        (torch.zeros(3, 3, dtype=torch.int8), torch.zeros(2), "position must be int64"),
        (torch.zeros(4, 3, 3, dtype=torch.int8), torch.zeros(2).long(), r"shape \(4, 2\)"),
    ],
)
def test_other_inputs_are_refused(maps, positions, message):
    with pytest.raises(ValueError, match=message):
        operator.feature_table(maps, positions)


def test_an_unknown_normalisation_is_refused():
    with pytest.raises(ValueError, match="normalize='max' is not one of"):
        operator.feature_table(*random_maps(1), "max")


# ------------------------------------------------------------------ without a kernel


@pytest.fixture
def without_kernel(monkeypatch):
    reason = OSError("it was not built")
    monkeypatch.setattr(native, "_load", lambda name: reason)


@pytest.mark.usefixtures("without_kernel")
def test_without_a_kernel_torch_is_used_and_backend_says_why():
    assert marl_explore.backend() == "torch: the native kernel is missing, it was not built"
    maps, positions = random_maps(5)
    assert FrontierReachability().compute(maps, positions).any()
    with pytest.raises(RuntimeError, match="backend='native' cannot be used: it was not built"):
        FrontierReachability(backend="native")


def test_a_broken_library_is_no_reason_to_fail(tmp_path):
    """A file that is no library stands where the kernel should be."""
    code = (
        f"import marl_explore.core.native as n, pathlib; n.__file__ = r'{tmp_path}/__init__.py';"
        f"pathlib.Path(r'{tmp_path}/_frontier.so').write_text('no library');"
        "print(n.backend())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.startswith("torch: the native kernel is missing"), done.stderr


@needs_kernel
def test_positions_outside_the_map_are_refused():
    maps, positions = random_maps(4)
    for cell in ((-1, 0), (0, 13), (9, 0), (10**9, -(10**9))):
        positions[2] = torch.tensor(cell)
        with pytest.raises(ValueError, match="outside its map of 9 x 13 cells"):
            operator.feature_table(maps, positions)


@needs_kernel
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_process_has_threads_of_its_own():
    code = """
import os, torch
from marl_explore.core.native import operator
torch.set_num_threads(2)
maps = torch.zeros(4096, 5, 5, dtype=torch.int8)
positions = torch.zeros(4096, 2, dtype=torch.int64)
operator.feature_table(maps, positions)
child = os.fork()
operator.feature_table(maps, positions)
if child:
    os._exit(os.waitpid(child, 0)[1])
os._exit(0)
"""
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


@needs_kernel
@pytest.mark.parametrize("backend", ["auto", "torch", "native"])
def test_every_backend_of_the_transform_gives_the_same(backend):
    maps, positions = random_maps(20)
    table = FrontierReachability(backend=backend).compute(maps, positions)
    assert table.equal(frontier.feature_table(maps, positions))


def test_levels_go_with_torch():
    maps, positions = random_maps(20)
    table = FrontierReachability(levels=2, normalize=None).compute(maps, positions)
    assert table[..., 1].max() == 2
    with pytest.raises(ValueError, match="levels=2"):
        FrontierReachability(levels=2, backend="native")
    with pytest.raises(ValueError, match="levels=0"):
        FrontierReachability(levels=0)


def test_a_source_folder_without_kernels_says_so(monkeypatch):
    monkeypatch.setattr(native, "EXTENSION_SUFFIXES", [])
    reason = str(native._load.__wrapped__("frontier"))
    source = Path(native.__file__).parents[3]
    assert f"this is the source in {source}" in reason
    assert "pip install -e ." in reason
    monkeypatch.setattr(native, "__file__", "/somewhere/site-packages/marl_explore/core/native/x")
    reason = str(native._load.__wrapped__("frontier"))
    assert reason == "it was not built: the package was installed without a C compiler"


def test_an_older_library_without_a_function_is_no_kernel(monkeypatch):
    functions = native._FUNCTIONS | {"step": ("world", "marl_explore_of_tomorrow", ())}
    monkeypatch.setattr(native, "_FUNCTIONS", functions)
    assert "marl_explore_of_tomorrow" in str(native._load.__wrapped__("step"))
