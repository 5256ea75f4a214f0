"""Write the golden files: small files of every format and version, and the numbers that are read from them.

    PYTHONPATH=.:tests python tests/golden/make.py

Run it only when a format gains a version, and add that version beside the older ones: files that a released kfgs wrote must
stay as they are. `numbers.npz` has the values of every file as the reader of that day gave them.
"""

import gzip
import hashlib
import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cases_ksplat import ksplat_file, ksplat_section
from oracles_sog import pack, unpack, version_1
from oracles_spz import legacy_payload

from kfgs import Camera, Gaussians
from kfgs.features import FeatureFolder
from kfgs.features.layouts import write_npy_map
from kfgs.features.manifest import Manifest, MapRecord
from kfgs.fields import Seen, SemanticField
from kfgs.fields.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from kfgs.formats import SplatFile, read_splats, write_splats
from kfgs.formats.spz import write_spz
from kfgs.labels import EditList, LabelSet, Move, Recolor, Remove, load_label_set
from kfgs.quant import Autoencoder, Codebook, IndexMaps, LinearLatents

DATA = Path(__file__).parent / "data"
N, D = 6, 8  # Gaussians, channels of the teacher
CLASSES = ("wall", "rote Stühle", "plant")
SPZ_ROW = {"position": (384, -64, 25600), "alpha": 51, "color": (0, 128, 255), "scale": (160, 128, 96)}
IDENTITY = {"params": "of the fit", "cameras": "of the fit"}


def some(*shape: int, low: float = -1.0, high: float = 1.0) -> torch.Tensor:
    """Numbers without a pattern, the same on every machine."""
    count = int(np.prod(shape))
    values = (np.arange(1, count + 1, dtype=np.int64) ** 3 * 37 + 11 * sum(shape)) % 1009 / 1009
    return torch.from_numpy((low + (high - low) * values).reshape(shape).astype(np.float32))


def cloud() -> SplatFile:
    """The splat that is in every file, in degree 1."""
    gaussians = Gaussians(
        means=some(N, 3, low=-2, high=2),
        quats=torch.nn.functional.normalize(some(N, 4) + torch.tensor([2.0, 0, 0, 0])),
        scales=some(N, 3, low=0.02, high=0.3),
        opacities=some(N, low=0.05, high=0.95),
        sh=some(N, 4, 3, low=-0.6, high=0.6),
        labels=torch.arange(N) % 4 - 1,
    )
    return SplatFile(gaussians, {"score": some(N, low=0, high=1).numpy()}, CLASSES)


def words() -> LabelSet:
    return LabelSet(CLASSES, some(3, D), some(1, D), ("object",), {"teacher": {"name": "toy"}, "templates": ["{}"]})


def field(method: str) -> SemanticField:
    """A field with every part that its method can have: "fused" or "adc+sc"."""
    d = 3 if method == "fused" else 2
    basis = LinearLatents(torch.linalg.qr(some(D, 3).double()).Q.float())
    parts = {"linear": basis}
    if method == "adc+sc":
        layers = (
            tuple((some(o, i), some(o)) for i, o in ((D, 4), (4, d))),
            tuple((some(o, i), some(o)) for i, o in ((d, D),)),
        )
        parts |= {"codebook": Codebook(some(5, D)), "autoencoder": Autoencoder(*layers, low=-0.5, high=0.75)}
        parts |= {"answers": some(N, 3)}
    K = torch.tensor([[40.0, 0, 20], [0, 41, 8], [0, 0, 1]])
    return SemanticField(
        cloud().gaussians.replace(sh=None, features=some(N, d)),
        **parts,
        info={"method": method, "views": ["erste", "second"]},
        seen=Seen(some(N, low=0, high=5000), some(N, low=0, high=1)),
        cameras=(Camera(torch.eye(4), K, 40, 16, "erste"), Camera(torch.eye(4), K, 39, 16, "second", near=0.01)),
        words=words(),
    )


