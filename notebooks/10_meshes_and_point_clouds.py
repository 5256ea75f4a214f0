# %% [markdown]
# # 10. Meshes and point clouds
#
# **How do I use the classes of a field outside of kfgs: in trimesh, Open3D or pyvista, and on a mesh of the same room?** You will
# see the chairs as a point cloud of trimesh, the classes carried to a mesh, the area of each class next to
# the true one, and files for Blender.
#
# About a minute on two CPU cores if no notebook was run before this one, 15 seconds if
# `5_query_transfer_edit` was. Needs the extra `notebook`, no data. Open3D (400 MB) is used if it is there.

# %%
# Your own data: a scene, its teacher's maps, the classes with their text embeddings, a run folder; a mesh of the scene in the
# same frame; what to look for, the classes to measure, and what hides the rest from outside.
import os
from pathlib import Path

from kfgs import ToyConfig, make_toy_room

data = Path(os.environ.get("KFGS_NOTEBOOK_DATA", "data"))
folder = make_toy_room(data / "room", ToyConfig(train_views=24, test_views=6))  # yours: folder = Path("my/scene")
features, names, text = folder / "features", folder / "classes.json", folder / "text.npy"
run, out = data / "run", data / "meshes"
mesh_file = None  # yours: Path("scan.ply"); None: the boxes and ellipsoids that the toy room is made of
thing, measured = "chair", ("chair", "table", "sofa", "cabinet", "plant")
shell = ("ceiling", "wall", "door", "picture")
finest, reach = 0.1, 0.1  # scene units: longer edges of the mesh are divided first; lambda, None: the spacings decide

# %%
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pyvista as pv
import trimesh
from PIL import Image

import kfgs
from kfgs import viz
from kfgs.cameras import Orbit, estimate_up, orbit_cameras
from kfgs.labels import nearest_labels
from kfgs.toy import build_room

scene = kfgs.load_scene(folder).undistorted()
classes = kfgs.load_label_set(names, text)
maps = kfgs.FeatureFolder(features).of(scene, "train")
quick = kfgs.ColorConfig.quick()
quick = replace(quick, training=quick.training.with_steps(800).with_maximum(60_000))
color = kfgs.fit_color(scene, run, quick)  # the same fields as in notebooks 4 to 6
field = kfgs.fit(scene, maps, kfgs.Uplift(color), folder=run)
splat = kfgs.attach(field, color, classes).gaussians  # the colour splat with a class for each Gaussian
print(splat)

# %% [markdown]
# ## A point cloud of trimesh
#
# `to_pyvista` gives one point per Gaussian with named arrays: its class, colour, opacity and size. trimesh takes positions
# and colours.

# %%
found = kfgs.OfClass(thing).select(splat)
arrays = viz.to_pyvista(splat.select(found.mask), "rgb")
print({name: np.shape(arrays[name]) for name in arrays.array_names})
points = trimesh.PointCloud(arrays.points, colors=arrays["rgb"])
box = points.bounding_box_oriented
print(
    f"the {thing}s lie in a box of {np.round(box.primitive.extents, 2)}, their hull has {points.convex_hull.volume:.2f}"
)

# %% [markdown]
# The same for Open3D, whose point cloud takes every array along, and selections keep them.

# %%
if find_spec("open3d"):
    import open3d

    arrays = viz.to_pyvista(splat)
    cloud = open3d.t.geometry.PointCloud(open3d.core.Tensor(np.array(arrays.points)))
    cloud.point["colors"] = open3d.core.Tensor(np.array(arrays["rgb"]))
    cloud.point["label"] = open3d.core.Tensor(arrays["label"].astype(np.int32)[:, None])
    print(cloud)
    print(cloud.select_by_index(np.flatnonzero(found.mask)))
else:
    print("not installed: pip install open3d")

