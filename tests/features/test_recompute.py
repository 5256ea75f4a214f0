import dataclasses

import pytest
import torch
from messages import tells
from PIL import Image

from kfgs.cameras import Camera
from kfgs.features import FeatureFolder, RecomputedMaps, extract_features, pictures_of
from kfgs.quant import PaperCodebook, fit_codebook, quantize_maps, sample_grid
from kfgs.scenes import Scene

CONFIG = PaperCodebook(initial=3, maximum=12, epochs=3, learning_rate=0.02, samples=40, expand_below=0.95)
VIEWS = 4


class Mixer:
    """A seeded matrix on each cell's mean colour, with a bend so that features differ in direction; counts its calls."""

    name = "mixer"

    def __init__(self, weights: int = 1, dies_at: int | None = None) -> None:
        self.identity = {"name": self.name, "weights": weights}
        self.matrix = torch.randn(6, 3, generator=torch.Generator().manual_seed(weights))
        self.calls, self.dies_at = 0, dies_at

    def encode_image(self, image):
        self.calls += 1
        if self.calls == self.dies_at:
            raise KeyboardInterrupt
        return torch.tanh(3 * torch.einsum("dc,chw->dhw", self.matrix, torch.nn.functional.avg_pool2d(image - 0.5, 2)))

    def encode_text(self, prompts):
        raise NotImplementedError


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "images").mkdir()
    paths = [tmp_path / "images" / f"view_{i}.png" for i in range(VIEWS)]
    for i, path in enumerate(paths):
        values = torch.randint(0, 256, (16, 20, 3), generator=torch.Generator().manual_seed(i), dtype=torch.uint8)
        Image.fromarray(values.numpy()).save(path)
    K = torch.tensor([[20.0, 0.0, 10.0], [0.0, 20.0, 8.0], [0.0, 0.0, 1.0]])
    cameras = [Camera(torch.eye(4), K, 20, 16, name=path.name) for path in paths]
    return Scene(cameras, paths, torch.rand(4, 3), torch.zeros(4, 3, dtype=torch.uint8), {"train": list(range(VIEWS))})


def test_codebook_and_index_maps_are_those_of_stored_maps_bit_for_bit(scene, tmp_path):
    extract_features(Mixer(), pictures_of(scene), tmp_path / "maps")
    stored = FeatureFolder(tmp_path / "maps", [scene.stem(i) for i in range(VIEWS)])
    teacher = Mixer()
    anew = RecomputedMaps(teacher, scene, range(VIEWS), tmp_path / "store")
    assert (len(anew), anew.stems) == (VIEWS, stored.stems)
    assert all(torch.equal(a, b) for a, b in zip(anew, stored, strict=True))
    teacher.calls = 0
    one, other = (fit_codebook(maps, CONFIG, generator=torch.Generator().manual_seed(3)) for maps in (stored, anew))
    assert torch.equal(one.codewords, other.codewords)
    assert one.size > CONFIG.initial
    assert one.report.history == other.report.history
    assert teacher.calls == VIEWS  # three epochs and the first and last look: once per picture
    a, b = (quantize_maps(maps, one) for maps in (stored, anew))
    assert all((x == y).all() for x, y in zip(a, b, strict=True))
    assert teacher.calls == 2 * VIEWS
    assert len(set(a[0].ravel().tolist())) > 3


@pytest.mark.parametrize(("step", "samples"), [(None, 40), (None, 10_000), ((2, 3), 40)])
def test_a_grid_is_that_of_the_map(step, samples, scene, tmp_path):
    teacher = Mixer()
    maps = RecomputedMaps(teacher, scene, [2, 0], tmp_path / "store")
    expected = sample_grid(maps[1], step, samples=samples)
    assert torch.equal(maps.grid(1, step, samples), expected)
    assert torch.equal(maps.grid(1, step, samples), expected)
    assert teacher.calls == 2


def test_what_a_killed_process_sampled_is_used(scene, tmp_path):
    dying = Mixer(dies_at=3)
    with pytest.raises(KeyboardInterrupt):
        fit_codebook(RecomputedMaps(dying, scene, range(VIEWS), tmp_path / "store"), CONFIG)
    teacher = Mixer()
    resumed = fit_codebook(RecomputedMaps(teacher, scene, range(VIEWS), tmp_path / "store"), CONFIG)
    assert teacher.calls == VIEWS - 2
    whole = fit_codebook(RecomputedMaps(Mixer(), scene, range(VIEWS), tmp_path / "other"), CONFIG)
    assert torch.equal(resumed.codewords, whole.codewords)


