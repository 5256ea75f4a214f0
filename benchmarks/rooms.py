"""A room with exact truth, rendered from a published interior scene.

    pip install mitsuba==3.9.1 pyoidn pillow    # an environment of its own; and LLVM: apt-get install libllvm19
    python benchmarks/rooms.py SCENES/living-room OUT            # also living-room-2, dining-room

SCENE is a folder of Benedikt Bitterli's collection (https://benedikt-bitterli.me/resources/) in Mitsuba's format: scene.xml,
models/, textures/. Which of its meshes are one thing, and its class, is written down in rooms/NAME.json (NAME: the folder's).
The pictures may be shown with the credit that OUT/CREDIT.txt has.

OUT is a scene that `kfgs color`, `kfgs fit` and `kfgs evaluate` open. Metres, z up; <stem> is train_000, test_000, ...
    images/<stem>.png        path traced, denoised
    labels/<stem>.png        index into classes.json, at the centre of the pixel; 255 = void (nothing is hit)
    instances/<stem>.png     index into instances.json; 255 = void
    depth/<stem>.npy         float32 [H, W] z-depth, 0 where nothing is hit
    without/                 the same four of each test view, with the things of --without removed from the room
    transforms.json, points.ply, split.json: cameras, 30,000 points with 1 cm noise, training and test views
A run that was killed continues: a view is made once, its picture last. transforms.json comes at the end.
"""

from __future__ import annotations

import argparse
import json
import os
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rooms_path import Array, Lens, free_places, test_views, training_path

VOID = 255
LAYERS = 8  # masked surfaces (leaves) that a ray may pass
POINTS, POINT_NOISE = 30_000, 0.01  # of the sparse points; metres
TOP = " top"  # "Mesh048 top": what lies flat in the upper tenth of a mesh, as a ceiling that is one mesh with its walls


def write(path: Path, value: Any) -> None:
    """A file whole or not at all: an array as .png or .npy, anything else as .json, text as it is."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".part{path.suffix}")
    if path.suffix == ".png":
        Image.fromarray(value).save(part)
    elif path.suffix == ".npy":
        np.save(part, value)
    else:
        part.write_text(value if isinstance(value, str) else json.dumps(value, indent=1), encoding="utf-8")
    os.replace(part, path)


class Things:
    """What the shapes of a scene are: `classes`, `instances`, and the ids of each part (a mesh, or its top)."""

    def __init__(self, about: dict[str, Any], shapes: list[str]) -> None:
        classes = about["things"]
        self.classes = [name for name in classes if name != "void"]
        self.instances = [(f"{name} {k + 1}", name) for name in self.classes for k in range(len(classes[name]))]
        self.meshes = {f"{name} {k + 1}": meshes for name in classes for k, meshes in enumerate(classes[name])}
        owner = {mesh: thing for thing, meshes in self.meshes.items() for mesh in meshes}
        unknown = sorted({mesh.removesuffix(TOP) for mesh in owner} - set(shapes))
        missing = sorted(set(shapes) - set(owner))
        if unknown or missing:
            raise SystemExit(
                f"the scene's shapes differ from its JSON: {unknown} are not there, {missing} have no class"
            )
        place = {name: i for i, (name, _) in enumerate(self.instances)}
        parts = [owner.get(name + end, owner[name]) for name in shapes for end in ("", TOP)]
        ids = [place.get(thing, VOID) for thing in parts]
        self.instance_ids = np.array([*ids, VOID], np.uint8)  # the last: nothing was hit
        of = [self.classes.index(name) for _, name in self.instances]
        self.class_ids = np.array([VOID if i == VOID else of[i] for i in [*ids, VOID]], np.uint8)

    def named(self, names: list[str]) -> list[str]:
        """The meshes of things, by instance ("chair 2") or class ("chair")."""
        known = {*self.classes, *self.meshes}
        if wrong := [name for name in names if name not in known]:
            raise SystemExit(f"--without: expected things of {', '.join(sorted(known))}; got {', '.join(wrong)}")
        return [m for name, meshes in self.meshes.items() if {name, name.rsplit(" ", 1)[0]} & {*names} for m in meshes]


def mend(folder: Path) -> ET.Element:
    """The scene file of Mitsuba 0.6 as 3.9 reads it, with an id for each shape: its mesh's name, or kind and number."""
    root = ET.parse(folder / "scene.xml").getroot()
    values = {e.get("name"): e.get("value", "") for e in root.findall("default")}
    for number, e in enumerate([e for e in root if e.tag == "shape"]):
        name = e.find("string[@name='filename']")
        e.set("id", f"{e.get('type')}{number}" if name is None else Path(name.get("value", "")).stem)
        if name is not None and not (folder / name.get("value", "")).exists():
            root.remove(e)
    for e in [e for e in root if e.tag in ("default", "integrator", "sensor")]:
        root.remove(e)
    for e in root.iter():
        value = e.get("value", "")
        e.attrib.update({key: values[text[1:]] for key, text in e.attrib.items() if text.startswith("$")})
        if e.get("name") == "filename":
            e.set("value", str((folder / value).resolve()))
        if value == "trilinear":
            e.set("value", "bilinear")
        if e.tag in ("rgb", "srgb") and value.startswith("#"):
            e.tag = "rgb"
            e.set("value", ", ".join(str((int(value[i : i + 2], 16) / 255) ** 2.2) for i in (1, 3, 5)))
        if e.get("type") == "roughdiffuse":
            e.set("type", "diffuse")
        kept = ("reflectance", "diffuseReflectance") if e.tag == "bsdf" and e.get("type") == "diffuse" else None
        for child in list(e):
            name = child.get("name")
            if name in ("extEta", "sunRadiusScale") or (kept and name == "alpha"):
                e.remove(child)
    return root


