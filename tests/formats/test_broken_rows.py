"""Gaussians that cannot be drawn are left out by every reader, and counted; the others stay with their labels and columns."""

import gzip
import json
import zipfile

import numpy as np
import pytest
import torch
from cases_gltf import json_of_glb, ply_columns, random_cloud
from cases_ksplat import ksplat_file, ksplat_section
from messages import refused
from oracles_spz import legacy_payload

from kfgs import Gaussians
from kfgs.cli import main
from kfgs.formats import read_splats, write_splats
from kfgs.formats.ply import read_ply, read_ply_elements, write_ply, write_ply_elements
from kfgs.formats.sidecar import LABELS, beside
from kfgs.formats.table import read_rows

N, BAD = 600, (7, 8, 400)
KEPT = [row for row in range(N) if row not in BAD]


def _cloud(degree: int = 1) -> Gaussians:
    scores, names = np.arange(N, dtype=np.float32), ("rug", "sofa")
    return random_cloud(N, degree, 4, labels=torch.arange(N) % 3 - 1, scores=scores, names=names)


def _ply(path, column, value):
    write_splats(_cloud(), path)
    columns = read_ply(path)
    columns[column][list(BAD)] = value
    write_ply(path, columns)
    return path


def _same(splats, expected, notes):
    assert (splats.labels == expected.labels[KEPT]).all()
    assert splats.scores.tolist() == KEPT
    torch.testing.assert_close(splats.means, expected.means[KEPT])
    assert "3 of 600 Gaussians have NaN or infinity in " in notes[0]
    assert notes[0].endswith(" (rows 7, 8, 400): left out")


@pytest.mark.parametrize(
    ("column", "value", "what"),
    [("x", np.nan, "means"), ("scale_1", np.inf, "scales"), ("rot_2", -np.inf, "quats"), ("f_rest_7", np.nan, "sh"),
     ("opacity", np.nan, "opacities")],
)  # fmt: skip
def test_in_a_ply(tmp_path, notes, column, value, what):
    path = _ply(tmp_path / "a.ply", column, value)
    splats = read_splats(path)
    _same(splats, _cloud(), notes)
    assert f"in {what} " in notes[0]
    refused(lambda: read_splats(path, strict=True), "a.ply:", "3 of 600", "without --strict")


def test_infinite_logits_and_scales_of_zero_are_values(tmp_path, notes):
    """sigmoid(inf) = 1, and exp(-inf) = 0: some exports write them."""
    cloud = read_splats(_ply(tmp_path / "a.ply", "opacity", np.inf))
    assert cloud.opacities[list(BAD)].tolist() == [1, 1, 1]
    read_splats(_ply(tmp_path / "b.ply", "scale_0", -np.inf))
    assert notes == []


def _splat(path):
    write_splats(_cloud(0), path)
    rows = np.fromfile(path, "<f4").reshape(N, 8)
    rows[BAD[0], 0], rows[BAD[1], 4], rows[BAD[2], 3] = np.nan, np.inf, -1  # a position, a scale, a negative scale
    rows.tofile(path)
    labels = dict(np.load(beside(path, LABELS)))
    from kfgs._files import digest_file

    np.savez(beside(path, LABELS), **labels | {"of": np.array(digest_file(path))})


def _gltf(path):
    write_splats(_cloud(), path)
    root, data = json_of_glb(path), bytearray(path.read_bytes())
    attributes = root["meshes"][0]["primitives"][0]["attributes"]
    start = data.index(b"BIN\0") + 4
    bent = ("POSITION", 3), ("KHR_gaussian_splatting:OPACITY", 1), ("_CLASS_ID", 1)
    for row, (name, width) in zip(BAD, bent, strict=True):
        at = start + root["bufferViews"][attributes[name]]["byteOffset"] + 4 * width * row
        data[at : at + 4] = np.float32(np.nan).tobytes()
    at = start + root["bufferViews"][attributes["KHR_gaussian_splatting:ROTATION"]]["byteOffset"] + 16 * BAD[2]
    data[at : at + 4] = np.float32(np.inf).tobytes()
    path.write_bytes(data)


@pytest.mark.parametrize(("make", "name"), [(_splat, "a.splat"), (_gltf, "a.glb")])
def test_in_other_formats_labels_and_scores_keep_step(tmp_path, notes, make, name):
    make(tmp_path / name)
    _same(read_splats(tmp_path / name), _cloud(), notes)


def test_in_a_compressed_ply_a_chunk_is_left_out(tmp_path):
    write_splats(_cloud(), tmp_path / "a.compressed.ply")
    elements = read_ply_elements(tmp_path / "a.compressed.ply")
    elements["chunk"]["max_y"][1] = np.inf
    write_ply_elements(tmp_path / "bad.ply", elements)
    splats, kept = read_rows(tmp_path / "bad.ply")
    assert len(splats) == N - 256
    assert (~kept).nonzero()[:, 0].tolist() == list(range(256, 512))