def make_splats(folder: Path) -> None:
    splats = cloud()
    for ending in ("ply", "compressed.ply", "splat", "sog", "glb", "gltf"):
        write_splats(folder / f"cloud.{ending}", splats)
    for version in (2, 3, 4):
        write_spz(folder / f"v{version}.spz", splats, version=version)
    row = SPZ_ROW | {"position": (1.5, -0.25, 100.0), "rotation": (191, 64, 200), "sh": list(range(0, 72, 8))}
    (folder / "v1.spz").write_bytes(gzip.compress(legacy_payload([row] * 2, version=1, degree=1), mtime=0))
    pack(folder / "v1.sog", version_1(unpack(folder / "cloud.sog"), 1))
    for level in (0, 1, 2):
        (folder / f"level{level}.ksplat").write_bytes(
            ksplat_file(level, [ksplat_section(level, [0, 1, 2], 1, 3, [])], 3)
        )


def make_fields(folder: Path) -> None:
    fused, paper = field("fused"), field("adc+sc")
    fused.save(folder / "v3")
    paper.save(folder / "v3_paper")
    SemanticField(paper.gaussians, paper.codebook, paper.autoencoder, {"a": 1}).save(folder / "v2")
    # version 1, by hand: as kfgs wrote it before there were linear latents, answers and cameras
    (folder / "v1").mkdir()
    shutil.copy(folder / "v2" / "field.safetensors", folder / "v1")
    digest = hashlib.sha256((folder / "v1" / "field.safetensors").read_bytes()).hexdigest()
    about = {"format": "kfgs.semantic_field", "version": 1, "sha256": digest, "gaussians": N, "info": {"a": 1}}
    (folder / "v1" / "field.json").write_text(json.dumps(about))
    for precision in ("lossless", "fine", "small", "tiny"):
        fused.save(folder / f"{precision}.kfgs.safetensors", precision=precision)
    paper.save(folder / "paper.kfgs.safetensors", precision="fine")


def make_others(folder: Path) -> None:
    words().save(folder / "words.safetensors")
    (folder / "classes.json").write_text(json.dumps(CLASSES))
    np.save(folder / "text.npy", words().embeddings.numpy())
    EditList((Recolor("plant", "#c04040"), Move("wall", (1, 0, 0.5), ("z", 30)))).then(Remove("wall")).undo().save(
        folder / "edits.json"
    )
    paper = field("adc+sc")
    paper.codebook.save(folder / "codebook.safetensors")
    paper.autoencoder.save(folder / "autoencoder.safetensors")
    IndexMaps([np.arange(6).reshape(2, 3), np.array([[5, 0]])], 5).save(folder / "index_maps.safetensors")
    write_checkpoint(folder / "checkpoint.safetensors", Checkpoint({"a": some(2, 3)}, {"step": 7}), IDENTITY)
    (folder / "maps").mkdir()
    file = write_npy_map(folder / "maps" / "a.npy", some(2, 3, D))
    os.utime(file, ns=(10**18, 10**18))
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    record = MapRecord("a.npy", (2, 3, D), file.stat().st_size, 10**18, digest, "a.png", "0" * 64, 0.5)
    Manifest({"name": "toy"}, {"a": record}).save(folder / "maps")


def splat_numbers(path: Path) -> dict[str, np.ndarray]:
    splats = read_splats(path)
    found = splats.gaussians.to_numpy() | {name: np.asarray(values) for name, values in splats.extra.items()}
    return found | {"classes": np.array(", ".join(splats.classes))}


