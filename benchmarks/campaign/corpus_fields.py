"""Semantic fields in a folder and in one file, their classes, codebooks and checkpoints; edits and examples."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch

from kfgs.cameras import Camera
from kfgs.fields import Autoencoded, Codewords, Linear, SemanticField
from kfgs.fields.train import write_checkpoint
from kfgs.formats import write_splats
from kfgs.gaussians import Gaussians
from kfgs.labels import (
    Duplicate,
    EditList,
    InBox,
    Insert,
    LabelSet,
    Move,
    OfClass,
    Opacity,
    Recolor,
    Remove,
)
from kfgs.quant import Autoencoder, Codebook
from kfgs.quant.maps import IndexMaps

from .corpus import SEED, Add
from .corpus_splats import cloud

DIM = 8


def tiny_field(method: str = "fused", n: int = 16) -> SemanticField:
    """A field with every part that its method has."""
    g = torch.Generator().manual_seed(SEED)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=g)

    d = {"fused": 3, "adc+sc": 2}.get(method, DIM)
    gaussians = Gaussians(
        random(n, 3), random(n, 4), torch.exp(random(n, 3) - 3), torch.rand(n, generator=g) * 0.9 + 0.05,
        features=random(n, d),
    )  # fmt: skip
    linear, book, fused = Linear(torch.linalg.qr(random(DIM, 3)).Q), Codebook(random(5, DIM)), None
    decoder: Linear | Codewords | Autoencoded = linear if method == "fused" else Codewords(book)
    if method == "adc+sc":
        layers = {"encoder.0": (random(2, DIM), random(2)), "decoder.0": (random(DIM, 2), random(DIM))}
        state = {"range": torch.tensor([-0.5, 0.75], dtype=torch.float64)}
        for name, (weight, bias) in layers.items():
            state |= {f"{name}.weight": weight, f"{name}.bias": bias}
        decoder = Autoencoded(book, Autoencoder.from_state_dict(state))
    if method != "fused":
        fused = SemanticField(gaussians.replace(features=random(n, 3)), linear)
    words = LabelSet(("wall", "chair"), random(2, DIM), random(1, DIM), ("object",), {"teacher": {"name": "toy"}})
    camera = Camera(torch.eye(4), torch.tensor([[40.0, 0, 20], [0, 41, 8], [0, 0, 1]]), 40, 16, "first")
    return SemanticField(gaussians, decoder, (camera,), words, {"seconds": 1.5}, fused)


def make(folder: Path, add: Add) -> None:
    """Fields, classes, what training keeps, and lists of edits."""
    for method in ("fused", "adc+sc"):
        place = folder / method
        field = tiny_field(method)
        field.save(place / "field.kfgs")
        add("field", place, "field.kfgs")
        for precision in ("fine", "tiny"):
            field.save(place / f"{precision}.kfgs", precision)
            add("field", place, f"{precision}.kfgs")
    _classes(folder / "classes", add)
    _parts(folder / "parts", add)
    _edits(folder / "edits", add)


def _classes(place: Path, add: Add) -> None:
    place.mkdir()
    words = tiny_field().classes
    assert words is not None
    words.save(place / "text.safetensors")
    (place / "classes.json").write_text(json.dumps(["wall", "chair"]))
    np.save(place / "text.npy", words.embeddings.numpy())
    (place / "words.txt").write_text("wall\nchair;armchair\n")
    add("table", place, "text.safetensors")
    add("names and rows", place, "classes.json", "text.npy", opens=".")
    add("words", place, "words.txt", "classes.json")
    shown = {"chair": [{"view": "a.png", "points": [[1, 2]]}, {"view": "b", "box": [0, 0, 3, 4]}, {"gaussians": [3]}]}
    (place / "clicks.json").write_text(json.dumps(shown))
    add("examples", place, "clicks.json")


def _parts(place: Path, add: Add) -> None:
    place.mkdir()
    decoder = tiny_field("adc+sc").decoder
    assert isinstance(decoder, Autoencoded)
    decoder.codebook.save(place / "codebook.safetensors")
    decoder.autoencoder.save(place / "autoencoder.safetensors")
    IndexMaps([np.arange(12, dtype=np.uint8).reshape(3, 4) % 6], 5).save(place / "maps.npz")
    add("codebook", place, "codebook.safetensors")
    add("autoencoder", place, "autoencoder.safetensors")
    add("index maps", place, "maps.npz")
    state = {"identity": "x", "a": torch.ones(3, 2), "step": 4, "history": [1.0, 2.0]}
    write_checkpoint(place / "checkpoint.pt", state)
    add("training", place, "checkpoint.pt")
    run = place / "run/stages/uplift-0123"
    run.mkdir(parents=True)
    (run / "stage.json").write_text(json.dumps({"name": "uplift", "seconds": 1.5, "inputs": {}}))
    add("description", place, "run/stages/uplift-0123/stage.json", opens="run")


def _edits(place: Path, add: Add) -> None:
    place.mkdir()
    write_splats(cloud(5), place / "lamp.ply")
    corner = InBox((0, 0, 0), (0.1, 0.1, 0.1))
    edits = EditList([
        Recolor(["plant", corner], "#c04040"), Opacity("wall", 0.3), Move("chair", (0.5, 0, 0), ("z", 30), 1.5),
        Duplicate(OfClass("chair", 0), (1, 0, 0)), Remove("wall"), Insert(place / "lamp.ply"),
    ])  # fmt: skip
    edits.undo().save(place / "a.edits.json")
    edits.save(place / "b.edits.json")
    add("edits", place, "a.edits.json", "b.edits.json")
