"""Readers of folders: a writer that replaces the files between two of them gives the old content or the new one."""

import pytest
import torch
from colmap_models import write_model

from kfgs._files import atomic_folder
from kfgs.fields import SemanticField, store
from kfgs.formats import read_splats, sog, write_splats
from kfgs.gaussians import Gaussians
from kfgs.scenes import colmap_model, read_model


def cloud(count, **more):
    torch.manual_seed(count)
    rows = (torch.rand(count, n) for n in (3, 4, 3))
    return Gaussians(*rows, torch.full((count,), 0.5), **more)


def sog_case(folder, count):
    write_splats(folder, cloud(count, sh=torch.rand(count, 4, 3)), format="sog")


def colmap_case(folder, count):
    write_model(folder, [f"{number}.png" for number in range(count)])


def field_case(folder, count):
    SemanticField(cloud(count, features=torch.rand(count, 4))).save(folder)


CASES = {
    "sog": (sog_case, lambda folder: len(read_splats(folder).gaussians), sog, "parse_meta"),
    "colmap": (colmap_case, lambda folder: len(read_model(folder).images), colmap_model, "_read_cameras"),
    "field": (field_case, lambda folder: len(SemanticField.load(folder).gaussians), store, "digest_file"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_folder_that_is_replaced_while_it_is_read_is_read_again(case, tmp_path, monkeypatch):
    write, read, module, between = CASES[case]
    write(tmp_path / "a", 7)
    assert read(tmp_path / "a") == 7
    before, calls = getattr(module, between), []

    def replaced(*arguments):
        result = before(*arguments)
        calls.append(1)
        if len(calls) == 1:
            write(tmp_path / "b", 5)
            with atomic_folder(tmp_path / "a") as new:
                for file in (tmp_path / "b").iterdir():
                    (new / file.name).write_bytes(file.read_bytes())
        return result

    monkeypatch.setattr(module, between, replaced)
    assert read(tmp_path / "a") == 5
    assert len(calls) >= 2