class Room:
    """A scene in Mitsuba, asked in metres with z up."""

    def __init__(self, folder: Path, about: dict[str, Any], removed: list[str] | None = None) -> None:
        import drjit as dr
        import mitsuba as mi

        root = mend(folder)
        for e in [e for e in root if e.tag == "shape" and e.get("id") in (removed or [])]:
            root.remove(e)
        self.scene = mi.load_string(ET.tostring(root, encoding="unicode"), optimize=False)  # keeps the shapes apart
        self.shapes = [shape.id() for shape in self.scene.shapes()]
        boxes = [(shape.bbox().min.y, shape.bbox().max.y) for shape in self.scene.shapes()]
        self.tops = np.array([high - 0.1 * (high - low) for low, high in boxes])
        self.unit = float(about["metres_per_unit"])
        self.to_scene = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # z up to y up
        registered = np.array(
            dr.reinterpret_array(mi.UInt32, self.scene.shapes_dr())
        )  # in the order of loading threads
        self.place = np.full(int(registered.max()) + 1, -1)
        self.place[registered] = np.arange(len(registered))

    def rays(self, origins: Array, directions: Array) -> Any:
        """Rays of Mitsuba, in its units and axes."""
        import mitsuba as mi

        start, way = origins @ self.to_scene.T / self.unit, directions @ self.to_scene.T
        return mi.Ray3f(mi.Point3f(start.T), mi.Vector3f(way.T))

    def distances(self, origins: Array, directions: Array) -> Array:
        """Metres [R] to the nearest surface, masked or not, as the planner asks; inf where there is none."""
        return np.array(self.scene.ray_intersect_preliminary(self.rays(origins, directions)).t, np.float64) * self.unit

    def trace(self, origins: Array, directions: Array) -> tuple[Array, np.ndarray]:
        """Metres [R] to what a picture shows, and parts [R]: twice the place of the shape, plus 1 on its top; inf, -1."""
        import drjit as dr
        import mitsuba as mi

        distance, part, rest = np.full(len(origins), np.inf), np.full(len(origins), -1), np.arange(len(origins))
        passed = np.zeros(len(origins))
        for _ in range(LAYERS):
            hit = self.scene.ray_intersect(
                self.rays(origins[rest] + directions[rest] * passed[:, None], directions[rest])
            )
            valid, solid = np.array(hit.is_valid()), np.array(hit.bsdf().eval_null_transmission(hit)[0]) < 0.5
            shape = self.place[np.array(dr.reinterpret_array(mi.UInt32, hit.shape))]
            top = (np.abs(np.array(hit.n.y)) > 0.7) & (np.array(hit.p.y) > self.tops[shape])
            metres, done = np.array(hit.t) * self.unit + passed, valid & solid
            distance[rest[done]], part[rest[done]] = metres[done], (2 * shape + top)[done]
            rest, passed = rest[valid & ~solid], metres[valid & ~solid] + 1e-4
            if not len(rest):
                break
        return distance, part

    def picture(self, lens: Lens, pose: Array, spp: int, seed: int, exposure: float) -> np.ndarray:  # [H, W, 3] uint8
        """Path traced with albedo and normals, denoised by them, and encoded with gamma 2.2."""
        import mitsuba as mi
        import pyoidn

        to_world = np.eye(4)
        to_world[:3, :3] = self.to_scene @ pose[:3, :3] @ np.diag([-1.0, -1.0, 1.0])  # Mitsuba: x left, y up
        to_world[:3, 3] = self.to_scene @ pose[:3, 3] / self.unit
        film = {"type": "hdrfilm", "width": lens.width, "height": lens.height, "rfilter": {"type": "box"}}
        fov = float(np.degrees(2 * np.arctan(lens.width / 2 / lens.focal)))
        sensor = {"type": "perspective", "fov": fov, "fov_axis": "x", "near_clip": 0.01, "far_clip": 1e4, "film": film}
        sensor |= {"to_world": mi.ScalarTransform4f(to_world), "sampler": {"type": "independent"}}
        path = {"type": "aov", "aovs": "a:albedo,n:sh_normal", "light": {"type": "path", "max_depth": 8}}
        made = mi.render(self.scene, sensor=mi.load_dict(sensor), integrator=mi.load_dict(path), spp=spp, seed=seed)
        channels = np.nan_to_num(np.array(made, np.float32))
        count = channels.shape[2]
        light, albedo, normal = (np.ascontiguousarray(channels[..., i : i + 3]) for i in (0, count - 6, count - 3))
        light = np.asarray(pyoidn.denoise(light, np.clip(albedo, 0, 1), np.clip(normal, -1, 1), hdr=True)) * exposure
        return np.round(np.clip(light, 0, 1) ** (1 / 2.2) * 255).astype(np.uint8)


