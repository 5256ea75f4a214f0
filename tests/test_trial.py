"""Fifteen things that a researcher tried without reading the source: each runs at the first guess, or the message helps."""

import json

import numpy as np
import pytest
import pyvista as pv
import torch
from cases_viz import some_plotter
from messages import refused
from PIL import Image

import kfgs
from kfgs import viz
from kfgs.cameras import Orbit, estimate_up, orbit_cameras, to_kornia
from kfgs.evaluation import evaluate_segmentation
from kfgs.fields import Identity, Training, UpliftConfig, fit_field, fuse_views, uplift_maps
from kfgs.fields.uplift import join_fields
from kfgs.labels import EditList, InBox, Insert, OfClass, nearest_labels


@pytest.fixture(scope="module")
def scene(desk):
    return kfgs.load_scene(desk / "scene")


@pytest.fixture(scope="module")
def field(desk):
    return kfgs.SemanticField.load(desk / "run")


@pytest.fixture(scope="module")
def splat(desk):
    return kfgs.read_splats(desk / "my.ply")


@pytest.fixture
def plotter():
    """A plotter of pyvista's own."""
    with some_plotter():  # skips where nothing can be drawn
        plotter = pv.Plotter(off_screen=True, window_size=(160, 120))
    yield plotter
    plotter.close()


def test_1_cameras_and_photos_of_a_scene(scene):
    assert [scene[name] for name in ("view_000.png", "view_000")] == scene[:1] * 2
    assert ["view_000" in scene, "view_0" in scene, scene[1] in scene] == [True, False, True]
    for camera in scene:
        assert scene.image(camera.name).shape == scene.image(camera).shape == (*camera.size, 3)


def test_2_a_picture_of_features_from_a_new_view(field):
    camera = kfgs.Camera.look_at((1.0, 1.0, 1.5), (0.0, 0.0, 0.5), fov_degrees=70, width=80, height=60)
    assert viz.FeatureColors.fit(field.latents)(field.render(camera).map).shape == (60, 80, 3)


def test_3_volume_of_each_class(field):
    cloud = field.label()
    volumes = {cloud.names[k]: part.scales.prod(dim=1).sum() for k, part in cloud.by_class().items() if k >= 0}
    assert volumes["wall"] > 0


def test_4_boxes_of_chairs_as_json(field, tmp_path):
    parts = kfgs.connected_parts(field, "chair")
    (tmp_path / "boxes.json").write_text(json.dumps([part.to_json() for part in parts]))
    assert json.loads((tmp_path / "boxes.json").read_text())[0]["count"] == len(parts[0].gaussians)
    asked = kfgs.connected_parts(field, field.query("chair"))
    assert kfgs.connected_parts(field, ["chair", OfClass("floor")])[0].count > parts[0].count
    ruled = kfgs.connected_parts(field, OfClass("chair"))
    assert parts[0].count == ruled[0].count
    columns = {name: column for name, column in field.label().to_numpy().items() if column.ndim == 1}  # for pandas
    assert set(columns) == {"opacities", "labels", "scores"}
    refused(lambda: field.query(["chair", "wall"]), "embedding:", "got list", "field.query(name)", error=TypeError)
    assert abs(asked[0].count - parts[0].count) <= 5


def test_5_classes_for_my_points_and_my_mesh(field):
    cloud, mesh = field.label(), pv.Sphere()
    carried = nearest_labels(cloud.means, cloud.labels, np.asarray(mesh.points), 2.0)
    assert len(carried.labels) == mesh.n_points
    refused(lambda: kfgs.transfer_labels(field, mesh), "target:", "got PolyData", "nearest_labels", error=TypeError)
    refused(lambda: kfgs.transfer_labels("run", cloud), "source:", "SemanticField.load", error=TypeError)
    refused(lambda: kfgs.attach(cloud, field), "field:", "got Gaussians", "SemanticField.load", error=TypeError)


def test_6_a_codebook_of_numpy_maps():
    maps = [np.random.default_rng(seed).normal(size=(6, 8, 16)).astype(np.float32) for seed in range(2)]
    assert kfgs.fit_codebook(maps, kfgs.PaperCodebook(epochs=1)).codewords.shape[1] == 16


def test_7_scores_of_my_own_predictions(field):
    truth = {"a": np.array([[0, 1], [1, -1]]), "b": torch.tensor([[2, 2]])}
    for predicted in (truth, truth.get, {name: torch.as_tensor(labels) for name, labels in truth.items()}):
        assert evaluate_segmentation(predicted, truth, field.classes).miou.value == 1
    own = {stem: field.segment(stem) for stem in ("view_000", "view_002")}
    assert evaluate_segmentation(field, own, field.classes).miou.value == 1
    refused(lambda: evaluate_segmentation({}, truth, field.classes), "predict('a'):", "got NoneType", error=TypeError)


