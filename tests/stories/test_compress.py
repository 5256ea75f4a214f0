"""Compression: the codebook grows until it covers the features (Sec. 3.3.1), and Table 1's bytes."""

import pytest
import torch

import kfgs
from kfgs.metrics import MIB, semantic_storage_bytes


def test_the_codebook_grows(room, codebook_options, recorded):
    book = kfgs.fit_codebook(room.maps, codebook_options, generator=torch.Generator().manual_seed(0))
    sizes = [epoch["size"] for epoch in book.report.history]
    assert sizes[0] < sizes[-1] <= 100
    assert book.size == pytest.approx(recorded["codewords"], abs=2)
    assert book.report.coverage == pytest.approx(recorded["coverage of the codebook"], abs=0.01)
    similarity = book.similarity(book.codewords).fill_diagonal_(-1)
    assert similarity.max() <= codebook_options.prune_above  # Eq. 9


def test_bytes_of_table_1():
    """59.4, 57.6 and 13.0 "MB" (MiB) of Table 1: "just decouple", "decouple+ADC", "decouple+ADC+SC"."""
    decoder = sum(i * o + o for i, o in [(9, 32), (32, 64), (64, 128), (128, 256), (256, 1024), (1024, 512)])
    assert round(semantic_storage_bytes(29_600, 512) / MIB, 1) == 59.4
    assert round(semantic_storage_bytes(28_700, 512) / MIB, 1) == 57.6
    assert round(semantic_storage_bytes(110_500, 9, decoder, 93 * 512) / MIB, 1) == 13.0


def test_bytes_of_the_fields(fused, paper, tmp_path, recorded):
    """What the paper counts, and the file of a packed field: never more than was recorded."""
    decoder = sum(i * o + o for i, o in [(8, 32), (32, 48), (48, 64)])
    learnt = semantic_storage_bytes(len(paper), 8, decoder, paper.decoder.codebook.codewords.numel())
    assert paper.storage() == learnt
    for name, field in (("fused", fused), ("paper's", paper)):
        field.save(tmp_path / "field.kfgs", precision="small")
        size = (tmp_path / "field.kfgs").stat().st_size
        assert size / len(field) <= 1.02 * recorded[f"bytes of a Gaussian of the {name} field, packed"]
        again = kfgs.SemanticField.load(tmp_path / "field.kfgs")
        assert len(again) == len(field)
