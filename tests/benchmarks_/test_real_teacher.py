"""The real teacher for experiments, with a tiny backbone of random weights and the smallest room."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import real_teacher
import torch
from messages import refused, tells
from PIL import Image

pytest.importorskip("transformers", reason='the backbone needs `pip install "kfgs[hf]"`')
from tiny_transformers import write_teacher

from kfgs.evaluation.label_pictures import load_label_map
from kfgs.scenes import load_scene
from kfgs.teachers import load_teacher

ROOT = Path(real_teacher.__file__).parents[1]


@pytest.fixture(scope="session")
def backbone(tmp_path_factory):
    return write_teacher(tmp_path_factory.mktemp("dinov2"), "dinov2")


def run(monkeypatch, *arguments):
    monkeypatch.setattr("sys.argv", ["real_teacher.py", *map(str, arguments)])
    real_teacher.main()


def generator():
    return torch.Generator().manual_seed(3)


def three_classes():
    """200 tokens per class in 6 channels, far from 0, with noise that is widest across the plane of the class means."""
    labels = torch.arange(600) % 3
    noise = torch.tensor([0.1, 0.1, 0.1, 0.1, 0.3, 1.0]) * torch.randn(600, 6, generator=generator())
    mix = torch.linalg.qr(torch.randn(6, 6, generator=generator()))[0]
    return (torch.eye(6)[labels] + noise + 5) @ mix, labels


@pytest.mark.parametrize("whiten", [False, True])
def test_head_tells_classes_apart_from_raw_tokens(whiten):
    tokens, labels = three_classes()
    text = torch.randn(3, 16, generator=generator())
    weight, bias = real_teacher.fit_head(tokens, labels, text, whiten=whiten, steps=200, generator=generator())
    cosines = torch.cosine_similarity((tokens @ weight.T + bias)[:, None], text, dim=-1)
    assert (cosines.argmax(1) == labels).float().mean() > 0.99


def test_void_is_not_learnt(backbone, room, tmp_path):
    scene, teacher = load_scene(room), load_teacher("dinov2", backbone, size=80)
    train = [scene.stem(i) for i in scene.views("train")]
    for stem in train[:2]:  # the others have no label picture
        labels = np.array(Image.open(room / "labels" / f"{stem}.png"))
        labels[:, :40] = 255
        Image.fromarray(labels).save(tmp_path / f"{stem}.png")

    def encode(i):
        return teacher.encode_image(scene.image(i).permute(2, 0, 1)).permute(1, 2, 0)

    tokens, found = real_teacher.labelled_tokens(encode, scene, tmp_path)
    assert tokens.shape == (2 * 8 * 5, 32)  # the right half of 8 x 10 patches of 8 x 8 in each of the two
    truth = load_label_map(room / "labels" / f"{train[0]}.png")
    rows = [int((i + 0.5) * 60 / 8) for i in range(8)]
    assert found[:40].tolist() == [int(truth[row, 8 * j + 4]) for row in rows for j in range(5, 10)]
    assert torch.equal(tokens[:40], encode(scene.views("train")[0])[:, 5:].flatten(0, 1))
    refused(lambda: real_teacher.labelled_tokens(encode, scene, tmp_path / "none"), "label", "training", "got none")


def test_commands_make_the_maps_that_the_teacher_makes(backbone, room, tmp_path, monkeypatch, capsys):
    weights = shutil.copytree(backbone, tmp_path / "weights")
    head, out = weights / "head.safetensors", tmp_path / "maps"
    run(monkeypatch, "head", room, weights, head, "--size", 80)
    assert "head.safetensors: 480 tokens" in capsys.readouterr().out
    run(monkeypatch, "maps", room, weights, head, out, "--truth", "labels")
    said = capsys.readouterr().out
    scene = load_scene(room)
    truth = torch.cat([load_label_map(room / "labels" / f"{scene.stem(i)}.png").flatten() for i in scene.views("test")])
    most = float(truth[truth >= 0].bincount().max() / (truth >= 0).sum())
    assert float(re.search(r"accuracy ([\d.]+) \(kfgs-pooled/1", said)[1]) > most + 0.05  # better than one class
    monkeypatch.chdir(ROOT)
    teacher = load_teacher("benchmarks.real_teacher:RealTeacher", weights)
    manifest = json.loads((out / "features.json").read_text())
    assert (len(manifest["pictures"]), manifest["teacher"]) == (9, teacher.identity)
    stored = np.load(out / f"{scene.stem(0)}.npy")
    assert (stored.dtype, stored.shape) == (np.float16, (8, 10, 32))
    picture, (weight, bias, size) = scene.image(0).permute(2, 0, 1), real_teacher.load_head(head)
    expected = load_teacher("dinov2", backbone, size=size).encode_image(picture).permute(1, 2, 0) @ weight.T + bias
    np.testing.assert_allclose(stored, expected, rtol=1e-3, atol=1e-3)  # half precision
    torch.testing.assert_close(teacher.encode_image(picture).permute(1, 2, 0), expected)
    with pytest.raises(NotImplementedError, match=tells("teacher 'dinov2-head':", "pictures", "SCENE/text.npy")):
        teacher.encode_text(["chair"])
