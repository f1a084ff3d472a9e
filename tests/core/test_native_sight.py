"""The kernels for sight beyond their numbers, which test_sight.py holds against torch."""

from __future__ import annotations

import shutil

import pytest
import torch

from marl_explore.config.shapes import Sight
from marl_explore.core import native, sight
from marl_explore.core.native import choice
from marl_explore.core.native import sight as kernel
from marl_explore.core.native.choice import MISSING

needs_kernel = pytest.mark.skipif(MISSING["sight"] is not None, reason=str(MISSING["sight"]))

DISCS = Sight("disc", (3.0, 1.5, 4.0), line_of_sight=True)


def random_walls(*batch, side=9, seed=0):
    return torch.rand(*batch, side, side, generator=torch.Generator().manual_seed(seed)) < 0.2


def random_queries(number, maps=5, height=9, width=13):
    """Maps, and queries about them for the robots of ``DISCS``."""
    generator = torch.Generator().manual_seed(number)
    size = (maps, height, width)
    grid = torch.randint(-1, 2, size, dtype=torch.int8, generator=generator)
    below = (maps, height * width, len(DISCS.radii))
    return grid, *(torch.randint(0, high, (number,), generator=generator) for high in below)


def masks():
    return sight.shapes(DISCS, torch.device("cpu"))


def found(*inputs):
    return kernel.expected_discoveries(*inputs, masks(), DISCS.line_of_sight)


def reference(*inputs):
    return sight.expected_discoveries(*inputs, DISCS, "torch")


@pytest.mark.skipif(shutil.which("cc") is None, reason="the kernel is built where there is a cc")
def test_the_kernels_are_built():
    assert native.missing("sight") is None
    assert native.missing("discoveries") is None


@needs_kernel
@pytest.mark.parametrize("hides", [False, True])
def test_masks_may_have_any_shape(hides):
    """Even such that obstacles outside a mask hide cells inside it."""
    generator = torch.Generator().manual_seed(0)
    grid = torch.randint(-1, 2, (50, 11, 11), dtype=torch.int8, generator=generator)
    shapes = torch.rand(4, 11, 11, generator=generator) < 0.5
    kind = torch.randint(0, 4, (50,), generator=generator)
    centre = torch.full((50,), 60)
    expected = (grid == -1) & shapes[kind]
    if hides:
        expected &= sight.line_of_sight(grid == 1, "torch")
    result = kernel.expected_discoveries(grid, torch.arange(50), centre, kind, shapes, hides)
    assert result.equal(expected.sum((-2, -1)))


@needs_kernel
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_threads_share_the_windows(threads, monkeypatch):
    monkeypatch.setattr(kernel, "CELLS_PER_THREAD", 1000)
    walls, queries = random_walls(101), random_queries(101)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        seen, discoveries = kernel.line_of_sight(walls), found(*queries)
    finally:
        torch.set_num_threads(before)
    assert seen.equal(sight.line_of_sight(walls, "torch"))
    assert discoveries.equal(reference(*queries))


@needs_kernel
def test_inputs_need_not_be_contiguous():
    walls = random_walls(6, 4)
    assert kernel.line_of_sight(walls.mT).equal(kernel.line_of_sight(walls.mT.contiguous()))
    swapped = kernel.line_of_sight(walls.transpose(0, 1))
    assert swapped.equal(kernel.line_of_sight(walls).transpose(0, 1))
    grid, *queries = random_queries(20)
    grid = grid.mT.contiguous().mT
    queries = [entry.repeat_interleave(2)[::2] for entry in queries]
    shapes = masks().mT.contiguous().mT
    result = kernel.expected_discoveries(grid, *queries, shapes, True)
    assert result.equal(reference(grid.contiguous(), *queries))


@needs_kernel
def test_inputs_stay_as_they_are():
    walls, queries = random_walls(20), random_queries(20)
    before = [entry.clone() for entry in (walls, *queries, masks())]
    kernel.line_of_sight(walls)
    found(*queries)
    assert all(a.equal(b) for a, b in zip((walls, *queries, masks()), before, strict=True))


@needs_kernel
def test_the_operators_fit_torch():
    operators = torch.ops.marl_explore
    torch.library.opcheck(operators.line_of_sight, (random_walls(5),))
    torch.library.opcheck(operators.expected_discoveries, (*random_queries(5), masks(), True))


@needs_kernel
@pytest.mark.filterwarnings("ignore:.*lru_cache.*:UserWarning")
def test_compiled_code_uses_the_kernels():
    walls, queries = random_walls(5), random_queries(5)
    compiled = torch.compile(sight.line_of_sight, backend="eager", fullgraph=True)
    assert compiled(walls).equal(sight.line_of_sight(walls, "torch"))
    compiled = torch.compile(
        lambda *x: sight.expected_discoveries(*x, DISCS), backend="eager", fullgraph=True
    )
    assert compiled(*queries).equal(reference(*queries))


