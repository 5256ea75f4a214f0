import shutil
from dataclasses import replace

import pytest
import torch
from cases_training import SHORT as BASE
from cases_training import blobs, changed, look_at_origin, same, scene
from messages import refused, tells

from kfgs import Gaussians, rasterize
from kfgs.cameras import Distortion, resize_map
from kfgs.fields import Densify, Rates, Training, fit_field, gaussians_from_points
from kfgs.fields.loss import l1_loss
from kfgs.fields.train import Trainer

CHANNELS = 3
SHORT = changed(BASE, features_rate=0.05, reset_every=25)


def start(n=60, channels=CHANNELS):
    points = torch.rand(n, 3, generator=torch.Generator().manual_seed(7)) * 2.4 - 1.2
    return gaussians_from_points(points, channels)


def mean_loss(gaussians, cameras, targets):
    return sum(
        float((rasterize(gaussians, camera).map - target).abs().mean())
        for camera, target in zip(cameras, targets, strict=True)
    ) / len(cameras)


def test_targets_are_recovered_from_a_poor_start():
    cameras, targets = scene()
    rates = {"means_rate": 5e-3, "quats_rate": 0.01, "scales_rate": 0.02, "features_rate": 0.03}
    config = changed(SHORT, steps=300, stop=200, every=20, gradient=2e-3, reset_every=0, **rates)
    fit = fit_field(start(), cameras, targets, config)
    level = sum(float(target.abs().mean()) for target in targets) / len(targets)
    assert mean_loss(fit.gaussians, cameras, targets) < 0.05 * level
    held_out = look_at_origin(0.75)
    truth = rasterize(blobs(), held_out).map
    assert mean_loss(fit.gaussians, [held_out], [truth]) < 0.12 * level
    assert len(fit.gaussians) > 60  # densified
    assert fit.history[-1]["loss"] < 0.1 * fit.history[0]["loss"]


def test_coarse_maps_do_not_make_the_papers_schedule_explode():
    """1,500 steps with maps of 4x5 cells, one class each, of 56x72 pixels: 6,500 Gaussians here, 5,200 with maps enlarged to the
    paper's 42x54, and 11,200 if the rendering is averaged over each cell."""
    cameras, _ = scene()
    cameras, latents = [camera.resized(56, 72) for camera in cameras], torch.cat([torch.zeros(1, 3), torch.eye(3)])
    maps = [resize_map(rasterize(blobs(), camera).map, (4, 5), antialias=True) for camera in cameras]
    targets = [latents[(map.argmax(2) + 1) * (map.sum(2) >= 0.3)] for map in maps]
    trainer = Trainer(start(100), cameras, targets, Training(extent=4.4), l1_loss, torch.Generator().manual_seed(0))
    while trainer.step < 1_500:
        trainer.advance_()
    assert 3_000 < len(trainer.gaussians()) < 8_500


def test_without_an_extent_that_of_the_cameras_is_used():
    """Three cameras on a circle of radius 4: their mean, and from it the farthest one, by hand."""
    cameras, targets = scene(3)
    centers = torch.stack([camera.center for camera in cameras]).double()
    extent = 1.1 * float((centers - centers.mean(0)).square().sum(1).sqrt().max())
    assert 1 < extent < 4
    fits = [fit_field(start(), cameras, targets, changed(SHORT, extent=size)).gaussians for size in (None, extent, 9.0)]
    assert same(fits[0], fits[1])
    assert not same(fits[0], fits[2])


def test_every_view_comes_once_per_epoch_in_seeded_random_order():
    cameras, targets = scene(4)

    class Recorded(list):
        def __init__(self, maps):
            super().__init__(maps)
            self.order = []

        def __getitem__(self, i):
            self.order.append(i)
            return super().__getitem__(i)

    def order(seed):
        maps = Recorded(targets)
        config = changed(SHORT, steps=12)
        fit_field(start(), cameras, maps, config, generator=torch.Generator().manual_seed(seed))
        return maps.order

    views = order(1)
    assert len(views) == 12  # each target is read once per step, and no more
    assert [sorted(views[i : i + 4]) for i in (0, 4, 8)] == [[0, 1, 2, 3]] * 3
    assert order(1) == views
    assert any(order(seed) != views for seed in (2, 3))


