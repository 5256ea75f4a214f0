"""Links that lead to themselves, devices and pipes in the place of files, and a limit on the size of files."""

import os
import re
import resource
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import tells

import kfgs
from kfgs._files import atomic_path, check_output, parse_json, read_json, real_path, write_json
from kfgs.cli import main
from kfgs.formats import read_splats, write_splats
from kfgs.formats.ply import write_ply
from kfgs.gaussians import Gaussians
from kfgs.labels import LabelSet


def splat(path):
    cloud = Gaussians(torch.rand(3, 3), torch.ones(3, 4), torch.ones(3, 3), torch.rand(3), sh=torch.rand(3, 1, 3))
    write_splats(path, cloud)
    return path


def test_a_link_that_leads_to_itself_is_no_traceback(tmp_path, capsys):
    loop = tmp_path / "loop.ply"
    loop.symlink_to("loop.ply")
    assert real_path(loop).parent == real_path(tmp_path)
    write_ply(tmp_path / "a.ply", {"x": np.zeros(3, np.float32)})
    for words in (["info", loop], ["convert", loop, tmp_path / "b.ply"], ["convert", tmp_path / "a.ply", loop]):
        assert main([str(word) for word in words]) == 1
        assert capsys.readouterr().err.startswith("error: ")


def test_no_file_of_kfgs_resolves_paths_in_another_way():
    root = Path(kfgs.__file__).parent
    found = [file for file in root.rglob("*.py") if ".resolve(" in file.read_text(encoding="utf-8")]
    assert [file.relative_to(root).as_posix() for file in found] == []


@pytest.mark.parametrize("name", ["out.json", "out.ply"])
def test_a_link_in_the_place_of_a_file_is_replaced_and_what_it_leads_to_stays(name, tmp_path):
    (tmp_path / "far").mkdir()
    (tmp_path / "far" / name).write_text("mine")
    out = tmp_path / name
    out.symlink_to(f"far/{name}")
    if name == "out.json":
        write_json(out, [1])
        assert read_json(out) == [1]
    else:
        assert main(["convert", str(splat(tmp_path / "a.ply")), str(out)]) == 0
        assert len(read_splats(out)) == 3
    assert not out.is_symlink()
    assert (tmp_path / "far" / name).read_text() == "mine"


def test_a_pipe_or_a_device_is_never_replaced(tmp_path, capsys):
    pipe = tmp_path / "pipe.json"
    os.mkfifo(pipe)
    for path, kind in ((pipe, "a file"), (pipe, "a folder"), ("/dev/null", "a file")):
        with pytest.raises(ValueError, match=tells("out:", path, kind, "a pipe", "another name")):
            check_output("out", path, kind)
    with pytest.raises(ValueError, match=tells("pipe.json", "a pipe")), atomic_path(pipe) as new:
        new.write_text("1")
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert os.listdir(tmp_path) == ["pipe.json"]
    os.mkfifo(tmp_path / "b.ply")
    assert main(["convert", str(splat(tmp_path / "a.ply")), str(tmp_path / "b.ply")]) == 1
    assert re.search(tells("error: TARGET:", tmp_path / "b.ply", "a pipe"), capsys.readouterr().err)
    assert stat.S_ISFIFO((tmp_path / "b.ply").stat().st_mode)


@pytest.mark.parametrize("write", ["new.write_bytes(bytes(9_000_000))", "np.zeros(9_000_000).tofile(new)"])
def test_a_limit_on_the_size_of_files_is_told_as_such(write, tmp_path):
    code = "import sys, numpy as np\nfrom kfgs._files import atomic_path\n"
    code += f"with atomic_path('big.bin') as new:\n    {write}\n"

    def limited():
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))

    env = os.environ | {"PYTHONPATH": str(Path(kfgs.__file__).parents[1]), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, preexec_fn=limited, env=env, capture_output=True, text=True
    )
    assert "big.bin: expected to write it whole, but files may have at most 1,000,000 bytes here" in done.stderr
    assert "ulimit -f" in done.stderr
    assert os.listdir(tmp_path) == []


def test_half_of_a_pair_of_surrogates_is_named_with_its_file(tmp_path):
    file = tmp_path / "classes.json"
    file.write_text('["wall", "chair\\ud83d"]')
    with pytest.raises(ValueError, match=tells("classes.json", "surrogates")):
        read_json(file)
    assert parse_json('"\\ud83d\\ude00"') == "\N{GRINNING FACE}"
    with pytest.raises(ValueError, match=tells("names", "surrogates", r"'chair\ud83d'")):
        LabelSet(("wall", "chair\ud83d"), np.eye(2, dtype=np.float32))