def test_8_several_splats(field, splat, tmp_path):
    for k in range(2):
        kfgs.write_splats(kfgs.attach(field, splat).gaussians, tmp_path / f"{k}.ply")
        assert kfgs.read_splats(tmp_path / f"{k}.ply").names == field.classes.names
    refused(lambda: kfgs.SemanticField.load(tmp_path / "0.ply"), "0.ply:", "a field", "read_splats opens a splat")


def test_9_a_label_map_with_a_legend(scene, field):
    labels = field.segment(scene[0])
    assert labels.equal(field.segment(scene[0].name.removesuffix(".png")))
    refused(lambda: field.segment("view"), "camera:", "got 'view'", "did you mean 'view_")
    assert field.segment(scene[:2])[0].equal(labels)
    assert (
        field.segment(to_kornia(scene)).shape
        == field.render(to_kornia(scene)).alpha.shape
        == (len(scene), *labels.shape)
    )
    pictures = [
        viz.overlay_labels(scene.image(0), labels, n) for n in (field.names, field.classes, field, field.label())
    ]
    assert all((picture == pictures[0]).all() for picture in pictures)


def test_the_depth_of_a_pixel_and_how_sure_its_class_is(scene, field, splat, desk):
    for camera in scene.select("test"):
        stem = camera.name.removesuffix(".png")
        depth, labels = np.load(desk / f"scene/depth/{stem}.npy"), Image.open(desk / f"scene/labels/{stem}.png")
        for drawn in (field.render(camera), kfgs.rasterize(splat, camera)):
            assert np.median(np.abs(drawn.depth.numpy() - depth)) < 0.1  # of some 3 metres
        ranked = field.rank(camera)
        sure, right = ranked.scores[..., 0], ranked.labels[..., 0] == torch.from_numpy(np.array(labels))
        assert sure[right].mean() > sure[~right].mean() + 0.1


def test_10_a_film(field, splat, tmp_path):
    cameras = orbit_cameras(splat.means, Orbit(frames=2, size=(48, 64)))
    for name, shown in {"splat": splat, "field": field, "both": {"a": field, "b": splat}}.items():
        assert viz.save_animation(tmp_path / f"{name}.gif", shown, cameras, legend=field).is_file()
    seen = []

    def look(camera):
        seen.append(camera)
        raise RuntimeError("one is enough")

    for shown in (field, splat):  # without cameras once around; walls of a room that are in front are cut away
        call = lambda shown=shown: viz.save_animation(tmp_path / "a.gif", {"a": shown, "b": look})  # noqa: E731
        refused(call, "one is enough", error=RuntimeError)
    assert seen[0].near / seen[0].center.norm() > 0.75 > seen[1].near / seen[1].center.norm()
    for given in (cameras, None):
        call = lambda given=given: viz.save_animation(tmp_path / "a.gif", "run", given)  # noqa: E731
        refused(call, "expected a SemanticField or Gaussians", "SemanticField.load", error=TypeError)


def test_11_my_own_network_is_a_teacher(scene, tmp_path):
    kfgs.extract_features(torch.nn.Conv2d(3, 4, 8, 8), scene, tmp_path / "maps", split="test")
    assert kfgs.FeatureFolder(tmp_path / "maps").of(scene, "test")[0].shape[-1] == 4
    refused(lambda: kfgs.fit(scene, "maps"), "maps:", "FeatureFolder", error=TypeError)


def test_12_gradients_through_a_frozen_field(field):
    head = torch.nn.Linear(field.latents.shape[1], 3)
    camera = field.cameras[0]
    rendered = kfgs.rasterize(field.gaussians.replace(features=head(field.latents)), camera).map
    rendered.square().sum().backward()
    assert head.weight.grad.abs().sum() > 0


def test_13_two_fields_as_one_cloud(field):
    both = join_fields([field, field])
    assert len(both) == 2 * len(field)
    assert kfgs.Gaussians.cat([field, field]).labels.equal(torch.cat([field.label().labels] * 2))


def test_14_crops(field, splat):
    labelled = kfgs.transfer_labels(field, splat)
    chairs = labelled[OfClass("chair")]
    assert set(chairs.labels.tolist()) == {labelled.names.index("chair")}
    assert len(field[OfClass("chair")]) == int((field.label().labels == field.names.index("chair")).sum())
    assert len(kfgs.Remove(labelled.labels == chairs.labels[0]).apply(labelled)) == len(labelled) - len(chairs)
    low, high = field.gaussians.means.amin(0).tolist(), field.gaussians.means.mean(0).tolist()
    inside = InBox(low, high).select(field)
    assert 0 < len(inside) < len(field)
    for which in (inside, inside.mask, inside.indices, InBox(low, high)):
        assert len(field[which]) == len(field.select(which)) == len(field.gaussians[which]) == len(inside)
    assert len(splat[labelled.labels >= 0]) <= len(splat)
    refused(lambda: splat["chair"], "which:", "pass a rule like OfClass('chair')", error=TypeError)
    refused(lambda: splat[OfClass("chair")], "gaussians.labels:", "attach a field")


