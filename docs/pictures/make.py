"""Draw the pictures of the site's pages with kfgs itself, on the result of `kfgs demo`.

    kfgs demo --out DEMO && python docs/pictures/make.py DEMO

Each `site_*.jpg` here is smaller than 100 kB. Look at every picture before you commit it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from classes import show_classes
from PIL import Image

from kfgs import (
    EditList,
    FeatureFolder,
    Recolor,
    Remove,
    SemanticField,
    connected_parts,
    fit_codebook,
    load_label_set,
    load_scene,
    read_splats,
    transfer_labels,
    viz,
)
from kfgs.cameras import Orbit, orbit_cameras
from kfgs.pipeline import true_labels
from kfgs.viz import FeatureColors
from kfgs.viz.films import show_cloud, show_selection
from kfgs.viz.palette import palette

HERE = Path(__file__).resolve().parent
LARGEST = 100_000  # bytes
WIDE = 1200  # pixels


class Demo:
    """What the pictures are drawn from: scene, field, classes and colour splat of a demo, and the view they show."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "scene"
        self.scene = load_scene(self.folder)
        self.field = SemanticField.load(folder / "run" / "field.kfgs")
        self.words = load_label_set(self.folder / "classes.json", self.folder / "text.npy")
        self.splat = read_splats(folder / "color.ply")
        chair = self.words.index("chair")
        self.truth = true_labels(self.scene, self.folder / "labels", "test")
        stem = max(self.truth, key=lambda name: int((self.truth[name] == chair).sum()))
        self.index = next(i for i in self.scene.views("test") if self.scene.stem(i) == stem)
        self.stem, self.camera = stem, self.scene.cameras[self.index]
        self.large = self.camera.resized(480, 640)
        self.colors = show_cloud(self.splat, color_by="rgb")

    def photo(self) -> np.ndarray:
        """The photograph of the view."""
        return self.scene.image(self.index).numpy()

    def classes(self, labels: torch.Tensor) -> np.ndarray:
        """Labels as a picture in the colours of the classes."""
        return palette(labels.numpy(), self.words.names)


def save(name: str, pictures: list[np.ndarray], titles: list[str], across: int = 3) -> None:
    """Write pictures, `across` of them side by side, as one JPEG that is small enough."""
    rows = [
        viz.picture_grid([pictures[i : i + across]], titles[i : i + across], width=(WIDE - 6 * across) // across)
        for i in range(0, len(pictures), across)
    ]
    write(name, Image.fromarray(np.concatenate(rows)))


def write(name: str, picture: Image.Image) -> None:
    """Write a JPEG in the best quality that stays below the limit."""
    path = HERE / name
    for quality in (88, 80, 70, 60, 50):
        picture.convert("RGB").save(path, quality=quality, optimize=True)
        if path.stat().st_size < LARGEST:
            break
    print(f"{name}: {picture.size[0]} x {picture.size[1]}, {path.stat().st_size / 1000:.0f} kB")


def draw_field(demo: Demo) -> None:
    """A photo, the Gaussians with shrunken shapes, and the classes."""
    labelled = demo.field.label(demo.words)
    dots = labelled.replace(scales=labelled.scales * 0.45, opacities=torch.full_like(labelled.opacities, 0.95))
    gaussians = show_cloud(dots, color_by="label")(demo.large)
    classes = show_classes(labelled, demo.words.names)(demo.large)
    save(
        "site_field.jpg",
        [demo.photo(), gaussians, classes],
        ["photo", f"the {len(dots):,} Gaussians of the field", "class of each pixel"],
    )


def draw_uplift(demo: Demo) -> None:
    """The teacher's classes, the field's, and the truth."""
    features = FeatureFolder(demo.folder / "features", [demo.stem])[0]
    unit = torch.nn.functional.normalize(features.float(), dim=-1)
    teacher = (unit @ demo.words.embeddings.float().T).argmax(-1)
    found = demo.field.segment(demo.camera, demo.words)
    pictures = [demo.classes(labels) for labels in (teacher, found, demo.truth[demo.stem])]
    save("site_uplift.jpg", pictures, ["the teacher, one view", "the field, all views averaged", "truth"])


def draw_codebook(demo: Demo) -> None:
    """A feature map in colours, before and after each pixel takes its nearest codeword."""
    maps = FeatureFolder(demo.folder / "features").of(demo.scene, "train")
    book = fit_codebook(maps, generator=torch.Generator().manual_seed(0))
    features = FeatureFolder(demo.folder / "features", [demo.stem])[0].float()
    words = book.codewords[book.quantize(features)]
    both = torch.cat([features.flatten(0, 1), words.flatten(0, 1)])
    colors = FeatureColors.fit(both)(both)
    before, after = (part.reshape(*features.shape[:2], 3) for part in np.split(np.asarray(colors), 2))
    save(
        "site_codebook.jpg",
        [demo.photo(), before, after],
        ["photo", "512 numbers a pixel", f"one of {book.size} codewords"],
    )


def draw_gamma(demo: Demo) -> None:
    """The chairs at three thresholds, and the histogram of their scores."""
    found = demo.field.query("chair", demo.words)
    shown, titles = [], []
    high = float(found.scores[found.mask].quantile(0.6))
    for gamma in (0.02, found.threshold, high):
        mask = demo.field.query("chair", demo.words, gamma).mask
        shown.append(show_selection(demo.field.gaussians, mask, demo.colors)(demo.large))
        titles.append(f"gamma {gamma:.2f}: {int(mask.sum()):,} Gaussians")
    save("site_gamma.jpg", shown, titles)
    figure = viz.plot_scores(found)
    figure.savefig(HERE / "site_scores.png", dpi=110)
    write("site_scores.jpg", Image.open(HERE / "site_scores.png"))
    (HERE / "site_scores.png").unlink()


def draw_votes(demo: Demo) -> None:
    """Three pixels across an edge of the sofa, and how the Gaussians that each of them shows divide their votes."""
    found = demo.field.rank(demo.camera, demo.words, top=len(demo.words))
    sofa, wall = (demo.words.index(name) for name in ("sofa", "wall"))
    votes = torch.zeros(*found.labels.shape[:2], len(demo.words))
    votes.scatter_add_(2, found.labels.clamp_min(0), found.scores * (found.labels >= 0))
    edge = torch.minimum(votes[..., sofa], votes[..., wall])
    y, x = divmod(int(edge.argmax()), edge.shape[1])
    places = [(y - 12, x), (y, x), (y + 12, x)]
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3), width_ratios=(1, 1.4), layout="constrained")
    left.imshow(demo.photo())
    left.set_axis_off()
    start = np.zeros(len(places))
    for name in range(len(demo.words)):
        shares = np.array([float(votes[place][name] / votes[place].sum()) for place in places])
        if shares.max() > 0.02:
            color = palette(np.array([name]), demo.words.names)[0] / 255
            right.barh(
                ["A", "B", "C"], shares, left=start, color=color, edgecolor="black", label=demo.words.names[name]
            )
        start += shares
    for letter, (row, column) in zip("ABC", places, strict=True):
        left.plot(column, row, "o", color="white", markeredgecolor="black", markersize=6)
        left.annotate(letter, (column, row), (8, -4), textcoords="offset points", color="white", weight="bold")
    right.invert_yaxis()
    right.set(xlim=(0, 1), xlabel="share of the votes")
    right.legend(loc="upper center", bbox_to_anchor=(0.5, 1.2), ncols=5, frameon=False)
    figure.savefig(HERE / "site_votes.png", dpi=110)
    write("site_votes.jpg", Image.open(HERE / "site_votes.png"))
    (HERE / "site_votes.png").unlink()


