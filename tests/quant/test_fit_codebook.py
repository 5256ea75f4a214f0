import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import oracles_quant as oracle
import pytest
import torch
from cases_quant import Lazy
from messages import refused

import kfgs
from kfgs.quant import GrownCodebook, PaperCodebook, fit_codebook, grow, sample_grid


def scene(classes=6, images=5, size=(9, 12), dim=24, noise=0.05, seed=0):
    """Maps of a few classes in patches, with noise, of LSeg-like length 11; image i lacks the classes above i + 2."""
    generator = torch.Generator().manual_seed(seed)
    centres = torch.nn.functional.normalize(torch.randn(classes, dim, generator=generator), dim=1)
    maps, labels = [], []
    for i in range(images):
        label = torch.randint(0, min(classes, i + 3), (size[0] // 3, size[1] // 3), generator=generator)
        label = label.repeat_interleave(3, 0).repeat_interleave(3, 1)
        pixel = centres[label] + noise * torch.randn(*label.shape, dim, generator=generator) / dim**0.5 * 4
        maps.append(11 * pixel)
        labels.append(label)
    return maps, labels, centres


@pytest.mark.parametrize(
    ("options", "noise"),
    [
        # all new features join at once, and are one where they are above beta
        (PaperCodebook(initial=2, epochs=6), 0.01),
        (PaperCodebook(initial=2, epochs=6, joins_per_image=4), 0.05),
        (None, 0.05),
    ],
)
def test_finds_the_classes_of_a_clean_scene_though_the_first_image_lacks_some(options, noise):
    maps, labels, centres = scene(size=(48, 60) if options is None else (9, 12), noise=noise)
    records = []
    fit = fit_codebook(maps, options, progress=records.append)
    assert records == fit.report.history
    assert fit.size == records[-1]["size"] == 6
    name = fit.quantize(centres)  # codeword of each class
    assert sorted(name.tolist()) == list(range(6))
    for feature_map, label in zip(maps, labels, strict=True):
        assert torch.equal(fit.quantize(feature_map), name[label])
    assert fit.report.usage.tolist() == [sum(int((name[lab] == e).sum()) for lab in labels) for e in range(6)]
    assert fit.report.coverage == pytest.approx(0.9 if options is None else 1, abs=0.01)
    similarity = torch.cat([fit.nearest(m).similarity.flatten() for m in maps])
    assert fit.report.mean_similarity == pytest.approx(similarity.double().mean().item())
    if options is None:
        torch.testing.assert_close(fit.codewords.square().mean(dim=1).sqrt(), torch.full((6,), 0.5))
    else:
        assert records[0]["added"] - records[0]["pruned"] == 4


@pytest.mark.parametrize(("joins", "every", "rate", "seed"), [(None, 5, 2.0, 6), (None, 2, 0.3, 4), (1, 2, 0.3, 4)])
def test_a_fit_is_the_paper_written_out(joins, every, rate, seed):
    """Every equation of Sec. 3.3.1 for four epochs, in which codewords join, move, go, and join again."""
    maps = [m.double() for m in scene(classes=5, dim=4, noise=0.2)[0]]
    limits = dict(initial=5, maximum=8, expand_below=0.7, prune_above=0.75, joins_per_image=joins)
    config = PaperCodebook(**limits, epochs=4, eager_epochs=1, step_every=every, learning_rate=rate)
    book = fit_codebook(maps, config, generator=torch.Generator().manual_seed(seed))
    generator = torch.Generator().manual_seed(seed)
    orders = [torch.randperm(5, generator=generator).tolist() for _ in range(4)]
    rows = [feature_map.reshape(-1, 4).numpy() for feature_map in maps]
    expected, history = oracle.evolve(rows, orders, config)
    torch.testing.assert_close(book.codewords, torch.from_numpy(expected), rtol=0, atol=1e-9)
    for record, row in zip(book.report.history, history, strict=True):
        assert {key: record[key] for key in row} == pytest.approx(row)
    assert min(history[0]["added"], sum(record["added"] for record in history[2:])) > 0
    assert sum(record["pruned"] for record in history) > 1
    usage = sum(np.bincount(oracle.quantize(features, expected), minlength=book.size) for features in rows)
    assert book.report.usage.tolist() == usage.tolist()


def test_same_generator_state_same_bits_and_order_is_random():
    maps, *_ = scene(noise=0.3)
    config = PaperCodebook(maximum=20, epochs=2)
    runs = []
    for seed in (1, 1, 2):
        lazy = Lazy(maps)
        fit = fit_codebook(lazy, config, generator=torch.Generator().manual_seed(seed))
        runs.append((fit.codewords, fit.report.history, lazy.reads))
    assert torch.equal(runs[0][0], runs[1][0])
    assert runs[0][1:] == runs[1][1:]
    assert runs[0][2] != runs[2][2]
    first, one, two, final = [0], runs[0][2][1:6], runs[0][2][6:11], runs[0][2][11:]
    assert (first, sorted(one), sorted(two), final) == ([0], list(range(5)), list(range(5)), list(range(5)))
    assert one != two


def test_zero_features_are_left_out():
    maps, *_ = scene(classes=3, noise=0.01)
    clean = fit_codebook(maps, PaperCodebook(initial=3, epochs=1))
    maps_with_zeros = [torch.zeros(9, 12, 24), *(torch.cat([m, torch.zeros(2, 12, 24)]) for m in maps)]
    fit = fit_codebook(maps_with_zeros, PaperCodebook(initial=3, epochs=1))
    assert int(fit.report.usage.sum()) == int(clean.report.usage.sum()) == 5 * 9 * 12
    assert fit.report.coverage == 1.0
    assert fit.size == clean.size
    assert all(math.isfinite(value) for value in fit.report.history[0].values())


def test_paper_has_the_papers_values():
    config = PaperCodebook()
    assert (config.initial, config.maximum, config.expand_below, config.prune_above) == (8, 100, 0.9, 0.99)
    assert (config.epochs, config.learning_rate, config.step_every) == (28, 8e-4, 8)


def test_the_table_of_concepts_has_the_fields_and_their_values():
    page = Path(kfgs.__file__).parents[1] / "docs/concepts.md"
    if not page.is_file():
        pytest.skip("an installed kfgs has no pages")
    rows = re.findall(r"^\| `(\w+)` \|.* \| (.+) \| (.+) \|$", page.read_text(encoding="utf-8"), re.MULTILINE)
    assert len(rows) == 3
    for name, *told in rows:
        for config, value in zip((GrownCodebook(), PaperCodebook()), told, strict=True):
            assert value.partition(":")[0] == str(getattr(config, name, "none"))


def test_bad_maps():
    refused(lambda: fit_codebook([]), "maps:", "got none")
    refused(lambda: fit_codebook(np.ones((1, 64, 50, 100))), "list of maps", "(1, 64, 50, 100)", "from_bchw")
    refused(lambda: fit_codebook([torch.zeros(2, 3, 4)] * 2), "maps:", "zero", "got 2")
    refused(lambda: fit_codebook([torch.ones(2, 3, 4), torch.ones(2, 3, 5)]), "maps[1]:", "[n, 4]", "got (6, 5)")
    refused(lambda: fit_codebook([torch.ones(3, 4)]), "maps[0]:", "[h, w, D]", "got (3, 4)")
    broken = torch.ones(2, 3, 4)
    broken[1, 2, 3] = float("nan")
    refused(lambda: fit_codebook([torch.ones(2, 3, 4), broken]), "maps[1]:", "got NaN")
    refused(lambda: fit_codebook([torch.full((2, 3, 4), 1e37)]), "maps[0]:", "squares", "got 1e+37", "divide")
    refused(lambda: fit_codebook([torch.full((2, 3, 4), 1e-37)] * 2), "maps:", "longer than 1e-08", "got 2 maps")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"initial": 0}, ("initial:", "[1, inf)", "got 0")),
        ({"maximum": 7}, ("maximum:", "[8, inf)", "got 7")),
        ({"expand_below": 1.5}, ("expand_below:", "[-1, 1]", "got 1.5")),
        ({"prune_above": 0.8}, ("prune_above:", "[0.9, 1]", "got 0.8")),
        ({"learning_rate": 0.0}, ("learning_rate:", "(0, inf)", "got 0.0")),
        ({"eager_epochs": -1}, ("eager_epochs:", "[0, inf)", "got -1")),
        ({"joins_per_image": 0}, ("joins_per_image:", "[1, inf)", "got 0")),
    ],
)
def test_bad_config(values, message):
    refused(lambda: PaperCodebook(**values), *message)


