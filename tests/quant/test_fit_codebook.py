import math
import re
from pathlib import Path

import oracles_quant as oracle
import pytest
import torch
from messages import refused

import kfgs
from kfgs.quant import GrownCodebook, PaperCodebook, fit_codebook, grow, sample_grid


class Lazy:
    """Length and item only; the most maps alive at a time would show in `reads` of one pass."""

    def __init__(self, maps):
        self.maps, self.reads = maps, []

    def __len__(self):
        return len(self.maps)

    def __getitem__(self, i):
        self.reads.append(i)
        return self.maps[i].clone()


class OnDisk:
    """Maps that give their grids alone, as those on disk do: to ask for a whole map is an error."""

    def __init__(self, maps):
        self.maps, self.asked = maps, []

    def __len__(self):
        return len(self.maps)

    def __getitem__(self, i):
        raise AssertionError(f"the whole of map {i} was read")

    def grid(self, i, samples):
        self.asked.append((i, samples))
        return sample_grid(self.maps[i], samples=samples)


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


def test_finds_the_classes_of_a_clean_scene_though_the_first_image_lacks_some():
    maps, labels, centres = scene()
    fit = fit_codebook(maps, PaperCodebook(initial=2, epochs=6))
    assert fit.size == 6
    assert fit.report.coverage == 1.0
    assert fit.report.history[0]["added"] == 4
    name = fit.quantize(centres)  # codeword of each class
    assert sorted(name.tolist()) == list(range(6))
    for feature_map, label in zip(maps, labels, strict=True):
        assert torch.equal(fit.quantize(feature_map), name[label])
    assert fit.report.usage.tolist() == [sum(int((name[lab] == e).sum()) for lab in labels) for e in range(6)]


def test_one_step_is_the_paper_written_out():
    """Initialisation, Eq. 8, Eq. 5-6 and Adam's first step (lr times the sign of the gradient) on one image."""
    generator = torch.Generator().manual_seed(3)
    feature_map = torch.randn(4, 5, 6, generator=generator, dtype=torch.float64)
    config = PaperCodebook(initial=3, maximum=7, expand_below=0.4, epochs=1, learning_rate=1e-5)
    fit = fit_codebook([feature_map], config)
    features = feature_map.reshape(-1, 6).numpy()
    start = features[oracle.farthest_points(features, 3)]
    joined = oracle.expand(start, features, 0.4, 7)
    book = torch.from_numpy(features[oracle.farthest_points(features, 3) + joined])
    index = oracle.quantize(features, book.numpy())
    record = fit.report.history[0]
    assert (record["added"], record["size"], record["pruned"]) == (len(joined), len(book), 0)
    assert record["loss"] == pytest.approx(oracle.balanced_loss(features, book.numpy(), index))
    before = [oracle.cosine(f, start[t]) for f, t in zip(features, oracle.quantize(features, start), strict=True)]
    assert record["mean_similarity"] == pytest.approx(sum(before) / 20)
    assert record["coverage"] == sum(s >= 0.4 for s in before) / 20
    moved = (fit.codewords - book).abs()
    # A codeword that stands for itself alone already has the direction of its only feature.
    used = torch.tensor([int((index == e).sum()) > 1 for e in range(len(book))])
    assert used.any()
    torch.testing.assert_close(moved[used], torch.full_like(moved[used], 1e-5), rtol=1e-3, atol=0)
    assert oracle.balanced_loss(features, fit.codewords.numpy(), index) < record["loss"]


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


@pytest.mark.parametrize("step_every", [1, 8])
def test_never_more_than_the_maximum(step_every):
    maps, *_ = scene(classes=12, noise=1.0)
    sizes = []
    config = PaperCodebook(initial=4, maximum=9, epochs=3, eager_epochs=1, step_every=step_every)
    fit = fit_codebook(maps, config, progress=lambda record: sizes.append(record["size"]))
    assert sizes == [record["size"] for record in fit.report.history]
    assert max(sizes) == 9
    assert fit.report.coverage < 1


def test_zero_features_are_left_out():
    maps, *_ = scene(classes=3)
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
    ],
)
def test_bad_config(values, message):
    refused(lambda: PaperCodebook(**values), *message)


def test_no_image_fills_the_codebook_alone():
    generator = torch.Generator().manual_seed(5)
    maps = [torch.randn(8, 8, 32, generator=generator) for _ in range(4)]  # nothing is similar to anything
    seen: list[int] = []
    fit = fit_codebook(
        maps, PaperCodebook(initial=2, maximum=10, epochs=1), progress=lambda one: seen.append(one["added"])
    )
    assert seen == [8]  # two of each image
    index = [int((fit.unit @ m.reshape(-1, 32).T / m.reshape(-1, 32).norm(dim=1)).amax() > 0.99) for m in maps]
    assert index == [1, 1, 1, 1]  # each image has a codeword of its own
    few = fit_codebook(maps, PaperCodebook(initial=2, maximum=10, epochs=1, joins_per_image=1))
    assert few.size == 6


