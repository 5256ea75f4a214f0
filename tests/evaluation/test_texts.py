import pytest
import torch

from kfgs.evaluation.texts import as_encoder, encode_unit
from kfgs.labels import LabelSet


def test_texts_become_unit_rows():
    rows = encode_unit(lambda texts: torch.tensor([[3.0, 4.0]] * len(texts)), ["a", "b"])
    assert rows.tolist() == torch.tensor([[0.6, 0.8]] * 2).tolist()
    with pytest.raises(ValueError, match="expected one row for each of 2 texts"):
        encode_unit(lambda texts: torch.ones(3, 2), ["a", "b"])
    with pytest.raises(ValueError, match="texts: expected at least one"):
        encode_unit(lambda texts: torch.ones(0, 2), [])


def test_a_label_set_is_an_encoder_of_its_classes_and_negatives():
    table = LabelSet(("wall", "floor"), torch.eye(3)[:2], negatives=torch.eye(3)[2:], negative_names=("stuff",))
    assert as_encoder(table)(["floor", "stuff"]).tolist() == [[0, 1, 0], [0, 0, 1]]
    with pytest.raises(ValueError, match="all 3 texts that the protocol asks, got none of chair, table .2 missing"):
        as_encoder(table)(["wall", "chair", "table"])
    with pytest.raises(ValueError, match="expected text embeddings, got none"):
        as_encoder(None)