def make_plan(
    distances: Callable[[Array, Array], Array], lens: Lens, inside: Array, options: dict[str, Any]
) -> dict[str, Any]:
    """The poses of all views by stem: {"options", "views": {stem: [4, 4]}}."""
    rng = np.random.default_rng(options["seed"])
    free = free_places(distances, inside)
    train = training_path(distances, lens, free, options["train"], rng)
    test = test_views(distances, lens, free, train, options["test"], rng)
    named = {f"train_{i:03d}": pose for i, pose in enumerate(train)} | {
        f"test_{i:03d}": pose for i, pose in enumerate(test)
    }
    return {"options": options, "views": {stem: pose.tolist() for stem, pose in named.items()}}


def render_view(room: Room, things: Things, lens: Lens, pose: Array, out: Path, stem: str, **light: Any) -> None:
    """The four files of a view, its picture last."""
    origins, directions, lengths = lens.rays(pose)
    distance, part = room.trace(origins, directions)
    size = lens.height, lens.width
    depth = np.where(np.isfinite(distance), distance / lengths, 0).astype(np.float32)
    write(out / "depth" / f"{stem}.npy", depth.reshape(size))
    write(out / "labels" / f"{stem}.png", things.class_ids[part].reshape(size))
    write(out / "instances" / f"{stem}.png", things.instance_ids[part].reshape(size))
    write(out / "images" / f"{stem}.png", room.picture(lens, pose, **light))


