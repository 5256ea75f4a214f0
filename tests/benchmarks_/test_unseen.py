"""Teachers that have not seen a room: what a class is for each, and the two commands in two small rooms."""

import json
import shutil

import numpy as np
import pytest
import torch
import unseen
from cases_color import make_splat
from torch.nn.functional import normalize, one_hot

from kfgs.evaluation.label_pictures import load_label_map
from kfgs.labels import LabelSet
from kfgs.scenes import load_scene, save_feature_map

WORDS = LabelSet(
    ("couch", "chair", *map(str, range(40))), torch.randn(42, 32, generator=torch.Generator().manual_seed(0)) + 3
)


def test_a_class_is_the_largest_of_its_words_and_a_word_belongs_to_the_class_that_names_it_first():
    assert unseen.ade_channels(["window blind"]) == [[64, 9, 19]]  # blind, window pane, curtain
    assert unseen.ade_channels(["window blind", "window", "magazine"]) == [[64, 19], [9], []]
    logits = torch.tensor([[[9.0, 1.0, 5.0, -2.0], [9.0, -3.0, -4.0, -1.0]]])  # channel 0 is the background
    assert unseen.group_scores(logits, [[1, 2], [], [3]]).tolist() == [[[5, -2, -2], [-3, -3, -1]]]


def test_a_class_has_the_row_of_its_word_or_a_made_up_one_that_scatters_alike():
    rows, unit = unseen.text_rows(["sofa", "teapot", "chair"], WORDS), normalize(WORDS.embeddings, dim=1)
    torch.testing.assert_close(rows[[0, 2]], unit[:2])
    torch.testing.assert_close(unseen.text_rows(["teapot"], WORDS)[0], rows[1])
    near = (unit @ unit.T)[~torch.eye(len(unit), dtype=torch.bool)]
    assert near.min() < (unit @ rows[1]).min() < (unit @ rows[1]).max() < near.max() + 0.05


def test_maps_are_scored_and_fused(room, tmp_path, monkeypatch, capsys):
    """In two rooms, of which the second calls a chair a radio. ADE20K's network sees the true labels."""
    pytest.importorskip("transformers", reason='the backbone needs `pip install "kfgs[hf]"`')
    from tiny_transformers import write_teacher

    classes = json.loads((room / "classes.json").read_text())
    scene, channels = load_scene(room), [rows[0] if rows else 0 for rows in unseen.ade_channels(classes)]
    for name in ("there", "here"):
        shutil.copytree(room, tmp_path / name)
        for i in scene.views("all"):
            labels = torch.tensor([*channels, 0])[load_label_map(room / "labels" / f"{scene.stem(i)}.png")]
            save_feature_map(tmp_path / "logits" / name, scene.stem(i), one_hot(labels, 150).float())
        make_splat(room, tmp_path / "colors" / name / "color.ply")
    (tmp_path / "here/classes.json").write_text(json.dumps(classes).replace('"chair"', '"radio"'))
    WORDS.save(tmp_path / "words.safetensors")
    write_teacher(tmp_path / "weights", "dinov2")
    monkeypatch.setattr(unseen, "SIZE", 80)
    files = ("weights", "words.safetensors", "logits", "colors")
    options = [f"--{name.split('.')[0]}={tmp_path / name}" for name in files]
    paths, printed = [str(tmp_path / name) for name in ("out", "there", "here")], []
    for command in (["maps"], ["maps"], ["table", "--teachers=ade"]):
        monkeypatch.setattr("sys.argv", ["unseen.py", command[0], *paths, *options, *command[1:]])
        unseen.main()
        printed.append(capsys.readouterr().out)
    assert (printed[0].count("accuracy"), printed[1]) == (6, "")  # the second time all is there
    score = {file.stem: json.loads(file.read_text()) for file in (tmp_path / "out/scores").iterdir()}
    assert [name for name in classes if name not in score["loo-here"]["known"]] == ["chair"]
    assert score["loo-here"]["alone"]["iou"]["radio"] < 0.2 < score["loo-here"]["alone"]["known"]
    assert score["ade-there"]["alone"]["accuracy"] > 95
    assert np.load(tmp_path / "out/loo/here" / f"{scene.stem(0)}.npy").shape == (8, 10, 32)
    rows = [line.split(" | ") for line in printed[2].splitlines()[2:]]
    assert [row[1] for row in rows] == ["there", "here", "**mean**"]
    before, after, gain = (float(number) for number in rows[0][4].strip(" |").replace(" to ", ", ").split(", "))
    assert (gain, after > 70) == (pytest.approx(after - before, abs=0.11), True)  # each is rounded
