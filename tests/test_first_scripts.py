"""Five scripts that a new user writes first, each complete; they run as they stand on the toy room."""

import numpy as np
import pytest
from cases_color import make_splat
from PIL import Image
from small_room import make_room

from kfgs import FeatureFolder, FitConfig, UpliftConfig, fit_scene, load_scene
from kfgs.viz import available


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A folder as the user has it after `kfgs fit`: scene/, run/field, and a splat of another program, my.ply."""
    folder = tmp_path_factory.mktemp("room")
    make_splat(make_room(folder / "scene"), folder / "my.ply")
    scene = load_scene(folder / "scene")
    maps = FeatureFolder(folder / "scene" / "features", [scene.stem(i) for i in scene.views("train")])
    config = FitConfig(uplift=UpliftConfig.field(max_gaussians=2_000))
    fit_scene(scene, maps, folder / "run", config, splat=folder / "my.ply")
    return folder


@pytest.fixture(autouse=True)
def inside(room, monkeypatch):
    monkeypatch.chdir(room)


def test_a_picture_of_the_features_from_a_new_viewpoint():
    from kfgs import SemanticField, load_scene, viz

    field = SemanticField.load("run/field")
    scene = load_scene("scene")
    camera = scene.cameras[scene.views("test")[0]]
    colors = viz.feature_colors(field)  # a PCA of the whole scene: the same colours in every view
    viz.save_picture("features.png", colors(field.render(camera).map))

    picture = np.asarray(Image.open("features.png"))
    assert picture.shape == (60, 80, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100


def test_the_gaussians_of_a_class_in_pyvista():
    from kfgs import SemanticField, viz

    field = SemanticField.load("run/field")
    chair = field.query("chair")
    chairs = field.gaussians[chair]
    points = viz.to_pyvista(chairs)  # points.plot(scalars="rgb", rgb=True) opens a window
    assert points.n_points == len(chairs) == len(chair) > 20
    assert points["rgb"].shape == (len(chairs), 3)
    if not available():
        pytest.skip("nothing can be drawn here")

    plotter = viz.make_plotter(240, 320)
    viz.add_cloud(plotter, chairs, style="gaussians")  # plotter.show() opens a window
    plotter.screenshot("chairs.png")
    plotter.close()
    assert np.asarray(Image.open("chairs.png")).std() > 5


def test_labels_for_a_splat_of_another_program():
    from kfgs import SemanticField, attach, read_splats, write_splats

    field = SemanticField.load("run/field")
    labelled = attach(field, "my.ply").splats
    write_splats("labelled.ply", labelled)

    again = read_splats("labelled.ply")
    assert again.classes == field.label_set().names
    true = np.load("scene/surface.npz")["labels"]
    assert (again.gaussians.labels.numpy() == true).mean() > 0.6
    same = attach(field, read_splats("my.ply").gaussians).labels
    assert same.equal(again.gaussians.labels)


def test_how_the_codebook_grew():
    from kfgs import FeatureFolder, fit_codebook, viz

    fit = fit_codebook(FeatureFolder("scene/features"))
    viz.plot_codebook_growth(fit.history, "growth.png")

    assert fit.history[-1]["size"] == fit.codebook.size
    assert np.asarray(Image.open("growth.png")).shape[1] > 600


def test_the_chairs_as_points_and_box_for_trimesh_or_open3d():
    from kfgs import SemanticField
    from kfgs.labels import OrientedBox

    field = SemanticField.load("run/field")
    chairs = field.gaussians[field.query("chair")]
    points = chairs.to_numpy()["means"]  # trimesh.PointCloud(points), open3d.utility.Vector3dVector(points)
    box = OrientedBox.around(points)
    corners = box.corners.numpy()

    assert points.shape == (len(chairs), 3)
    assert corners.shape == (8, 3)
    assert box.contains(points).all()
    assert (corners.min(axis=0) <= points.min(axis=0) + 1e-6).all()
