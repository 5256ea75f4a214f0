"""Memory that is kept for the next frame is never given out while somebody uses it."""

import gc
import threading

import numpy as np
import pytest
import torch
from cases_splat import random_splats

pytest.importorskip("numba")

from kfgs.splat import bin_tiles, composite
from kfgs.splat.engines.cpu import memory as numba_memory
from kfgs.splat.engines.cpu.memory import CACHE_LINE, take_memory

LIKE = torch.empty(0)
SIZE = 5000
"""Numbers taken at once: 20 kB, far above the SMALLEST_KEPT of these tests."""


@pytest.fixture(autouse=True)
def _nothing_kept(monkeypatch):
    """Each test begins with nothing kept, and even little is."""
    monkeypatch.setattr(numba_memory, "_kept", numba_memory._Kept())
    monkeypatch.setattr(numba_memory, "SMALLEST_KEPT", 1024)


def _kept_bytes():
    return sum(buffer.nbytes for buffer in numba_memory._kept.buffers)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.int32])
@pytest.mark.parametrize("shape", [(SIZE,), (70, 51, 3), (0, 4), (2, 3)])
def test_dtype_shape_and_alignment(dtype, shape):
    like = torch.empty(3, dtype=dtype, requires_grad=dtype.is_floating_point)
    for _ in range(3):  # new, and handed out again
        tensor = take_memory(like, *shape)
        assert (tensor.dtype, tensor.shape, tensor.device) == (dtype, shape, like.device)
        assert tensor.is_contiguous()
        assert not tensor.requires_grad
        assert tensor.numel() < SIZE or tensor.data_ptr() % CACHE_LINE == 0
        tensor.fill_(1)
        assert tensor.sum() == tensor.numel()
        del tensor


def test_memory_is_handed_out_again_once_it_is_free():
    first = take_memory(LIKE, SIZE)
    place = first.data_ptr()
    del first
    second = take_memory(LIKE, SIZE)
    assert second.data_ptr() == place
    third = take_memory(LIKE, SIZE)
    assert third.data_ptr() != place
    del second
    assert take_memory(LIKE, 50, 100).data_ptr() == place  # the same bytes in another shape
    assert take_memory(torch.empty(0, dtype=torch.float64), SIZE // 2).data_ptr() == place  # and of another type
    assert len(numba_memory._kept.buffers) == 2


HOLDERS = {
    "itself": lambda t: t,
    "a view": lambda t: t.view(50, 100)[3:5],
    "one number": lambda t: t[17],
    "detached": lambda t: t.detach(),
    "as a numpy array": lambda t: t.numpy(),
    "a slice of a numpy array": lambda t: t.numpy()[10:20],
    "its storage": lambda t: t.untyped_storage(),
    "seen as bytes": lambda t: t.view(torch.uint8),
    "through the array interface": lambda t: np.asarray(t),
    "through DLPack": lambda t: np.from_dlpack(t),
    "in an autograd graph": lambda t: torch.ones(SIZE, requires_grad=True) * t,
    "in an iterator": lambda t: iter(t),
    "a memoryview": lambda t: memoryview(t.numpy()),
    "a parameter": lambda t: torch.nn.Parameter(t),
    "every seventh number": lambda t: t.as_strided((5,), (7,)),
}


@pytest.mark.parametrize("held", HOLDERS)
def test_memory_in_use_is_not_handed_out(held):
    tensor = take_memory(LIKE, SIZE).fill_(1)
    place = tensor.data_ptr()
    holder = HOLDERS[held](tensor)
    del tensor
    gc.collect(1)  # what the test made is young
    others = [take_memory(LIKE, SIZE).fill_(7) for _ in range(3)]
    assert place not in [other.data_ptr() for other in others]
    del holder
    gc.collect(1)  # what the test made is young
    assert take_memory(LIKE, SIZE).data_ptr() == place


def test_no_more_is_kept_than_allowed(monkeypatch):
    monkeypatch.setattr(numba_memory, "MOST_KEPT", 50_000)  # two buffers of 20 kB
    tensors = [take_memory(LIKE, SIZE).fill_(i) for i in range(5)]
    assert 2 * 4 * SIZE <= _kept_bytes() <= 50_000
    for i, tensor in enumerate(tensors):  # those that are no longer kept still belong to their owners
        assert (tensor == i).all()
    assert len({tensor.data_ptr() for tensor in tensors}) == 5
    latest = {tensor.data_ptr() for tensor in tensors[3:]}
    del tensors, tensor
    assert {take_memory(LIKE, SIZE).data_ptr()} <= latest
    large = take_memory(LIKE, 20_000).fill_(9)  # alone more than what may be kept
    assert (large == 9).all()
    assert 2 * 4 * SIZE <= _kept_bytes() <= 50_000  # and does not drive the others out


def test_memory_is_handed_back_on_request():
    mine = take_memory(LIKE, SIZE).fill_(3)
    numba_memory.free_memory()
    assert numba_memory._kept.buffers == []
    take_memory(LIKE, SIZE).fill_(7)
    assert (mine == 3).all()  # what is in use stays


def test_each_thread_has_its_own():
    place = take_memory(LIKE, SIZE).data_ptr()
    found = []

    def other():
        found.append(take_memory(LIKE, SIZE).fill_(1))
        del found[0]
        found.append(take_memory(LIKE, SIZE).data_ptr())
        found.append(len(numba_memory._kept.buffers))

    thread = threading.Thread(target=other)
    thread.start()
    thread.join()
    assert found[1] == 1
    assert take_memory(LIKE, SIZE).data_ptr() == place
    assert len(numba_memory._kept.buffers) == 1


def _frame(seed, channels=3, grad=False):
    projected, features = random_splats(60, 45, 37, seed=seed, dtype=torch.float32, channels=channels)
    tiles = bin_tiles(projected, 45, 37)
    inputs = [v.requires_grad_(grad) for v in (projected.means2d, projected.conics, projected.opacities, features)]
    return inputs, composite(*inputs, tiles, engine="numba")


@pytest.mark.parametrize("channels", [3, 40])
def test_frames_kept_at_once_do_not_alias(channels):
    frames = [_frame(seed, channels)[1] for seed in range(4)]
    copies = [(maps.clone(), alphas.clone()) for maps, alphas in frames]
    assert len({maps.data_ptr() for maps, _ in frames}) == 4
    _frame(9, channels)
    for (maps, alphas), (expected_maps, expected_alphas), seed in zip(frames, copies, range(4), strict=True):
        assert torch.equal(maps, expected_maps)
        assert torch.equal(alphas, expected_alphas)
        assert torch.equal(maps, _frame(seed, channels)[1][0])


@pytest.mark.parametrize("channels", [3, 40])
def test_gradients_of_frames_kept_at_once(channels):
    """What a frame saved for its backward pass is not written over by the frames after it."""

    def differentiate(inputs, outputs):
        return torch.autograd.grad(outputs[0].square().sum() + outputs[1].sum(), inputs)

    expected = [[g.clone() for g in differentiate(*_frame(seed, channels, grad=True))] for seed in range(3)]
    frames = [_frame(seed, channels, grad=True) for seed in range(3)]
    for frame, grads in reversed(list(zip(frames, expected, strict=True))):
        for a, b in zip(differentiate(*frame), grads, strict=True):
            assert torch.equal(a, b)