def draw_lambda(demo: Demo) -> None:
    """Labels of a field that has never seen the plant, carried to the splat within three distances."""
    labelled = demo.field.label(demo.words)
    source = labelled[labelled.labels != demo.words.index("plant")]
    target, shown, titles = demo.splat, [], []
    for distance in (0.02, 0.1, 0.8):
        carried = transfer_labels(source, target, distance).labels
        shown.append(show_cloud(target.replace(labels=carried, names=source.names), color_by="label")(demo.large))
        titles.append(f"lambda {distance:.2f}: {(carried >= 0).float().mean():.0%} labelled")
    save("site_lambda.jpg", shown, titles)


def draw_errors(demo: Demo) -> None:
    """Truth, result, and where they differ."""
    truth, found = demo.truth[demo.stem], demo.field.segment(demo.camera, demo.words)
    photo = demo.photo()
    gray = np.repeat(photo.mean(-1, keepdims=True), 3, -1) * 0.5 + 0.5
    errors = np.where((found != truth).numpy()[..., None], (0.84, 0.15, 0.1), gray)
    save("site_scores_errors.jpg", [demo.classes(truth), demo.classes(found), errors], ["truth", "field", "errors"])


def draw_landing(demo: Demo) -> None:
    """Photo, classes, a query, and an edited scene."""
    edited = EditList().then(Remove("chair", fill=True)).then(Recolor("plant", "#c04040")).apply(demo.splat)
    asked = demo.field.query("chair", demo.words).mask
    pictures = [
        demo.photo(),
        show_classes(demo.field.label(demo.words), demo.words.names)(demo.large),
        show_selection(demo.field.gaussians, asked, demo.colors)(demo.large),
        show_cloud(edited, color_by="rgb")(demo.large),
    ]
    save("site_landing.jpg", pictures, ["photo", "classes", "“chair”", "chairs removed, plant red"], across=2)


def draw_pyvista(demo: Demo) -> None:
    """The transfer of labels, and what a person puts into a plotter: a cloud, a legend, boxes and cameras."""
    transfer = viz.show_transfer(demo.field, demo.splat, height=640, off_screen=True)
    cloud = demo.field.label(demo.words)
    around = torch.tensor(
        [demo.words.index(name) for name in ("wall", "ceiling", "window blind") if demo.words.knows(name)]
    )
    inside = cloud[~torch.isin(cloud.labels, around) & (cloud.labels >= 0)]
    plotter = viz.make_plotter(640, 640, off_screen=True)
    viz.add_cloud(plotter, inside, style="gaussians")
    viz.add_legend(plotter, inside)
    viz.add_boxes(plotter, connected_parts(cloud, "chair"))
    viz.add_cameras(plotter, demo.field, most=8, size=0.4)
    (view,) = orbit_cameras(inside.means, Orbit(frames=1, size=(640, 640), elevation_degrees=45, zoom=1.2))
    viz.look_through(plotter, view)
    pictures = [shown.screenshot(return_img=True) for shown in (transfer, plotter)]
    save(
        "site_pyvista.jpg",
        pictures,
        ["viz.show_transfer(field, splat)", "add_cloud, add_legend, add_boxes, add_cameras"],
        2,
    )


def main() -> int:
    """Draw all pictures."""
    parser = argparse.ArgumentParser(description="Draw the pictures of the site.")
    parser.add_argument("demo", type=Path, help="folder that `kfgs demo --out` wrote")
    demo = Demo(parser.parse_args().demo)
    for draw in (
        draw_votes,
        draw_landing,
        draw_field,
        draw_uplift,
        draw_codebook,
        draw_gamma,
        draw_lambda,
        draw_errors,
        draw_pyvista,
    ):
        draw(demo)
    return 0


if __name__ == "__main__":
    sys.exit(main())
