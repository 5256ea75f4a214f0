import numpy as np
import pytest
import torch
from cases_quant import Lazy
from messages import refused, tells

from kfgs.quant import Codebook, LatentMaps, quantize_maps, sample_grid
from kfgs.quant.maps import IndexMaps, grid_slices


def test_quantize_maps_reads_each_map_once_and_sizes_may_differ():
    generator = torch.Generator().manual_seed(0)
    maps = Lazy([torch.randn(h, w, 4, generator=generator) for h, w in ((3, 5), (2, 7))])
    book = Codebook(torch.randn(6, 4, generator=generator))
    index_maps = quantize_maps(maps, book)
    assert maps.reads == [0, 1]
    for found, feature_map in zip(index_maps, maps.maps, strict=True):
        assert found.dtype == np.uint8
        assert np.array_equal(found, book.quantize(feature_map).numpy())
    assert sum(indices.nbytes for indices in index_maps) == 3 * 5 + 2 * 7


@pytest.mark.parametrize(("size", "kind"), [(255, np.uint8), (256, np.uint16), (65_535, np.uint16)])
def test_as_few_bytes_as_the_codebook_allows(size, kind):
    index_maps = IndexMaps([np.array([[0, size - 1]])], size)
    assert index_maps[0].dtype == kind
    assert index_maps[0].tolist() == [[0, size - 1]]


@pytest.mark.parametrize("size", [5, 300])
def test_save_then_load_is_the_same(tmp_path, size):
    index_maps = IndexMaps([np.full((2, 3), size - 1), np.zeros((4, 1), dtype=np.int64)], size)
    index_maps.save(tmp_path / "maps.safetensors")
    again = IndexMaps.load(tmp_path / "maps.safetensors")
    assert again.size == size
    assert [m.dtype for m in again] == [m.dtype for m in index_maps]
    assert all(np.array_equal(a, b) for a, b in zip(again, index_maps, strict=True))


def test_latent_maps_look_up_rows():
    latents = torch.arange(6, dtype=torch.float32).reshape(3, 2)
    maps = LatentMaps(IndexMaps([np.array([[2, 0], [1, 1]])], 3), latents)
    assert maps[0].tolist() == [[[4.0, 5.0], [0.0, 1.0]], [[2.0, 3.0], [2.0, 3.0]]]
    assert len(maps) == len(list(maps)) == 1
    assert maps[-1].dtype == torch.float32
    with pytest.raises(IndexError):
        maps[1]


def test_bad_input():
    refused(lambda: sample_grid(torch.zeros(3, 2)), "feature_map:", "[h, w, D]", "got (3, 2)")
    refused(lambda: sample_grid(torch.zeros(3, 3, 1), samples=0), "samples:", "[1, inf)", "got 0")
    refused(lambda: IndexMaps([np.array([[0, 4]])], 3), "maps[0]:", "got 0 to 4")
    refused(lambda: IndexMaps([np.array([[0]]), np.array([[0, -1]])], 3), "maps[1]:", "got -1 to 0")
    refused(lambda: IndexMaps([np.zeros(4, dtype=np.int64)], 3), "maps[0]:", "[h, w]", "got (4,)")
    refused(lambda: IndexMaps([], 70_000), "size:", "[1, 65535]", "got 70000")
    refused(lambda: LatentMaps(IndexMaps([], 3), torch.zeros(4, 2)), "latents:", "[3, d]", "got (4, 2)")
    refused(lambda: quantize_maps([torch.ones(2, 2, 4)], Codebook(torch.eye(3))), "maps[0]:", "got (2, 2, 4)")
    with pytest.raises(FileNotFoundError, match=tells("missing.safetensors:", "index maps")):
        IndexMaps.load("missing.safetensors")


def test_holes_are_kept_apart_from_codewords_all_the_way():
    codebook = Codebook(torch.eye(3))
    features = torch.tensor([[[0.0, 0.0, 0.0], [1.0, 0.1, 0.0]], [[0.0, 0.2, 1.0], [0.0, 0.0, 0.0]]])
    index_maps = quantize_maps([features], codebook)
    assert index_maps[0].tolist() == [[3, 0], [2, 3]]
    latents = LatentMaps(index_maps, torch.tensor([[0.1], [0.2], [0.3]]))[0]
    torch.testing.assert_close(latents[..., 0], torch.tensor([[torch.nan, 0.1], [0.3, torch.nan]]), equal_nan=True)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_features_too_short_for_a_direction_are_holes(dtype):
    features = torch.tensor([[[1e-9, 0.0], [1e-6, 0.0], [0.0, 60_000.0]]], dtype=torch.float64).to(dtype)
    book = Codebook(torch.eye(2))
    assert quantize_maps([features], book)[0].tolist() == [[2, 0, 1]]


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_maps_that_are_not_finite_are_refused(value):
    maps = [torch.ones(1, 2, 2), torch.tensor([[[1.0, 2.0], [value, 0.0]]])]
    refused(lambda: quantize_maps(maps, Codebook(torch.eye(2))), "maps[1]:", "got NaN")


def test_grid_of_the_paper_is_rows_1_2_columns_1_3():
    feature_map = torch.arange(360 * 480, dtype=torch.float32).reshape(360, 480, 1)
    samples = sample_grid(feature_map)
    assert samples.shape == (28_800, 1)
    assert torch.equal(samples, feature_map[1::2, 1::3].reshape(-1, 1))


@pytest.mark.parametrize(
    ("size", "samples", "step"),
    [
        ((90, 120), 28_800, (1, 1)),
        ((360, 480), 100_000, (1, 2)),
        ((360, 480), 43_200, (2, 2)),
        ((1, 10), 3, (2, 3)),
        ((1, 10), 2, (3, 4)),
    ],
)
def test_step_is_the_finest_within_the_limit(size, samples, step):
    slices = grid_slices(*size, samples)
    assert tuple(part.step for part in slices) == step
    assert [part.start for part in slices] == [min(n // 2, length - 1) for n, length in zip(step, size, strict=True)]
    assert 1 <= len(sample_grid(torch.zeros(*size, 1), samples=samples)) <= samples
