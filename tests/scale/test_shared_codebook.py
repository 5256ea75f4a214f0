from itertools import pairwise

import pytest
import torch
from cases_search import scene, table
from messages import tells

from kfgs.scale import SharedCodebook


def around(rows, n, noise, seed=0):
    g = torch.Generator().manual_seed(seed)
    return torch.cat([row + noise * torch.randn(n, len(row), generator=g) for row in rows])


def test_words_are_the_directions_of_groups():
    rows = torch.linalg.qr(torch.randn(12, 12, generator=torch.Generator().manual_seed(0))).Q[:4]
    book = SharedCodebook.fit(around(rows, 50, 0.03) * 7)
    assert len(book) == 4
    assert float((book.words @ rows.T).amax(dim=1).min()) > 0.99
    assert book.nearest(rows).codeword.sort().values.tolist() == [0, 1, 2, 3]


def test_new_scenes_append_and_move_no_old_id():
    rows = torch.linalg.qr(torch.randn(12, 12, generator=torch.Generator().manual_seed(0))).Q
    features = [around(rows[i : i + 3], 50, 0.05, seed=i) for i in range(6)]
    books = [SharedCodebook.fit(features[0])]
    for one in features[1:]:
        books.append(books[-1].extended(one))
    assert len(books[-1]) == 8  # of directions 0 to 7, of which each scene shares two with the one before
    for before, after in pairwise(books):
        assert torch.equal(after.words[: len(before)], before.words)
    before = [book.nearest(one).codeword for book, one in zip(books, features, strict=True)]
    after = [books[-1].nearest(one).codeword for one in features]
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_a_word_within_the_tolerance_is_taken_and_one_outside_is_appended():
    first = torch.tensor([1.0, 0, 0])
    book = SharedCodebook.fit(first.expand(20, 3), tolerance=0.9)
    inside, outside = torch.tensor([0.91, (1 - 0.91**2) ** 0.5, 0]), torch.tensor([0.89, (1 - 0.89**2) ** 0.5, 0])
    assert len(book.extended(inside.expand(20, 3))) == 1
    grown = book.extended(outside.expand(20, 3))
    torch.testing.assert_close(grown.words, torch.stack([first, outside]))


def test_the_same_scene_again_adds_nothing():
    features = torch.randn(3000, 16, generator=torch.Generator().manual_seed(3))  # no groups at all
    book = SharedCodebook.fit(features, tolerance=0.7)
    assert len(book.extended(features)) == len(book)


def test_a_small_thing_gets_a_word_and_a_few_outliers_do_not():
    rows = torch.eye(16)
    book = SharedCodebook.fit(rows[[0] * 500])
    many = rows[[0] * 50_000]
    assert len(book.extended(torch.cat([many, rows[[1] * 19]]))) == 1
    grown = book.extended(torch.cat([many, rows[[1] * 20], rows[[2] * 19]]))
    torch.testing.assert_close(grown.words, rows[:2])


def test_latents_give_the_words_of_their_features():
    field = scene([("wall", 0.0), ("chair", 0.0)])
    latents = field.features[field.known]
    by_latents = SharedCodebook(torch.zeros(0, 24)).extended(latents, field.linear)
    by_features = SharedCodebook.fit(field.linear.decode(latents))
    torch.testing.assert_close(by_latents.words, by_features.words, atol=1e-5, rtol=0)
    other = scene([("lamp", 0.0)], seed=4)  # words outside the span of its latents
    mine = by_latents.nearest(other.features, other.linear)
    theirs = by_latents.nearest(other.linear.decode(other.features))
    torch.testing.assert_close(mine.similarity, theirs.similarity, atol=1e-5, rtol=0)


def test_wrong_input_is_named():
    with pytest.raises(ValueError, match=tells("features:", "longer than", "teacher")):
        SharedCodebook.fit(torch.zeros(5, 3))
    with pytest.raises(ValueError, match=tells("words:", "length 1", "SharedCodebook.fit")):
        SharedCodebook(2 * torch.eye(3))
    with pytest.raises(ValueError, match=tells("tolerance:", "1.5")):
        SharedCodebook(torch.eye(3), 1.5)
    with pytest.raises(ValueError, match=tells("features:", "24", "(2, 3)")):
        SharedCodebook(table().embeddings).nearest(torch.zeros(2, 3))
    with pytest.raises(ValueError, match=tells("words:", "none", "extend")):
        SharedCodebook(torch.zeros(0, 3)).nearest(torch.zeros(2, 3))


def test_classes_with_a_cosine_of_four_fifths_keep_words_of_their_own():
    rows = torch.eye(16)
    classes = torch.stack([rows[0], 0.8 * rows[0] + 0.6 * rows[1]])  # the direction between them is within 0.95 of both
    book = SharedCodebook.fit(around(classes, 200, 0.05))
    assert len(book) == 2
    assert float((book.words @ classes.T).amax(dim=0).min()) > 0.99
