"""Memory that is kept for the next frame is never given out while somebody uses it, and never more than is allowed."""

import gc
import threading
import tracemalloc

import numpy as np
import pytest
import torch
from cases_splat import random_splats

pytest.importorskip("numba")

from kfgs.splat import accumulate_pixels, bin_tiles, composite, free_memory
from kfgs.splat.engines import rank_channels
from kfgs.splat.engines.cpu import memory as numba_memory

CHANNELS = 5


@pytest.fixture(autouse=True)
def _nothing_kept(monkeypatch):
    """Each test begins with nothing kept, and even the memory of small frames is."""
    free_memory()
    monkeypatch.setattr(numba_memory, "SMALLEST_KEPT", 1024)


def _frame(seed=0, channels=CHANNELS, grad=False):
    projected, features = random_splats(60, 45, 37, seed=seed, dtype=torch.float32, channels=channels)
    tiles = bin_tiles(projected, 45, 37)
    inputs = [v.requires_grad_(grad) for v in (projected.means2d, projected.conics, projected.opacities, features)]
    return inputs, composite(*inputs, tiles, engine="numba")


def _map(seed=0):
    return _frame(seed)[1][0]


def test_memory_is_handed_out_again_once_it_is_free_and_begins_on_a_cache_line():
    place = _map().data_ptr()
    kept = [_map(seed) for seed in range(3)]
    assert place in [map.data_ptr() for map in kept]
    assert len({map.data_ptr() for map in kept}) == 3
    assert not any(map.data_ptr() % numba_memory.CACHE_LINE for map in kept)
    free_memory()
    assert torch.equal(kept[0], _map(0))  # what is in use stays


HOLDERS = {
    "a view": lambda t: t.view(45, -1)[3:5],
    "detached": lambda t: t.detach(),
    "its storage": lambda t: t.untyped_storage(),
    "through the array interface": lambda t: np.asarray(t),
    "through DLPack": lambda t: np.from_dlpack(t),
    "in an autograd graph": lambda t: torch.ones_like(t).requires_grad_() * t,
}


@pytest.mark.parametrize("held", HOLDERS)
def test_memory_in_use_is_not_handed_out(held):
    map = _map()
    place = map.data_ptr()
    holder = HOLDERS[held](map)
    del map
    gc.collect(1)  # what the test made is young
    others = [_map(seed) for seed in range(1, 5)]
    assert place not in [other.data_ptr() for other in others]
    del holder
    gc.collect(1)
    assert place in [_map(seed).data_ptr() for seed in range(2)]


def test_no_more_is_kept_than_allowed_and_nothing_after_it_is_freed(monkeypatch):
    most = 100_000  # bytes; a map has 33,300
    monkeypatch.setattr(numba_memory, "MOST_KEPT", most)
    expected = [_map(seed).clone() for seed in range(5)]
    free_memory()
    tracemalloc.start()
    try:
        maps = [_map(seed) for seed in range(5)]
        assert tracemalloc.get_traced_memory()[0] > 5 * 33_300
        assert all(torch.equal(map, truth) for map, truth in zip(maps, expected, strict=True))
        del maps
        assert 2 * 33_300 < tracemalloc.get_traced_memory()[0] < most + 20_000
        free_memory()
        assert tracemalloc.get_traced_memory()[0] < 20_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("channels", [3, 40])
def test_kernels_keep_nothing_alive(channels):
    """Numba's generators did: every frame lost the lists of its tiles, and a long fit all memory."""
    projected, features = random_splats(4_000, 45, 37, seed=0, dtype=torch.float32, channels=channels)
    inputs = [value.requires_grad_() for value in (projected.means2d, projected.conics, projected.opacities, features)]

    def use():
        tiles = bin_tiles(projected, 45, 37)
        outputs = composite(*inputs, tiles, engine="numba")
        torch.autograd.backward([output.sum() for output in outputs])
        accumulate_pixels(*inputs[:3], outputs[0].detach(), tiles)
        rank_channels(*inputs, tiles)
        return 4 * len(tiles.rows)  # bytes

    tracemalloc.start()
    try:
        size = use()
        before = tracemalloc.get_traced_memory()[0]
        for _ in range(10):
            use()
        assert tracemalloc.get_traced_memory()[0] < before + 5 * size  # of 40 lists
    finally:
        tracemalloc.stop()


def test_each_thread_has_its_own():
    place, others = _map().data_ptr(), []
    thread = threading.Thread(target=lambda: others.append(_map()))
    thread.start()
    thread.join()
    assert others[0].data_ptr() != place
    assert _map().data_ptr() == place


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