def field_numbers(path: Path) -> dict[str, np.ndarray]:
    found = SemanticField.load(path)
    classes = found.classify(words().embeddings)
    numbers = found.gaussians.to_numpy() | {"own": classes.labels.numpy(), "own_scores": classes.scores.numpy()}
    numbers["decoded"] = found.decode(found.features).numpy()
    if found.seen is not None:
        numbers |= {name: value.numpy() for name, value in found.seen._asdict().items()}
    if found.cameras:
        numbers["cameras"] = torch.stack([camera.K for camera in found.cameras]).numpy()
        numbers["names"] = np.array([camera.name for camera in found.cameras])
        numbers["words"] = found.label_set().embeddings.numpy()
    return numbers | {"method": np.array(found.method), "info": np.array(json.dumps(found.info, sort_keys=True))}


def other_numbers(folder: Path) -> dict[str, np.ndarray]:
    """By "file/what"."""
    table, pair = (
        load_label_set(folder / "words.safetensors"),
        load_label_set(folder / "classes.json", folder / "text.npy"),
    )
    edits, maps = EditList.load(folder / "edits.json"), IndexMaps.load(folder / "index_maps.safetensors")
    autoencoder = Autoencoder.load(folder / "autoencoder.safetensors")
    kept = read_checkpoint(folder / "checkpoint.safetensors", IDENTITY)
    return {
        "words/embeddings": table.embeddings.numpy(),
        "words/negatives": table.negatives.numpy(),
        "words/names": np.array((*table.names, *table.negative_names, table.info["teacher"]["name"])),
        "classes/embeddings": pair.embeddings.numpy(),
        "edits/all": np.array([repr(edit) for edit in (*edits.edits, *edits.undone)]),
        "edits/counts": np.array([len(edits.edits), len(edits.undone)]),
        "codebook/codewords": Codebook.load(folder / "codebook.safetensors").codewords.numpy(),
        "autoencoder/latents": autoencoder.encode(some(4, D)).numpy(),
        "index_maps/first": maps[0],
        "index_maps/second": maps[1],
        "checkpoint/a": kept.tensors["a"].numpy(),
        "checkpoint/step": np.array(kept.state["step"]),
        "maps/a": FeatureFolder(folder / "maps")[0].numpy(),
    }


def numbers(folder: Path) -> dict[str, np.ndarray]:
    """What is read from every golden file, by "file/what"."""
    found = {f"others/{name}": values for name, values in other_numbers(folder / "others").items()}
    for kind, read in (("splats", splat_numbers), ("fields", field_numbers)):
        for path in readable(folder / kind):
            found |= {f"{kind}/{path.name}/{name}": values for name, values in read(path).items()}
    return found


def save_numbers(path: Path, found: dict[str, np.ndarray]) -> None:
    """All numbers in one array, their shapes and all texts in JSON: hundreds of small arrays would take more room."""
    about = {name: values.tolist() if values.dtype.kind == "U" else values.shape for name, values in found.items()}
    flat = [values.ravel() for values in found.values() if values.dtype.kind != "U"]
    np.savez_compressed(path, values=np.concatenate(flat).astype(np.float32), about=np.array(json.dumps(about)))


def load_numbers(path: Path) -> dict[str, Any]:
    """By "file/what": arrays, and lists of texts or one text."""
    with np.load(path) as file:
        values, about = file["values"], json.loads(str(file["about"]))
    for name, what in about.items():
        if isinstance(what, list) and all(isinstance(size, int) for size in what):
            size = int(np.prod(what))
            about[name], values = values[:size].reshape(what), values[size:]
    return about


def readable(folder: Path) -> list[Path]:
    """The splats or fields of a folder, without the files beside them."""
    return sorted(path for path in folder.iterdir() if not path.name.endswith((".classes.json", ".labels.npz", ".bin")))


def make(folder: Path) -> None:
    """Write all files."""
    for kind, write in (("splats", make_splats), ("fields", make_fields), ("others", make_others)):
        (folder / kind).mkdir(parents=True)
        write(folder / kind)
    save_numbers(folder / "numbers.npz", numbers(folder))


if __name__ == "__main__":
    if DATA.exists():
        sys.exit(
            f"{DATA}: there are golden files already; move them away, make new ones, and bring the older versions back"
        )
    make(DATA)
