import oracles_quant as oracle
import pytest
import torch
from messages import refused

from kfgs.quant import Codebook
from kfgs.quant.codebook import nearest_rows
from kfgs.quant.maps import IndexMaps


def random_rows(n, dim, seed=0, dtype=torch.float64):
    return torch.randn(n, dim, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def test_nearest_against_loops():
    features, codewords = random_rows(40, 6), random_rows(7, 6, seed=1)
    found = Codebook(codewords).nearest(features)
    expected = oracle.quantize(features.numpy(), codewords.numpy())
    assert found.codeword.tolist() == expected.tolist()
    cosines = [oracle.cosine(f, codewords.numpy()[t]) for f, t in zip(features.numpy(), expected, strict=True)]
    torch.testing.assert_close(found.similarity, torch.tensor(cosines, dtype=torch.float64))


def test_quantize_is_idempotent_and_keeps_the_shape():
    book = Codebook(random_rows(6, 5))
    index = book.quantize(random_rows(24, 5, seed=2).reshape(2, 3, 4, 5))
    assert index.shape == (2, 3, 4)
    assert index.dtype == torch.int64
    assert torch.equal(book.quantize(book.codewords[index]), index)


def test_tie_goes_to_lowest_index():
    book = Codebook(torch.tensor([[0.0, 1.0], [1.0, 0.0], [2.0, 0.0]]))
    assert book.quantize(torch.tensor([[1.0, 0.0], [1.0, 1.0]])).tolist() == [1, 0]


def test_half_features_are_compared_in_the_codewords_precision():
    book = Codebook(random_rows(6, 64, dtype=torch.float32))
    features = random_rows(20, 64, seed=1, dtype=torch.float16)
    assert book.nearest(features).similarity.dtype == torch.float32
    assert torch.equal(book.quantize(features), book.quantize(features.float()))


def test_save_then_load_is_the_same(tmp_path):
    book = Codebook(random_rows(4, 3, dtype=torch.float32))
    book.save(tmp_path / "book.safetensors")
    assert torch.equal(Codebook.load(tmp_path / "book.safetensors").codewords, book.codewords)
    assert torch.equal(Codebook.from_state_dict(book.state_dict()).codewords, book.codewords)
    assert book.to(torch.float64).codewords.dtype == torch.float64


def test_bad_codewords():
    refused(lambda: Codebook(torch.ones(3)), "codewords:", "[K, D]", "got (3,)")
    refused(lambda: Codebook(torch.ones(0, 3)), "codewords:", "got none")
    refused(lambda: Codebook(torch.ones(2, 3, dtype=torch.int64)), "codewords:", "torch.int64", error=TypeError)
    rows = torch.tensor([[1.0, 0.0], [0.0, 0.0], [float("nan"), 1.0]])
    refused(lambda: Codebook(rows), "codewords:", "[1, 2]")


def test_bad_files(tmp_path):
    path = tmp_path / "thing.safetensors"
    refused(lambda: Codebook.load(path), "thing.safetensors:", "no such file", "codebook", error=FileNotFoundError)
    path.write_bytes(b"nonsense")
    refused(lambda: Codebook.load(path), "thing.safetensors:", "codebook", "read")
    IndexMaps([], 3).save(path)
    refused(lambda: Codebook.load(path), "thing.safetensors:", "codebook", "got index maps")


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_all_zero_features_of_half_precision_have_similarity_zero(dtype):
    found = Codebook(torch.eye(2, dtype=dtype)).nearest(torch.tensor([[0.0, 0.0], [0.0, 2.0]], dtype=dtype))
    assert found.similarity.tolist() == [0, 1]
    assert found.codeword.tolist() == [0, 1]


@pytest.mark.parametrize("size", [1, 15, 16, 17, 255])
def test_every_feature_gets_the_first_largest_product_whatever_the_size(size):
    """One product of all at once is the oracle; whole numbers have no rounding, so near ties and ties are exact."""
    generator = torch.Generator().manual_seed(size)
    codewords = torch.randint(-3, 4, (size, 8), generator=generator).double()
    codewords[:, 0] = 9  # not all-zero; all products of the first feature are negative
    features = torch.randint(-3, 4, (3_000, 8), generator=generator).half()  # many chunks
    features[0] = torch.tensor([-5.0, 0, 0, 0, 0, 0, 0, 0])
    unit = torch.cat([codewords, codewords])  # each codeword twice
    codeword, product = nearest_rows(features.double(), unit)
    length = Codebook(unit).compare(features)[2]
    products = (features.double()[:, None] * unit).sum(dim=2)
    assert torch.equal(product, products.amax(dim=1))
    assert torch.equal(codeword, (products == product[:, None]).int().argmax(dim=1))
    assert codeword.max() < size
    torch.testing.assert_close(length, features.double().square().sum(dim=1).sqrt())
    assert product[0] < 0