def write_scene(out: Path, lens: Lens, plan: dict[str, Any], things: Things) -> None:
    """Cameras, split, names and points of a folder whose views are all made."""
    poses = {stem: np.array(pose) for stem, pose in plan["views"].items()}
    train = [stem for stem in poses if stem.startswith("train")]
    rng, points, colors = np.random.default_rng([plan["options"]["seed"], 1]), [], []
    for stem in train:
        depth = np.load(out / "depth" / f"{stem}.npy").ravel()
        rows = rng.choice(len(depth), -(-POINTS // len(train)))
        rows = rows[depth[rows] > 0]
        origins, directions, lengths = lens.rays(poses[stem])
        points.append((origins + directions * (lengths * depth)[:, None])[rows])
        colors.append(np.array(Image.open(out / "images" / f"{stem}.png")).reshape(-1, 3)[rows])
    table = np.concatenate([np.concatenate(points), np.concatenate(colors)], 1)
    table[:, :3] += rng.normal(0, POINT_NOISE, (len(table), 3))
    kinds = [f"property float {axis}" for axis in "xyz"] + [
        f"property uchar {name}" for name in ("red", "green", "blue")
    ]
    lines = ["ply", "format ascii 1.0", f"element vertex {len(table)}", *kinds, "end_header"]
    lines += [f"{x:.4f} {y:.4f} {z:.4f} {r:.0f} {g:.0f} {b:.0f}" for x, y, z, r, g, b in table]
    write(out / "points.ply", "\n".join([*lines, ""]))
    write(out / "classes.json", things.classes)
    write(out / "instances.json", [{"name": name, "class": kind} for name, kind in things.instances])
    write(out / "split.json", {"train": train, "test": [stem for stem in poses if stem not in train]})
    opengl = np.diag([1.0, -1.0, -1.0, 1.0])  # x right, y up, z backward
    frames = [
        {"file_path": f"images/{s}.png", "transform_matrix": (pose @ opengl).tolist()} for s, pose in poses.items()
    ]
    numbers = {"w": lens.width, "h": lens.height, "fl_x": lens.focal, "fl_y": lens.focal}
    numbers |= {"cx": lens.width / 2, "cy": lens.height / 2}
    write(out / "transforms.json", {**numbers, "ply_file_path": "points.ply", "frames": frames})


def agreement(out: Path, lens: Lens, views: dict[str, Any]) -> tuple[float, int]:
    """Whether a place has one class in all views: the share of pixels, and their number.

    A pixel counts if another view shows its place (z-depth within 1 %), and the pixels around it have one class in both.
    """
    right = total = 0
    shown = {}
    for stem in views:
        labels = np.pad(np.array(Image.open(out / "labels" / f"{stem}.png")), 2, constant_values=VOID)
        around = np.lib.stride_tricks.sliding_window_view(labels, (5, 5))
        inner = (around.min((2, 3)) == around.max((2, 3))) & (labels[2:-2, 2:-2] != VOID)
        shown[stem] = labels[2:-2, 2:-2], inner, np.load(out / "depth" / f"{stem}.npy")
    stems = [*views]
    for k, stem in enumerate(stems):
        origins, directions, lengths = lens.rays(np.array(views[stem]))
        points = origins + directions * (lengths * shown[stem][2].ravel())[:, None]
        for name in (stems[k - 1], stems[k - len(stems) // 3]):
            xy, z = lens.pixels(np.array(views[name]), points)
            rows = np.flatnonzero(np.isfinite(xy[:, 0]) & shown[stem][1].ravel())
            labels, inner, depth = (each[tuple(xy[rows, ::-1].astype(int).T)] for each in shown[name])
            same = inner & (np.abs(depth - z[rows]) < 0.01 * z[rows])
            total += int(same.sum())
            right += int((labels == shown[stem][0].ravel()[rows])[same].sum())
    return right / max(total, 1), total


def main() -> None:
    """Make a room, or continue one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="a folder of the collection, with scene.xml")
    parser.add_argument(
        "out", type=Path, metavar="OUT", help="the folder to make, or to continue with the same options"
    )
    parser.add_argument("--train", type=int, default=60, help="training views (60)")
    parser.add_argument("--test", type=int, default=30, help="test views (30)")
    parser.add_argument("--size", default="640x480", help="WIDTHxHEIGHT of the pictures (640x480)")
    parser.add_argument("--spp", type=int, default=16, help="samples a pixel, before denoising (16)")
    parser.add_argument("--seed", type=int, default=0, help="decides the path, the test views and the noise (0)")
    parser.add_argument(
        "--without", nargs="*", help="things to remove in without/ (what the JSON names); none: no such views"
    )
    args = parser.parse_args()
    table = Path(__file__).with_suffix("") / f"{args.scene.resolve().name}.json"
    if not (args.scene / "scene.xml").is_file() or not table.is_file():
        known = ", ".join(sorted(file.stem for file in table.parent.glob("*.json")))
        raise SystemExit(f"{args.scene}: expected a scene folder with scene.xml, called one of {known}")
    try:
        import mitsuba as mi
        import pyoidn  # noqa: F401

        mi.set_variant("llvm_ad_rgb")
    except ImportError as error:
        raise SystemExit(f"{error}: pip install mitsuba==3.9.1 pyoidn; apt-get install libllvm19") from error
    about = json.loads(table.read_text(encoding="utf-8"))
    width, height = map(int, args.size.split("x"))
    lens = Lens(width, height, 0.65 * width)  # 75 degrees from side to side
    without = about["without"] if args.without is None else args.without
    options = {"scene": table.stem, "train": args.train, "test": args.test, "size": [width, height], "spp": args.spp}
    options |= {"seed": args.seed, "without": without}
    room = Room(args.scene, about)
    things, file = Things(about, room.shapes), args.out / "plan.json"
    removed = things.named(without)
    if not file.exists():
        if args.out.exists() and any(args.out.iterdir()):
            raise SystemExit(f"{args.out}: expected a new or empty folder, or one that this program began")
        inside = room.unit * room.to_scene.T @ np.array(about["inside"])
        write(file, make_plan(room.distances, lens, inside, options))
        write(args.out / "CREDIT.txt", about["credit"])
    plan = json.loads(file.read_text(encoding="utf-8"))
    if plan["options"] != options:
        raise SystemExit(f"{args.out}: made with {plan['options']}, not {options}; choose another folder")
    jobs = [(room, things, args.out, stem) for stem in plan["views"]]
    if removed:
        less = Room(args.scene, about, removed)
        rest = {
            kind: [[m for m in meshes if m not in removed] for meshes in all_] for kind, all_ in about["things"].items()
        }
        jobs += [
            (less, Things(about | {"things": rest}, less.shapes), args.out / "without", s)
            for s in plan["views"]
            if "test" in s
        ]
    for number, (shown, ids, out, stem) in enumerate(jobs):
        if not (out / "images" / f"{stem}.png").exists():
            started, light = time.time(), {"spp": args.spp, "seed": number, "exposure": about["exposure"]}
            render_view(shown, ids, lens, np.array(plan["views"][stem]), out, stem, **light)
            print(f"{number + 1} of {len(jobs)}: {out.name}/{stem}, {time.time() - started:.1f} s", flush=True)
    write_scene(args.out, lens, plan, things)
    share, count = agreement(args.out, lens, plan["views"])
    print(
        f"{args.out}: {len(plan['views'])} views; of {count:,} places in two views away from borders, {share:.2%} have one class"
    )


if __name__ == "__main__":
    main()