def test_equal_seeds_give_equal_bits_and_the_start_stays():
    cameras, targets = scene(3)
    first = start()
    before = Gaussians(**{name: value.clone() for name, value in first.tensors().items()})
    fits = [fit_field(first, cameras, targets, SHORT) for _ in range(2)]
    assert same(fits[0].gaussians, fits[1].gaussians)
    assert same(first, before)
    assert not fits[0].gaussians.means.requires_grad


@pytest.mark.parametrize("stop_at", [30, 50])  # between checkpoints: resumes from step 20 and step 40
def test_a_resumed_fit_equals_an_undisturbed_one_bit_for_bit(tmp_path, stop_at):
    cameras, targets = scene(3)
    path, rows = tmp_path / "fit.pt", []

    def run(**options):
        return fit_field(start(), cameras, targets, SHORT, generator=torch.Generator().manual_seed(3), **options)

    def interrupt(row):
        if row["step"] == stop_at:
            raise StopIteration

    whole = run()
    with pytest.raises(StopIteration):
        run(progress=interrupt, checkpoint=path)
    resumed = run(progress=rows.append, checkpoint=path)
    assert rows[0]["step"] == stop_at  # it did not start again
    assert set(rows[0]) == {"step", "loss", "count", "seconds"}
    assert same(resumed.gaussians, whole.gaussians)
    for key in ("step", "loss", "count"):
        assert [row[key] for row in resumed.history] == [row[key] for row in whole.history]
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_an_antialiased_cloud_is_trained_as_it_is_drawn(tmp_path):
    cloud = blobs().replace(scales=0.05 * blobs().scales, antialiased=True)  # smaller than a pixel
    cameras = [look_at_origin(0.5 * i) for i in range(2)]
    targets = [rasterize(cloud, camera).map for camera in cameras]
    config = changed(SHORT, steps=2, report_every=1, start=2)
    path = tmp_path / "fit.pt"
    fit = fit_field(cloud, cameras, targets, config, checkpoint=path)
    assert fit.history[0]["loss"] < 1e-6  # it draws what it began as
    assert fit.gaussians.antialiased
    assert fit_field(cloud, cameras, targets, config, checkpoint=path).gaussians.antialiased  # as the file has it


def test_a_checkpoint_of_another_fit_is_refused(tmp_path):
    cameras, targets = scene(3)
    path = tmp_path / "fit.pt"
    short = changed(SHORT, steps=5)
    fit_field(start(), cameras, targets, short, checkpoint=path)
    same = {"gaussians": start(), "cameras": cameras, "targets": targets, "training": short}
    for other in (
        {"training": changed(short, features_rate=0.1)},
        {"cameras": cameras[:2], "targets": targets[:2]},
        {"cameras": [replace(camera, near=0.1) for camera in cameras]},
        {"targets": [target + 1 for target in targets]},
        {"gaussians": start(61)},
        {"gaussians": start().replace(antialiased=True)},
        {"loss": lambda rendered, alpha, target: rendered.mean()},
        {"generator": torch.Generator().manual_seed(9)},
    ):
        with pytest.raises(ValueError, match=tells("checkpoint:", "this very fit", "delete")):
            fit_field(**(same | other), checkpoint=path)
    how_often = changed(short, checkpoint_every=2)  # changes no result
    assert len(fit_field(start(), cameras, targets, how_often, checkpoint=path).history) == 1