def test_in_a_sog_a_code_that_is_missing(tmp_path):
    write_splats(_cloud(), tmp_path / "a.sog")
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files["meta.json"])
    meta["scales"]["codebook"] = meta["scales"]["codebook"][:250]  # the largest scales
    with zipfile.ZipFile(tmp_path / "b.sog", "w") as archive:
        for name, data in (files | {"meta.json": json.dumps(meta).encode()}).items():
            archive.writestr(name, data)
    whole, (part, small) = read_splats(tmp_path / "a.sog"), read_rows(tmp_path / "b.sog")
    assert 0 < len(part) == int(small.sum()) < N
    torch.testing.assert_close(part.means, whole.means[small])
    assert whole.scales[~small].amax(1).min() > whole.scales[small].median()


def test_in_spz_ksplat_and_a_checkpoint(tmp_path):
    row = {"position": (1.0, 2, 3), "alpha": 51, "color": (0, 128, 255), "scale": (160, 128, 96), "rotation": (0, 0, 0)}
    rows = [row, row | {"position": (float("inf"), 0, 0)}, row]
    (tmp_path / "a.spz").write_bytes(gzip.compress(legacy_payload(rows, version=1)))
    whole = ksplat_file(1, [ksplat_section(1, [0, 1, 2], 0, 3, [])], 3)
    (tmp_path / "a.ksplat").write_bytes(whole[:-18] + b"\0\x7c" + whole[-16:])  # the last rotation's first half
    values = {"means": torch.zeros(3, 3), "scales": torch.zeros(3, 3), "quats": torch.ones(3, 4)}
    values["opacities"], values["means"][1, 2] = torch.zeros(3), torch.nan
    torch.save({"splats": values | {"sh0": torch.zeros(3, 1, 3)}}, tmp_path / "a.pt")
    for name, left_out in (("a.spz", [1]), ("a.ksplat", [2]), ("a.pt", [1])):
        splats, kept = read_rows(tmp_path / name)
        assert (~kept).nonzero()[:, 0].tolist() == left_out, name
        assert len(splats) == 2


@pytest.mark.parametrize("name", ["a.ply", "a.splat", "a.pt"])
def test_rows_of_zeros_are_left_out(tmp_path, notes, name):
    columns = list(ply_columns(1))
    values = {column: np.zeros(1000, np.float32) for column in columns}
    for i, column in enumerate(columns):
        values[column][0] = i / 8 + 0.125
    if name == "a.ply":
        write_ply(tmp_path / name, values)
    elif name == "a.splat":
        (tmp_path / name).write_bytes(np.float32([1, 2, 3, 1, 1, 1]).tobytes() + b"\x90" * 8 + bytes(32 * 999))
    else:
        tensor = torch.from_numpy(np.stack([values[column] for column in columns], 1))
        splats = {"means": tensor[:, :3], "sh0": tensor[:, None, 3:6], "opacities": tensor[:, 6]}
        splats |= {"scales": tensor[:, 7:10], "quats": tensor[:, 10:]}
        torch.save({"splats": {key: value.contiguous() for key, value in splats.items()}}, tmp_path / name)
    splats = read_splats(tmp_path / name)
    assert len(splats) == 1
    assert notes == [f"{name}: 999 of 1,000 Gaussians are rows of zeros (rows 1, 2, 3, 4, 5, ...): left out"]


def test_one_rotation_of_length_0_is_no_rotation_and_noted(tmp_path, notes):
    path = _ply(tmp_path / "a.ply", "rot_0", 0)
    columns = read_ply(path)
    for axis in range(1, 4):
        columns[f"rot_{axis}"][list(BAD)] = 0
    write_ply(path, columns)
    splats = read_splats(path)
    assert notes == ["a.ply: 3 of 600 Gaussians have a rotation of length 0 (rows 7, 8, 400): read as not turned"]
    assert splats.quats[list(BAD)].tolist() == [[1, 0, 0, 0]] * 3


def test_nothing_usable_is_an_error(tmp_path):
    path = _ply(tmp_path / "a.ply", "x", 0)
    columns = read_ply(path)
    columns["y"][:] = np.nan
    write_ply(path, columns)
    refused(lambda: read_splats(path), "a.ply:", "600 of 600", "another file")


def test_a_label_that_is_no_number_is_no_label(tmp_path, notes):
    splats = read_splats(_ply(tmp_path / "a.ply", "class_id", np.nan))
    assert notes == ["a.ply: 3 of 600 Gaussians have no number as class_id (rows 7, 8, 400): read as no class"]
    assert splats.labels[list(BAD)].tolist() == [-1] * 3


def test_every_command_tells_it_once_and_strict_refuses(tmp_path, capsys):
    path = _ply(tmp_path / "a.ply", "x", np.nan)
    note = "note: a.ply: 3 of 600 Gaussians have NaN or infinity in means (rows 7, 8, 400): left out\n"
    for words in (["convert"], ["convert", tmp_path / "b.spz"], ["convert", tmp_path / "c", "--by-class"]):
        command = [words[0], str(path), *map(str, words[1:])]
        assert main(command) == 0
        assert capsys.readouterr().out.count(note) == 1
        assert main([*command, "--strict"]) == 1
        said = capsys.readouterr().err
        assert "3 of 600" in said
        assert "without --strict they are left out" in said
    assert len(read_splats(tmp_path / "b.spz")) == N - 3