def test_paper_gives_the_codebook_it_always_gave():
    """What commit bfd4440, the last one with the paper's method alone, gives: codewords join, move, go, and join again."""
    maps = [m.double() for m in scene(classes=5, dim=4, noise=0.2)[0]]
    growth = dict(initial=5, maximum=8, expand_below=0.7, prune_above=0.75)
    config = PaperCodebook(**growth, epochs=4, eager_epochs=1, step_every=2, learning_rate=0.3)
    fit = fit_codebook(maps, config, generator=torch.Generator().manual_seed(4))
    first = [-8.453262671306874, 9.215578276283706, 5.381237050087609, 6.187824220994029, 2.4927786856747156]
    first += [-6.041982609324906, 1.947866306263751]
    assert fit.codewords[:, 0].tolist() == pytest.approx(first, abs=1e-6)
    assert fit.codewords[6].tolist() == pytest.approx([first[6], 2.535121701525, -9.04356594498, 8.768950373742])
    assert fit.report.usage.tolist() == [132, 99, 155, 102, 20, 10, 22]
    history = {
        "size": [8, 7, 7, 7],
        "added": [3, 0, 1, 1],
        "pruned": [0, 1, 1, 1],
        "loss": [0.18212571885045623, 0.16953843419224743, 0.18189616936289132, 0.18805830143012564],
        "coverage": [0.8592592592592593, 0.9111111111111111, 0.8907407407407407, 0.8796296296296297],
        "mean_similarity": [0.818100079043659, 0.8521514426964252, 0.8374492404312495, 0.8343049465558467],
    }
    for key, values in history.items():
        assert [row[key] for row in fit.report.history] == pytest.approx(values, abs=1e-6)
    assert (fit.report.coverage, fit.report.mean_similarity) == pytest.approx(
        (0.8648148148148148, 0.8341625325714505), abs=1e-6
    )


def test_default_finds_the_classes_and_says_what_it_reached():
    maps, labels, centres = scene(size=(48, 60))
    records = []
    fit = fit_codebook(maps, progress=records.append)
    assert fit.size == 6
    assert records == fit.report.history
    name = fit.quantize(centres)
    assert sorted(name.tolist()) == list(range(6))
    for feature_map, label in zip(maps, labels, strict=True):
        assert torch.equal(fit.quantize(feature_map), name[label])
    similarity = torch.cat([fit.nearest(m).similarity.flatten() for m in maps])
    assert fit.report.coverage == pytest.approx(0.9, abs=0.01)
    assert fit.report.mean_similarity == pytest.approx(similarity.double().mean().item())
    assert fit.report.usage.tolist() == [sum(int((name[lab] == e).sum()) for lab in labels) for e in range(6)]
    torch.testing.assert_close(fit.codewords.square().mean(dim=1).sqrt(), torch.full((6,), 0.5))


@pytest.mark.parametrize("each", [False, True])
def test_lengths_of_features_do_not_matter(each):
    """Powers of two, so that not even rounding differs; each feature has its own, or all have the same."""
    maps, *_ = scene(noise=0.4, size=(24, 33))
    generator = torch.Generator().manual_seed(7)
    power = [torch.randint(-6, 7, (24, 33, 1), generator=generator) if each else torch.tensor(9) for _ in maps]
    scaled = [torch.ldexp(m, p) for m, p in zip(maps, power, strict=True)]
    one, other = fit_codebook(maps), fit_codebook(scaled)
    assert torch.equal(one.codewords, other.codewords)
    assert torch.equal(one.report.usage, other.report.usage)
    assert (one.report.coverage, one.report.history) == (other.report.coverage, other.report.history)
    rough = fit_codebook([m * 0.37 for m in maps])
    assert rough.size == one.size
    torch.testing.assert_close(rough.codewords, one.codewords, rtol=1e-3, atol=1e-4)


def test_many_maps_share_the_pool(monkeypatch):
    """100 features of 5 maps of 12 x 15: 20 each at most, which are those of rows and columns 1::3."""
    monkeypatch.setattr(grow, "POOL", 100)
    maps, *_ = scene(size=(12, 15))
    disk = OnDisk(maps)
    fit = fit_codebook(disk)
    assert [samples for _, samples in disk.asked] == [20] * 5
    assert int(fit.report.usage.sum()) == 5 * 20
    assert (
        fit.report.usage.tolist()
        == sum(torch.bincount(fit.quantize(m[1::3, 1::3]).flatten(), minlength=fit.size) for m in maps).tolist()
    )