# %% [markdown]
# ## Classes on a mesh
#
# The other direction: the centre of every face takes the label of the nearest Gaussian that is closer than
# lambda (Sec. 3.4 of the paper). Large faces are divided first: a wall of two triangles has two centres. This mesh has sides
# that no picture shows, for example the undersides and the backs of the cabinets. A small lambda leaves them without a class;
# without a lambda of yours, 99.5 % of the mesh get one.

# %%
if mesh_file is None:
    parts, solids = [], build_room(ToyConfig().seed)
    for solid in solids:
        is_box = solid.shape == "box"
        part = trimesh.creation.box((2, 2, 2)) if is_box else trimesh.creation.icosphere(subdivisions=3)
        turn = np.eye(4)
        turn[:3, :3], turn[:3, 3] = solid.rotation(), solid.center
        parts.append(part.apply_scale(solid.half).apply_transform(turn))
    mesh = trimesh.util.concatenate(parts)
else:
    mesh = trimesh.load_mesh(mesh_file)
fine = mesh.subdivide_to_size(finest, max_iter=20)
near = nearest_labels(splat.means, splat.labels, fine.triangles_center, reach)
faces = near.labels.numpy()
print(near)

# %% [markdown]
# The labels are one array; it can be attached to a mesh of any library. Here pyvista draws it, without walls and ceiling.

# %% tags=["thumbnail"]
surface = pv.wrap(fine)
surface.cell_data["rgb"] = viz.palette(faces, classes.names)
hidden = [-1, *(classes.index(name) for name in shell if classes.knows(name))]
inside = surface.extract_cells(~np.isin(faces, hidden))
up = estimate_up(scene.cameras)
orbit = Orbit(frames=1, size=(450, 640), elevation_degrees=50, start_degrees=120, zoom=1.8)
furniture = splat[~np.isin(splat.labels, hidden)]
outside = orbit_cameras(furniture.means, orbit, up=up)[0]
plotter = viz.make_plotter(*outside.size, off_screen=True)
plotter.add_mesh(inside, scalars="rgb", rgb=True, ambient=0.4, diffuse=0.7)
viz.look_through(plotter, outside)
picture = plotter.screenshot()
plotter.close()
shown = viz.show_cloud(furniture, color_by="rgb")(outside)
Image.fromarray(viz.picture_grid([[shown, picture]], ("the splat", "the mesh with its classes"), width=512))

# %% [markdown]
# ## Areas
#
# The area of a class is the sum of its faces. The toy room knows the truth: the solids that each class is made of. Found areas
# are smaller where sides are hidden (sofa, cabinet), and larger where the class spills over to what is near (the chairs to floor
# and rug below them, of which the splat has few Gaussians).

# %%
areas = np.bincount(faces + 1, fine.area_faces, len(classes) + 1)[1:]  # the first is of no class
for name in measured:
    line = f"{name:<10} area {areas[classes.index(name)]:6.2f}"
    if mesh_file is None:
        true = [part for part, solid in zip(parts, solids, strict=True) if solid.label == name]
        line += f"   true: {sum(part.area for part in true):6.2f}"
    print(line)

# %% [markdown]
# ## Files
#
# A mesh in the colours of its classes, for any program, and one plain PLY for each class of the splat, for programs that show
# splats as separate objects. On the command line: `kfgs convert labelled.ply objects/ --by-class`.

# %%
out.mkdir(exist_ok=True)
fine.visual.face_colors = viz.palette(faces, classes.names)
fine.export(out / "classes.glb")
for label, part in splat.by_class().items():
    name = "unlabelled" if label < 0 else classes.names[label].replace(" ", "_")
    kfgs.write_splats(part.replace(labels=None, scores=None), out / f"{name}.ply", plain=True)
print(*sorted(path.name for path in out.glob("*.[gp]l[by]")), sep=", ")

# %% [markdown]
# [5_query_transfer_edit](5_query_transfer_edit.ipynb) has edits, [6_inspect_in_pyvista](6_inspect_in_pyvista.ipynb) the viewer.