def test_a_folder_that_is_deleted_meanwhile_is_noticed_at_the_next_checkpoint(tmp_path):
    cameras, targets = scene()
    path, steps = tmp_path / "run" / "unfinished" / "field.kfgs", []

    def watch(row):
        steps.append(row["step"])
        if row["step"] == 30:
            assert path.is_file()
            shutil.rmtree(tmp_path / "run")

    with pytest.raises(FileNotFoundError, match=tells(path.parent, "this folder to stay", "start again")):
        fit_field(start(), cameras, targets, SHORT, checkpoint=path, progress=watch)
    assert steps[-1] == 40
    assert not (tmp_path / "run").exists()


def test_a_damaged_or_foreign_checkpoint_is_refused(tmp_path):
    from safetensors.torch import save_file

    cameras, targets = scene(2)
    damaged, foreign = tmp_path / "damaged", tmp_path / "foreign"
    damaged.write_bytes(b"nothing of the kind")
    save_file({"x": torch.zeros(2)}, foreign)
    with pytest.raises(ValueError, match=tells("damaged: expected a checkpoint of kfgs", "delete it")):
        fit_field(start(), cameras, targets, SHORT, checkpoint=damaged)
    with pytest.raises(ValueError, match=tells("foreign: expected a checkpoint of kfgs", "delete it")):
        fit_field(start(), cameras, targets, SHORT, checkpoint=foreign)


def test_render_scale_sets_the_rendered_size_and_never_exceeds_the_camera():
    cameras, targets = scene(2)
    small = [resize_map(target, (6, 8)) for target in targets]
    sizes = set()

    def recorded(rendered, alpha, target):
        sizes.add((tuple(rendered.shape), tuple(alpha.shape), tuple(target.shape)))
        return l1_loss(rendered, alpha, target)

    for scale in (None, 2.0, 100.0):
        config = changed(SHORT, steps=2, render_scale=scale)
        fit_field(start(), cameras, small, config, loss=recorded)
    assert sizes == {((24, 32, 3), (24, 32), (6, 8, 3)), ((12, 16, 3), (12, 16), (6, 8, 3))}


def test_opacities_are_reset_on_schedule():
    cameras, targets = scene(2)
    config = changed(SHORT, steps=10, reset_every=10, start=20)
    fit = fit_field(start(), cameras, targets, config)
    assert fit.gaussians.opacities.max() <= 0.01 + 1e-6
    assert fit_field(start(), cameras, targets, changed(config, reset_every=0)).gaussians.opacities.max() > 0.05


def test_a_view_without_gaussians_teaches_nothing_and_breaks_nothing():
    away = look_at_origin(0.0)
    away.viewmat[2, 3] = -40.0  # everything lies behind it
    target = torch.ones(24, 32, CHANNELS)
    config = changed(SHORT, steps=3, start=50)
    fit = fit_field(start(), [away], [target], config)
    torch.testing.assert_close(fit.gaussians.tensors(), start().tensors())
    assert fit.history[-1]["loss"] == pytest.approx(1.0)


def test_l1_loss_is_the_mean_over_pixels_and_channels_after_the_resize():
    rendered = torch.tensor([[[0.0, 8.0], [2.0, 8.0]], [[4.0, 8.0], [6.0, 8.0]]])  # means 3 and 8
    loss = l1_loss(rendered, torch.ones(2, 2), torch.tensor([[[1.0, 9.0]]]))
    assert float(loss) == pytest.approx((2.0 + 1.0) / 2)


def test_unknown_pixels_count_nowhere():
    rendered = torch.rand(4, 6, 2, generator=torch.Generator().manual_seed(0), requires_grad=True)
    target = torch.rand(4, 6, 2, generator=torch.Generator().manual_seed(1))
    holes = target.clone()
    holes[:2] = torch.nan
    loss = l1_loss(rendered, torch.ones(4, 6), holes)
    assert float(loss.detach()) == pytest.approx(float((rendered - target)[2:].abs().mean().detach()))
    loss.backward()
    assert not rendered.grad[:2].any()
    torch.testing.assert_close(rendered.grad[2:].abs(), torch.full((2, 6, 2), 1 / 24))
    assert float(l1_loss(rendered, torch.ones(4, 6), holes * torch.nan).detach()) == 0.0