def test_lengths_of_features_do_not_matter_to_kfgs_own():
    """Powers of two, so that not even rounding differs: a length for each feature. And the unit of all, times 0.1 and 10."""
    maps, *_ = scene(noise=0.4, size=(24, 33))
    generator = torch.Generator().manual_seed(7)
    book = fit_codebook(maps)
    scaled = [torch.ldexp(m, torch.randint(-6, 7, (24, 33, 1), generator=generator)) for m in maps]
    other = fit_codebook(scaled)
    assert torch.equal(book.codewords, other.codewords)
    assert torch.equal(book.report.usage, other.report.usage)
    assert (book.report.coverage, book.report.history) == (other.report.coverage, other.report.history)
    for unit in (0.1, 10):
        other = fit_codebook([unit * m for m in maps])
        assert other.size == book.size
        torch.testing.assert_close(other.codewords, book.codewords, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("unit", [0.1, 10])
def test_the_papers_rate_has_the_unit_of_the_features(unit):
    maps = [m.double() for m in scene(noise=0.4)[0]]
    config = PaperCodebook(initial=3, maximum=12, epochs=3, learning_rate=0.02)
    book = fit_codebook(maps, config)
    scaled = [unit * m for m in maps]
    same = fit_codebook(scaled, replace(config, learning_rate=unit * 0.02))
    torch.testing.assert_close(
        same.codewords, unit * book.codewords, rtol=1e-3, atol=0
    )  # Adam's epsilon has a unit too
    assert not torch.allclose(fit_codebook(scaled, config).unit, book.unit, atol=1e-2)


def test_many_maps_share_the_pool_and_give_their_grids_alone(monkeypatch):
    """100 features of 5 maps of 12 x 15: 20 each at most, which are those of rows and columns 1::3."""

    class Grids:  # to ask for a whole map is a TypeError
        def __len__(self):
            return len(maps)

        def grid(self, i, samples):
            return sample_grid(maps[i], samples=samples)

    monkeypatch.setattr(grow, "POOL", 100)
    maps, *_ = scene(size=(12, 15))
    fit = fit_codebook(Grids())
    usage = sum(torch.bincount(fit.quantize(m[1::3, 1::3]).flatten(), minlength=fit.size) for m in maps)
    assert int(usage.sum()) == 5 * 20
    assert fit.report.usage.tolist() == usage.tolist()