def test_15_a_field_of_my_own_gaussians_and_features(splat):
    features = torch.nn.functional.normalize(torch.randn(len(splat), 5), dim=1)
    field = kfgs.SemanticField(splat.replace(features=features), Identity(5))
    assert field.query(features[0], score="cosine").scores[0] > 0.99


def test_a_camera_alone_stands_for_a_list_of_cameras(field, splat, tmp_path):
    camera, latents = field.cameras[0], field.latents.shape[1]
    for call in (
        estimate_up,
        lambda views: to_kornia(views).extrinsics,
        lambda views: fuse_views(field, views).cameras,
        lambda views: uplift_maps(splat, views, [torch.ones(6, 8, 4)], UpliftConfig(corrections=0)).latents,
        lambda views: fit_field(field.gaussians, views, [torch.ones(6, 8, latents)], Training(steps=1)).history[0][
            "loss"
        ],
        lambda views: kfgs.attach(field, splat, cameras=views).facts["counts"],
        lambda views: kfgs.pipeline.segment_cameras(field, views, field.classes, tmp_path),
        lambda views: viz.views_of_change(splat, splat[1000:], views),
        lambda views: viz.save_animation(tmp_path / "a.gif", splat, views).read_bytes(),
        lambda views: viz.show_transfer(field, splat, cameras=views, off_screen=True).close(),
        lambda views: kfgs.explore(splat, cameras=views, where="picture").state.cameras,
    ):
        assert repr(call(camera)) == repr(call([camera]))


HELD = ("class", "label", "score", "feature", "opacity", "chair", OfClass("chair"), None)


@pytest.mark.parametrize("color_by", HELD)
def test_pyvista_takes_a_field(field, plotter, color_by):
    assert viz.add_cloud(plotter, field, color_by=color_by, style="gaussians").mapper.dataset.n_points == len(field)
    assert viz.to_pyvista(field, color_by).n_points == len(field)


def test_what_a_person_holds_is_drawn(field, splat, scene, plotter):
    selection = field.query("chair")
    viz.add_cloud(plotter, field, color_by=selection, cmap="viridis", show_scalar_bar=True, point_size=2, name="field")
    viz.add_cloud(plotter, field, color_by="chair", name="field")
    viz.add_legend(plotter, field)
    viz.add_boxes(plotter, kfgs.connected_parts(field, selection))
    viz.add_cameras(plotter, scene, most=2)
    viz.add_cameras(plotter, field)
    assert plotter.screenshot(return_img=True).std() > 1
    for opened in (viz.linked_clouds(field, splat, off_screen=True), viz.show_transfer(field, splat, off_screen=True)):
        opened.close()
    refused(lambda: viz.add_cloud(plotter, "run/"), "gaussians:", "got str", "SemanticField.load", error=TypeError)
    refused(lambda: kfgs.explore("run/"), "source:", "SemanticField.load", error=TypeError)
    refused(lambda: kfgs.explore(field, "my.ply"), "color:", "read_splats", error=TypeError)
    refused(lambda: kfgs.write_splats(field, "a.ply"), "gaussians:", ".label()", error=TypeError)
    refused(lambda: viz.add_cloud(plotter, field, color_by="chairs"), "color_by:", "did you mean 'chair'")


def test_a_splat_with_lost_gaussians_is_shown(field, splat, notes):
    means = splat.means.clone()
    means[3] = torch.nan
    plotter = viz.show_transfer(field, splat.replace(means=means), off_screen=True)
    lines = plotter.actors["transfer"].mapper.dataset
    assert 3 not in lines["destination"]
    assert np.isfinite(lines.points).all()
    plotter.close()


def test_an_edit_of_a_field_is_one_of_its_labelled_gaussians(field, splat, tmp_path):
    removed = kfgs.Remove("chair").apply(field)
    assert isinstance(removed, kfgs.Gaussians)
    assert len(removed) == len(field) - int((field.label().labels == field.names.index("chair")).sum())
    kfgs.write_splats(splat, tmp_path / "more.ply")
    refused(lambda: Insert(tmp_path / "more.ply").apply(field), "sh:", "none in the scene")
    assert isinstance(EditList([]).apply(field), kfgs.Gaussians)
    refused(lambda: kfgs.Recolor("chair", "teal").apply(field), "gaussians.sh:", "pass the colour field")
    refused(lambda: kfgs.Remove("chair").apply("run/"), "gaussians:", "SemanticField.load", error=TypeError)