def one_place(gaussians):
    return gaussians.replace(means=look_at_origin(0.0).center.repeat(len(gaussians), 1))


BENT = replace(look_at_origin(0.0), distortion=Distortion("brown_conrady", (0.1, 0.0, 0.0, 0.0)))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"targets": []}, ValueError, ("targets:", "got 0")),
        ({"gaussians": start(channels=5)}, ValueError, ("targets[", "[h, w, D]", "D = 5", "got (24, 32, 3)")),
        ({"gaussians": start()[:0]}, ValueError, ("gaussians:", "got Gaussians(0 Gaussians")),
        ({"cameras": [BENT]}, ValueError, ("camera:", "got brown_conrady")),
        ({"targets": [torch.full((24, 32, 3), torch.inf)]}, FloatingPointError, ("loss:", "step 1", "got inf")),
        ({"training": changed(SHORT, prune_opacity=0.9)}, ValueError, ("training:", "got none", "step 10")),
        (
            {"gaussians": one_place(start(2)), "training": changed(SHORT, extent=None)}, ValueError,
            ("cameras", "extent of 0", "Training(extent=...)"),
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_trained_is_named(change, error, message):
    cameras, targets = scene(1)
    fitting = {"gaussians": start(), "cameras": cameras, "targets": targets, "training": SHORT}
    refused(lambda: fit_field(**(fitting | change)), *message, error=error)


def test_defaults_are_the_published_values():
    training = Training()
    assert (training.steps, training.render_scale, training.sh_degree_every) == (30_000, None, 1_000)
    rates = training.rates
    assert (rates.features, rates.means, rates.means_final) == (0.005, 1.6e-4, 1.6e-6)
    others = rates.opacities, rates.scales, rates.quats, rates.sh0, rates.sh_rest
    assert others == (0.05, 0.005, 0.001, 0.0025, 0.000125)
    densify = training.densify
    assert (densify.start, densify.stop, densify.every, densify.reset_every) == (500, 15_000, 100, 3_000)
    assert (densify.gradient, densify.percent_dense, densify.prune_opacity) == (2e-4, 0.01, 0.005)


def test_with_steps_keeps_the_schedule_in_proportion():
    short = Training(half_until=6_000).with_steps(3_000)
    assert (short.steps, short.half_until, short.sh_degree_every) == (3_000, 600, 100)
    assert (short.densify.start, short.densify.stop, short.densify.reset_every) == (50, 1_500, 300)
    assert (short.densify.every, short.rates) == (100, Rates())
    assert Training(densify=None).with_steps(5).densify is None
    assert Training.cpu().steps <= 5_000


def test_a_limit_of_gaussians():
    assert Training().with_maximum(7).densify == Densify(maximum=7)
    assert Training.cpu().with_maximum(None) == Training.cpu()
    assert Training.cpu().with_maximum(0).densify.maximum is None


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        (Training, {"steps": 0}, ("steps:", "got 0")),
        (Training, {"steps": 2.5}, ("steps:", "got 2.5")),
        (Training, {"extent": 0.0}, ("extent:", "got 0.0")),
        (Training, {"render_scale": 0.0}, ("render_scale:", "got 0.0")),
        (Training, {"half_until": 10, "render_scale": 2.0}, ("half_until:", "0", "render_scale = 2.0")),
        (Training, {"sh_degree_every": -1}, ("sh_degree_every:", "got -1")),
        (Densify, {"reset_every": -1}, ("reset_every:", "got -1")),
        (Densify, {"maximum": 0}, ("maximum:", "got 0")),
        (Rates, {"means": 0.0}, ("means:", "got 0.0")),
        (Rates, {"features": -1.0}, ("features:", "got -1.0")),
    ],
)
def test_wrong_values(kind, change, message):
    refused(lambda: kind(**change), *message)