@needs_kernel
def test_vmap_over_any_dimension():
    walls = random_walls(6, 4)
    expected = kernel.line_of_sight(walls)
    assert torch.vmap(kernel.line_of_sight)(walls).equal(expected)
    along = torch.vmap(kernel.line_of_sight, in_dims=1, out_dims=1)(walls)
    assert along.equal(expected)
    grid, *queries = random_queries(24)
    rows = [entry.view(6, 4) for entry in queries]
    expected = found(grid, *queries).view(6, 4)
    assert torch.vmap(found, in_dims=(None, 0, 0, 0))(grid, *rows).equal(expected)
    along = torch.vmap(found, in_dims=(None, 1, 1, 1), out_dims=1)(grid, *rows)
    assert along.equal(expected)
    assert torch.vmap(found)(grid.expand(6, -1, -1, -1), *rows).equal(expected)


def test_fake_tensors_have_the_shape():
    from torch._subclasses.fake_tensor import FakeTensorMode

    with FakeTensorMode():
        seen = kernel.line_of_sight(torch.empty(7, 3, 5, 5, dtype=torch.bool))
        grid, which = torch.empty(7, 9, 9, dtype=torch.int8), torch.empty(3, dtype=torch.int64)
        shapes = torch.empty(2, 5, 5, dtype=torch.bool)
        result = kernel.expected_discoveries(grid, which, which, which, shapes, True)
    assert (seen.shape, seen.dtype) == ((7, 3, 5, 5), torch.bool)
    assert (result.shape, result.dtype) == ((3,), torch.int64)


@pytest.mark.parametrize(
    "walls",
    [
        torch.zeros(3, 3),
        torch.zeros(2, 4, 4, dtype=torch.bool),
        torch.zeros(2, 3, 5, dtype=torch.bool),
        torch.zeros(3, dtype=torch.bool),
        torch.zeros(2, 3, 3, dtype=torch.bool, device="meta"),
    ],
)
def test_other_windows_are_refused(walls):
    with pytest.raises(ValueError, match=r"wall must be torch.bool \[..., 2k \+ 1, 2k \+ 1\]"):
        kernel.line_of_sight(walls)


@pytest.mark.parametrize(
    ("name", "entry"),
    [
        ("grid", torch.zeros(5, 9, 13)),
        ("grid", torch.zeros(9, 13, dtype=torch.int8)),
        ("which", torch.zeros(4, dtype=torch.int32)),
        ("which", torch.zeros(2, 2, dtype=torch.int64)),
        ("cell", torch.zeros(3, dtype=torch.int64)),
        ("kind", torch.zeros(4)),
        ("masks", torch.ones(9, 9, dtype=torch.bool)),
        ("masks", torch.ones(3, 8, 8, dtype=torch.bool)),
        ("masks", torch.ones(3, 9, 9)),
    ],
)
def test_other_queries_are_refused(name, entry):
    names = ("grid", "which", "cell", "kind", "masks")
    inputs = dict(zip(names, (*random_queries(4), masks()), strict=True))
    with pytest.raises(ValueError, match=f"{name} must be "):
        kernel.expected_discoveries(**{**inputs, name: entry}, hides=True)


@needs_kernel
@pytest.mark.parametrize("place", [0, 3, 19])
def test_what_is_not_there_is_refused(place):
    for entry, message, wrong in (
        (1, "there is no such map, action or kind", (-1, 5, 2**62)),
        (2, "outside its map of 9 x 13 cells", (-1, 9 * 13, 2**62, -(2**62))),
        (3, "there is no such map, action or kind", (-1, 3, 2**62)),
    ):
        for value in wrong:
            queries = random_queries(20)
            queries[entry][place] = value
            with pytest.raises(ValueError, match=message):
                found(*queries)


# ------------------------------------------------------------------ without a kernel


def test_without_a_kernel_torch_is_used(monkeypatch):
    reason = OSError("it was not built")
    monkeypatch.setattr(native, "_load", lambda name: reason)
    for name in MISSING:
        monkeypatch.setitem(MISSING, name, str(reason))
    choice._say_slow.cache_clear()
    walls, queries = random_walls(5), random_queries(5)
    with pytest.warns(RuntimeWarning, match="native kernel is missing, it was not built"):
        assert sight.line_of_sight(walls).any()
    # said once
    assert sight.expected_discoveries(*queries, DISCS).equal(reference(*queries))
    for act in (
        lambda: sight.line_of_sight(walls, "native"),
        lambda: sight.expected_discoveries(*queries, DISCS, "native"),
    ):
        with pytest.raises(RuntimeError, match="cannot be used: it was not built"):
            act()
