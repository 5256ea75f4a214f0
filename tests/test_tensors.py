import subprocess
import sys

import torch
from safetensors import safe_open
from safetensors.torch import load_file

from kfgs._tensors import save_tensors

TEXTS = {
    "kfgs": 'a "kind"',
    "version": "1",
    "Größe": "\n\x01\x7f/\\ünï😀",
    "empty": "",
    **{f"{i}": "x" * i for i in range(9)},
}


def test_texts_and_tensors_come_back_in_the_order_given(tmp_path):
    path = tmp_path / "a.safetensors"
    tensors = {"b": torch.arange(6).view(2, 3).T, "a": torch.tensor([1.5], requires_grad=True), "none": torch.zeros(0)}
    save_tensors(path, tensors, TEXTS)
    with safe_open(path, framework="pt") as file:
        assert file.metadata() == TEXTS
    assert all(torch.equal(value, tensors[name].detach()) for name, value in load_file(path).items())
    head = path.read_bytes()
    places = [head.index(f'"{name}":'.encode()) for name in TEXTS]
    assert places == sorted(places)


def test_two_processes_write_the_same_bytes(tmp_path):
    code = (
        f"import sys, torch, pathlib; from kfgs._tensors import save_tensors; "
        f"save_tensors(pathlib.Path(sys.argv[1]), {{'a': torch.ones(3), 'b': torch.ones(3)}}, {TEXTS!r})"
    )
    for name in "123":
        subprocess.run([sys.executable, "-c", code, tmp_path / name], check=True)
    assert len({(tmp_path / name).read_bytes() for name in "123"}) == 1
