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
    moved/                   and with the same things moved, if the JSON says by how many metres
    transforms.json, points.ply, split.json: cameras, 30,000 points with 1 cm noise, training and test views
A run that was killed continues: a view is made once, its picture last. transforms.json comes at the end.
"""

from __future__ import annotations

import argparse
import json
import os
import time
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rooms_path import Array, Lens, plan_views

VOID = 255
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

    def __init__(self, table: dict[str, list[list[str]]], shapes: list[str], removed: Sequence[str] = ()) -> None:
        self.classes = [name for name in table if name != "void"]
        self.meshes = {f"{name} {k + 1}": meshes for name in table for k, meshes in enumerate(table[name])}
        self.instances = [name for name in self.meshes if not name.startswith("void ")]
        owner = {mesh: name for name, meshes in self.meshes.items() for mesh in meshes}
        unknown = sorted({mesh.removesuffix(TOP) for mesh in owner} - {*shapes, *removed})
        if unknown or (missing := sorted(set(shapes) - set(owner))):
            raise SystemExit(f"the JSON of the scene: expected its shapes, got {unknown or f'no class of {missing}'}")
        parts = [owner.get(name + end, owner[name]) for name in shapes for end in ("", TOP)]
        known = {name: (k, self.classes.index(class_of(name))) for k, name in enumerate(self.instances)}
        ids = np.array([*(known.get(name, (VOID, VOID)) for name in parts), (VOID, VOID)], np.uint8)  # nothing hit: -1
        self.instance_ids, self.class_ids = ids.T

    def named(self, names: list[str]) -> list[str]:
        """The meshes of things, by instance ("chair 2") or class ("chair")."""
        if wrong := [name for name in names if name not in (*self.classes, *self.instances)]:
            known = ", ".join([*self.classes, *self.instances])
            raise SystemExit(f"--without: expected things of {known}; got {', '.join(wrong)}")
        return [mesh for name in self.instances if {name, class_of(name)} & {*names} for mesh in self.meshes[name]]


def class_of(instance: str) -> str:
    """The class of an instance: "chair" of "chair 2"."""
    return instance.rsplit(" ", 1)[0]


def mend(folder: Path, meshes: Sequence[str] = (), shift: Sequence[float] | None = None) -> ET.Element:
    """The scene file of Mitsuba 0.6 as 3.9 reads it, with an id for each shape: its mesh's name, or kind and number.

    Some meshes are moved by `shift`, in the scene's units and axes, or removed.
    """
    root = ET.parse(folder / "scene.xml").getroot()
    for number, e in enumerate(root.findall("shape")):
        mesh = e.find("string[@name='filename']")
        e.set("id", f"{e.get('type')}{number}" if mesh is None else Path(mesh.get("value", "")).stem)
        chosen = e.get("id") in meshes
        if (chosen and shift is None) or (mesh is not None and not (folder / mesh.get("value", "")).exists()):
            root.remove(e)
        elif chosen and shift is not None:
            place = e.find("transform[@name='toWorld']")
            place = ET.SubElement(e, "transform", name="toWorld") if place is None else place
            ET.SubElement(place, "translate", dict(zip("xyz", map(str, shift), strict=True)))
    for e in list(root.iter()):
        value = e.get("value", "")
        if e.get("name") == "filename":
            e.set("value", str((folder / value).resolve()))
        if value == "trilinear":
            e.set("value", "bilinear")
        if e.tag in ("rgb", "srgb") and value.startswith("#"):
            e.tag = "rgb"
            e.set("value", ", ".join(str((int(value[i : i + 2], 16) / 255) ** 2.2) for i in (1, 3, 5)))
        rough = e.get("type") == "roughdiffuse"
        if rough:
            e.set("type", "diffuse")
        old = {"extEta", "sunRadiusScale"} | ({"alpha", "useFastApprox"} if rough else set())
        for child in list(e):
            if child.tag in ("default", "integrator", "sensor") or child.get("name") in old:
                e.remove(child)
    return root


class Room:
    """A scene in Mitsuba, asked in metres with z up."""

    def __init__(
        self, folder: Path, metres_per_unit: float, meshes: Sequence[str] = (), moved: Sequence[float] | None = None
    ) -> None:
        import drjit
        import mitsuba as mi

        self.mi, self.reinterpret = mi, drjit.reinterpret_array
        self.to_scene = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # z up to y up
        shift = None if moved is None else (self.to_scene @ np.array(moved) / metres_per_unit).tolist()
        text = ET.tostring(mend(folder, meshes, shift), encoding="unicode")
        self.scene, self.unit = mi.load_string(text, optimize=False), metres_per_unit  # optimize would join shapes
        self.shapes = [shape.id() for shape in self.scene.shapes()]
        self.tops = np.array([0.9 * s.bbox().max.y + 0.1 * s.bbox().min.y for s in self.scene.shapes()])
        registered = np.array(self.reinterpret(mi.UInt32, self.scene.shapes_dr()))  # as threads loaded them
        self.place = np.full(int(registered.max()) + 1, -1)
        self.place[registered] = np.arange(len(registered))

    def rays(self, origins: Array, directions: Array) -> Any:
        """Rays of Mitsuba, in its units and axes."""
        start, way = origins @ self.to_scene.T / self.unit, directions @ self.to_scene.T
        return self.mi.Ray3f(self.mi.Point3f(start.T), self.mi.Vector3f(way.T))

    def distances(self, origins: Array, directions: Array) -> Array:
        """Metres [R] to the nearest surface, masked or not, as the planner asks; inf where there is none."""
        return np.array(self.scene.ray_intersect_preliminary(self.rays(origins, directions)).t, np.float64) * self.unit

    def trace(self, origins: Array, directions: Array) -> tuple[Array, np.ndarray]:
        """Metres [R] to what a picture shows, and parts [R]: twice the place of the shape, plus 1 on its top; inf, -1."""
        distance, part, rest = np.full(len(origins), np.inf), np.full(len(origins), -1), np.arange(len(origins))
        passed = np.zeros(len(origins))
        while len(rest):  # again behind masked surfaces, as leaves are
            starts = origins[rest] + directions[rest] * passed[:, None]
            hit = self.scene.ray_intersect(self.rays(starts, directions[rest]))
            valid, solid = np.array(hit.is_valid()), np.array(hit.bsdf().eval_null_transmission(hit)[0]) < 0.5
            shape = self.place[np.array(self.reinterpret(self.mi.UInt32, hit.shape))]
            top = (np.abs(np.array(hit.n.y)) > 0.7) & (np.array(hit.p.y) > self.tops[shape])
            metres, done = np.array(hit.t) * self.unit + passed, valid & solid
            distance[rest[done]], part[rest[done]] = metres[done], (2 * shape + top)[done]
            rest, passed = rest[valid & ~solid], metres[valid & ~solid] + 1e-4
        return distance, part

    def picture(self, lens: Lens, pose: Array, spp: int, seed: int, exposure: float) -> np.ndarray:  # [H, W, 3] uint8
        """Path traced with albedo and normals, denoised by them, and encoded with gamma 2.2."""
        import pyoidn

        to_world = np.eye(4)
        to_world[:3, :3] = self.to_scene @ pose[:3, :3] @ np.diag([-1.0, -1.0, 1.0])  # Mitsuba: x left, y up
        to_world[:3, 3] = self.to_scene @ pose[:3, 3] / self.unit
        film = {"type": "hdrfilm", "width": lens.width, "height": lens.height, "rfilter": {"type": "box"}}
        fov = float(np.degrees(2 * np.arctan(lens.width / 2 / lens.focal)))
        sensor = {"type": "perspective", "fov": fov, "fov_axis": "x", "near_clip": 0.01, "far_clip": 1e4, "film": film}
        sensor |= {"to_world": self.mi.ScalarTransform4f(to_world), "sampler": {"type": "independent"}}
        path = {"type": "aov", "aovs": "a:albedo,n:sh_normal", "light": {"type": "path", "max_depth": 8}}
        camera, method = self.mi.load_dict(sensor), self.mi.load_dict(path)
        made = np.array(self.mi.render(self.scene, sensor=camera, integrator=method, spp=spp, seed=seed), np.float32)
        light, albedo, normal = (np.nan_to_num(part) for part in (made[..., :3], made[..., -6:-3], made[..., -3:]))
        light = np.asarray(pyoidn.denoise(light, np.clip(albedo, 0, 1), np.clip(normal, -1, 1), hdr=True)) * exposure
        return np.round(np.clip(light, 0, 1) ** (1 / 2.2) * 255).astype(np.uint8)


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


def write_scene(out: Path, lens: Lens, poses: dict[str, Array], things: Things, seed: int) -> None:
    """Cameras, split, names and points of a folder whose views are all made."""
    train = [stem for stem in poses if stem.startswith("train")]
    rng, points, colors = np.random.default_rng([seed, 1]), [], []
    for stem in train:
        depth = np.load(out / "depth" / f"{stem}.npy").ravel()
        rows = rng.choice(len(depth), -(-POINTS // len(train)))
        rows = rows[depth[rows] > 0]
        origins, directions, lengths = lens.rays(poses[stem])
        points.append((origins + directions * (lengths * depth)[:, None])[rows])
        colors.append(np.array(Image.open(out / "images" / f"{stem}.png")).reshape(-1, 3)[rows])
    table = np.concatenate([np.concatenate(points), np.concatenate(colors)], 1)
    table[:, :3] += rng.normal(0, POINT_NOISE, (len(table), 3))
    kinds = [f"property float {axis}" for axis in "xyz"]
    kinds += [f"property uchar {color}" for color in ("red", "green", "blue")]
    lines = ["ply", "format ascii 1.0", f"element vertex {len(table)}", *kinds, "end_header"]
    lines += [f"{x:.4f} {y:.4f} {z:.4f} {r:.0f} {g:.0f} {b:.0f}" for x, y, z, r, g, b in table]
    write(out / "points.ply", "\n".join([*lines, ""]))
    write(out / "classes.json", things.classes)
    write(out / "instances.json", [{"name": name, "class": class_of(name)} for name in things.instances])
    write(out / "split.json", {"train": train, "test": [stem for stem in poses if stem not in train]})
    opengl = np.diag([1.0, -1.0, -1.0, 1.0])  # x right, y up, z backward
    frames = [{"file_path": f"images/{s}.png", "transform_matrix": (p @ opengl).tolist()} for s, p in poses.items()]
    numbers = {"w": lens.width, "h": lens.height, "fl_x": lens.focal, "fl_y": lens.focal}
    numbers |= {"cx": lens.width / 2, "cy": lens.height / 2}
    write(out / "transforms.json", {**numbers, "ply_file_path": "points.ply", "frames": frames})


def main() -> None:
    """Make a room, or continue one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="a folder of the collection, with scene.xml")
    parser.add_argument("out", type=Path, metavar="OUT", help="the folder to make, or to continue")
    parser.add_argument("--train", type=int, default=60, help="training views (60)")
    parser.add_argument("--test", type=int, default=30, help="test views (30)")
    parser.add_argument("--size", default="640x480", help="WIDTHxHEIGHT of the pictures (640x480)")
    parser.add_argument("--spp", type=int, default=16, help="samples a pixel, before denoising (16)")
    parser.add_argument("--seed", type=int, default=0, help="decides the path, the test views and the noise (0)")
    parser.add_argument(
        "--without", nargs="*", help="things to remove in without/ (those of the JSON); none: no such views"
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
    options = vars(args) | {"scene": table.stem, "out": None, "without": without, "moved": about.get("moved")}
    room = Room(args.scene, about["metres_per_unit"])
    things, file = Things(about["things"], room.shapes), args.out / "plan.json"
    removed = things.named(without)
    if not file.exists():
        if args.out.exists() and any(args.out.iterdir()):
            raise SystemExit(f"{args.out}: expected a new or empty folder, or one that this program began")
        inside, middle = np.array(about["inside"]), np.array(about["middle"])
        views = plan_views(room.distances, lens, inside, middle, args.train, args.test, args.seed)
        write(args.out / "CREDIT.txt", about["credit"])
        write(file, {"options": options, "views": {stem: pose.tolist() for stem, pose in views.items()}})
    plan = json.loads(file.read_text(encoding="utf-8"))
    if plan["options"] != options:
        raise SystemExit(f"{args.out}: made with {plan['options']}, not {options}; choose another folder")
    views = {stem: np.array(pose) for stem, pose in plan["views"].items()}
    jobs = [(room, things, args.out, stem) for stem in views]
    test = [stem for stem in views if stem.startswith("test")]
    edited = {"without": None} | ({"moved": options["moved"]} if options["moved"] else {})
    for folder, shift in edited.items() if removed else ():
        other = Room(args.scene, about["metres_per_unit"], removed, shift)
        kept = Things(about["things"], other.shapes, removed)
        jobs += [(other, kept, args.out / folder, stem) for stem in test]
    for number, (shown, ids, out, stem) in enumerate(jobs):
        if not (out / "images" / f"{stem}.png").exists():
            started, light = time.time(), {"spp": args.spp, "seed": number, "exposure": about["exposure"]}
            render_view(shown, ids, lens, views[stem], out, stem, **light)
            print(f"{number + 1} of {len(jobs)}: {out.name}/{stem}, {time.time() - started:.1f} s", flush=True)
    write_scene(args.out, lens, views, things, args.seed)
    print(f"{args.out}: {args.train} training and {args.test} test views")


if __name__ == "__main__":
    main()
