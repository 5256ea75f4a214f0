import pytest
import torch
from messages import refused

from kfgs.evaluation.texts import as_encoder, encode_unit
from kfgs.labels import LabelSet


def test_texts_become_unit_rows():
    rows = encode_unit(lambda texts: torch.tensor([[3.0, 4.0]] * len(texts)), ["a", "b"])
    assert rows.tolist() == torch.tensor([[0.6, 0.8]] * 2).tolist()
    refused(lambda: encode_unit(lambda texts: torch.ones(3, 2), ["a", "b"]), "expected one row for each of 2 texts")
    refused(lambda: encode_unit(lambda texts: torch.ones(0, 2), []), "texts: expected at least one")


def test_a_label_set_is_an_encoder_of_its_classes_and_negatives():
    table = LabelSet(("wall", "floor"), torch.eye(3)[:2], negatives=torch.eye(3)[2:], negative_names=("stuff",))
    assert as_encoder(table)(["floor", "stuff"]).tolist() == [[0, 1, 0], [0, 0, 1]]
    with pytest.raises(ValueError, match="all 3 texts that the protocol asks, got none of chair, table .2 missing"):
        as_encoder(table)(["wall", "chair", "table"])
    refused(lambda: as_encoder(None), "expected text embeddings, got none")