def test_samples_of_another_teacher_picture_or_grid_are_not_taken_for_these(scene, tmp_path):
    first = RecomputedMaps(Mixer(), scene, [0, 1], tmp_path / "store")
    grids = [first.grid(i, None, 40) for i in range(2)]
    other = RecomputedMaps(Mixer(weights=2), scene, [0, 1], tmp_path / "store")
    assert not torch.equal(other.grid(0, None, 40), grids[0])
    assert first.grid(0, None, 10).shape[0] <= 10 < grids[0].shape[0]
    Image.fromarray(torch.full((16, 20, 3), 9, dtype=torch.uint8).numpy()).save(scene.image_paths[1])
    teacher = Mixer()
    again = RecomputedMaps(teacher, scene, [0, 1], tmp_path / "store")
    assert torch.equal(again.grid(0, None, 40), grids[0])
    assert teacher.calls == 0
    assert torch.equal(again.grid(1, None, 40), sample_grid(again[1], samples=40))
    assert not torch.equal(again.grid(1, None, 40), grids[1])
    file = next((tmp_path / "store").glob("*/view_0-*.npy"))
    file.write_bytes(file.read_bytes()[:-1])  # a damaged one is made again
    maps = RecomputedMaps(Mixer(weights=2), scene, [0, 1], tmp_path / "store")
    assert torch.equal(maps.grid(0, None, 40), sample_grid(maps[0], samples=40))


def test_digests_follow_the_teacher_and_the_pictures_alone(scene, tmp_path):
    def digests(teacher, views=(0, 1), store="store"):
        return RecomputedMaps(teacher, scene, views, tmp_path / store).digests()

    first = digests(Mixer())
    assert [name for name, _ in first] == ["view_0", "view_1"]
    assert first[0][1] != first[1][1]
    assert digests(Mixer(), store="elsewhere") == first
    assert digests(Mixer(), views=(1, 0)) == first[::-1]
    assert {d for _, d in digests(Mixer(weights=2))}.isdisjoint({d for _, d in first})
    scene.image_paths[0].write_bytes(scene.image_paths[1].read_bytes())
    assert digests(Mixer())[0] != first[0]


def test_maps_that_are_changed_on_their_way_keep_their_samples_exactly(scene, tmp_path):
    teacher = Mixer()
    maps = RecomputedMaps(teacher, scene, [0], tmp_path / "store")

    def thirds(features):
        return features / 3  # not of half precision any more

    for _ in range(2):
        found = maps.grid_after(0, (2, 2), 40, change=thirds, key="thirds")
        assert teacher.calls == 1
        assert found.dtype == torch.float32
    assert torch.equal(found, sample_grid(maps[0] / 3, (2, 2)))
    assert torch.equal(maps.grid(0, (2, 2), 40), sample_grid(maps[0], (2, 2)))


def test_cleared_samples_are_gone_and_the_size_is_still_known(scene, tmp_path):
    maps = RecomputedMaps(Mixer(), scene, range(VIEWS), tmp_path / "store")
    before = fit_codebook(maps, CONFIG).codewords
    maps.clear()
    assert not list((tmp_path / "store").rglob("*.npy"))
    teacher = Mixer()
    again = RecomputedMaps(teacher, scene, range(VIEWS), tmp_path / "store")
    assert again.shape == (8, 10, 6)
    assert teacher.calls == 0
    assert torch.equal(fit_codebook(again, CONFIG).codewords, before)
    assert RecomputedMaps(teacher, scene, [3], tmp_path / "new").shape == (8, 10, 6)


def test_bad_input_is_refused_before_the_teacher_runs(scene, tmp_path):
    teacher = Mixer()
    with pytest.raises(ValueError, match=tells("pictures", "at least one", "none")):
        RecomputedMaps(teacher, scene, [], tmp_path / "store")
    scene.image_paths[1].unlink()
    with pytest.raises(FileNotFoundError, match=tells("view_1.png:", "'view_1'")):
        RecomputedMaps(teacher, scene, [0, 1], tmp_path / "store")
    teacher.matrix = teacher.matrix * torch.nan
    with pytest.raises(ValueError, match=tells("teacher 'mixer':", "finite", "view_0.png", "got 480 NaN")):
        RecomputedMaps(teacher, scene, [0], tmp_path / "store").grid(0, None, 40)
    with pytest.raises(ValueError, match=tells("teacher 'mixer':", "finite", "view_0.png")):
        _ = RecomputedMaps(teacher, scene, [0], tmp_path / "store")[0]


def test_the_teacher_sees_pictures_as_they_lie_on_disk(scene):
    lensless = dataclasses.replace(scene, lenses=list(scene.cameras))
    assert [p.path for p in pictures_of(lensless, [1])] == [scene.image_paths[1]]
    assert [p.stem for p in pictures_of(scene)] == [f"view_{i}" for i in range(VIEWS)]
    assert pictures_of(scene)[1].read().shape == (16, 20, 3)


def test_a_function_is_a_teacher_and_other_things_are_none(scene, tmp_path):
    def thumbnail(image):
        return image[:, ::2, ::2]

    maps = RecomputedMaps(thumbnail, scene, [0, 1], tmp_path / "store")
    pictures = pictures_of(scene)
    assert torch.equal(maps[1], pictures[1].read()[::2, ::2].half().float())
    assert maps.identity["name"] == "thumbnail"
    with pytest.raises(TypeError, match=tells("teacher:", "encode_image", "encode_text", "got str")):
        RecomputedMaps("lseg", scene, [0], tmp_path / "store")
