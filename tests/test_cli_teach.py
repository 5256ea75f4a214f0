"""The whole path of the command line, from photographs and weights to words: LSeg's own code with a tiny network."""

import shutil

import numpy as np
import pytest
import torch
from cases_teach import TinyLSeg, save_checkpoint
from PIL import Image

from kfgs.cli import main
from kfgs.fields import SemanticField
from kfgs.labels import load_label_set
from kfgs.scenes import load_scene

TEACHER = ["--teacher", "cases_teach:TinyLSeg", "--weights"]
QUICK = ["--steps", "3", "--method", "adc"]


@pytest.fixture(scope="module")
def pictures(room):
    """The training pictures by their stems."""
    loaded = load_scene(room)
    return {loaded.stem(i): loaded.image_paths[i] for i in loaded.views("train")}


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    return save_checkpoint(tmp_path_factory.mktemp("weights") / "tiny.ckpt")


@pytest.fixture(scope="module")
def maps(room, weights, tmp_path_factory):
    """The scene's maps, made in one go."""
    folder = tmp_path_factory.mktemp("maps") / "features"
    assert main(["features", str(room), *TEACHER, str(weights), "--out", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def run(room, maps, tmp_path_factory):
    """A field fitted to stored maps."""
    out = tmp_path_factory.mktemp("run")
    assert main(["fit", str(room), "--features", str(maps), "--out", str(out), *QUICK]) == 0
    return out


def test_maps_are_lsegs_of_the_photographs(pictures, weights, maps):
    teacher = TinyLSeg(weights)
    assert sorted(path.stem for path in maps.glob("*.npy")) == sorted(pictures)
    for stem, path in pictures.items():
        photo = np.asarray(Image.open(path).convert("RGB"), dtype=np.float32) / 255
        expected = teacher.encode_image(torch.from_numpy(photo).permute(2, 0, 1)).permute(1, 2, 0)
        found = np.load(maps / f"{stem}.npy")
        assert found.dtype == np.float16
        assert max(found.shape[:2]) == 64
        np.testing.assert_allclose(found, expected.half().numpy(), rtol=2e-3, atol=2e-3)


def test_check_reports_maps_that_do_not_fit(room, pictures, maps, tmp_path, capsys):
    assert main(["features", str(room), "--out", str(maps)]) == 0
    assert f"next: kfgs fit {room} --out run --features {maps}" in capsys.readouterr().out
    out = tmp_path / "maps"
    shutil.copytree(maps, out)
    gone, broken, turned, *good = pictures
    (out / f"{gone}.npy").unlink()
    np.save(out / f"{broken}.npy", np.full_like(np.load(out / f"{broken}.npy"), np.nan))
    np.save(out / f"{turned}.npy", np.load(out / f"{turned}.npy").transpose(1, 0, 2))
    capsys.readouterr()
    assert main(["features", str(room), "--out", str(out)]) == 1
    said, error = capsys.readouterr()
    assert error.startswith(f"error: --out: expected a map that fits for each of the {len(pictures)} views of split")
    assert error.count("\n") == 1
    for name in (gone, broken, turned):
        assert name in said
        assert name not in error  # said once
    assert not any(name in said for name in good)


def test_maps_and_words_of_a_scene_are_made_in_one_go(room, pictures, weights, maps, tmp_path, capsys):
    copy = tmp_path / "scene"
    shutil.copytree(room, copy, ignore=shutil.ignore_patterns("features", "text.npy", "classes.json"))
    assert main(["features", str(copy), "--words", "door,wall", *TEACHER, str(weights)]) == 0
    assert f"wrote:\n  {copy / 'text.safetensors'}\n  {copy / 'features'}" in capsys.readouterr().out
    assert load_label_set(copy / "text.safetensors").names == ("door", "wall")
    name = f"{next(iter(pictures))}.npy"
    assert (copy / "features" / name).read_bytes() == (maps / name).read_bytes()


def test_words_of_the_same_weights_query_the_field(run, weights, tmp_path, capsys):
    table = tmp_path / "text.safetensors"
    assert main(["features", "--words", "wooden door,stone wall,ground", *TEACHER, str(weights), f"--out={table}"]) == 0
    assert "3 classes, 16 channels each, by lseg, as '{}'" in capsys.readouterr().out
    field = SemanticField.load(run / "field.kfgs")
    assert main(["select", "wooden door", str(run / "field.kfgs"), "--text", str(table)]) == 0
    first = capsys.readouterr().out
    assert f" of {len(field)} Gaussians" in first
    assert "2 negatives" in first
    assert "text of another" not in first
    teacher = ["--text", str(table), *TEACHER, str(weights)]
    assert main(["select", "wooden door", str(run / "field.kfgs"), *teacher]) == 0
    assert capsys.readouterr().out == first  # embedded anew, it is the same
    assert main(["select", "the old door behind the arch", str(run / "field.kfgs"), *TEACHER, str(weights)]) == 0
    assert f" of {len(field)} Gaussians" in capsys.readouterr().out
    other = save_checkpoint(tmp_path / "other.ckpt", seed=1)
    assert main(["select", "a door", str(run / "field.kfgs"), *TEACHER, str(other)]) == 0
    assert "got text of another" in capsys.readouterr().out
