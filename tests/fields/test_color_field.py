"""Colours through the same `fit_field`: harmonics on schedule, small pictures first, checkpoints to the bit."""

import pytest
import torch
from cases_training import SHORT as BASE
from cases_training import blobs, changed, look_at_origin, same
from cases_training import scene as scene_of
from messages import tells

from kfgs import rasterize
from kfgs.fields import ColorLoss, fit_field, gaussians_from_points
from kfgs.fields.optimizer import to_gaussians, to_raw

SHORT = changed(BASE, sh0_rate=0.05, sh_rest_rate=0.01, sh_degree_every=20, half_until=25, reset_every=30)
BLOBS = blobs(14, colors=True)
DEGREES = (slice(0, 3), slice(3, 8), slice(8, 15))  # of the higher harmonics


def scene(views=5):
    return scene_of(views, BLOBS)


def start(n=60, sh_degree=2):
    g = torch.Generator().manual_seed(7)
    points = torch.rand(n, 3, generator=g) * 2.4 - 1.2
    return gaussians_from_points(points, colors=torch.rand(n, 3, generator=g), sh_degree=sh_degree)


def test_colours_that_change_with_the_view_are_recovered():
    cameras, targets = scene()
    config = changed(
        SHORT,
        steps=200,
        means_rate=5e-3,
        quats_rate=0.01,
        scales_rate=0.02,
        sh0_rate=0.03,
        stop=120,
        every=20,
        gradient=2e-3,
        reset_every=0,
        half_until=40,
        sh_degree_every=40,
    )

    def error(gaussians):
        camera = look_at_origin(0.75)
        return float((rasterize(gaussians, camera).map - rasterize(BLOBS, camera).map.clamp(0, 1)).abs().mean())

    fits = [
        fit_field(start(sh_degree=degree), cameras, targets, config, loss=ColorLoss()).gaussians for degree in (0, 2)
    ]
    level = sum(float(target.mean()) for target in targets) / len(targets)
    assert error(fits[1]) < 0.15 * level
    assert error(fits[1]) < 0.9 * error(fits[0])  # one colour per Gaussian is not enough
    assert len(fits[1]) > 60


def test_pictures_are_small_at_first():
    cameras, targets = scene(2)
    sizes = []

    def recorded(rendered, alpha, target):
        sizes.append((tuple(rendered.shape), tuple(target.shape)))
        return ColorLoss()(rendered, alpha, target)

    config = changed(SHORT, steps=4, half_until=3)
    fit_field(start(), cameras, targets, config, loss=recorded)
    expected = [(12, 16, 3)] * 3 + [(24, 32, 3)]
    assert sizes == [(size, size) for size in expected]


def shiny(n=14, degree=3, filled=3):
    """A splat of harmonics up to a degree, of which those above `filled` are 0."""
    sh = torch.zeros(n, (degree + 1) ** 2, 3)
    sh[:, : (filled + 1) ** 2] = torch.randn(n, (filled + 1) ** 2, 3, generator=torch.Generator().manual_seed(5)) * 0.3
    gaussians = blobs(n, colors=True).replace(sh=sh)
    return to_gaussians(to_raw(gaussians), gaussians)  # so that training starts with the same bits


def test_a_perfect_splat_stays_perfect():
    """Its own renderings leave nothing to learn, as long as all its harmonics are used from the first step."""
    begin, cameras = shiny(), [look_at_origin(0.5 * i) for i in range(3)]
    targets = [rasterize(begin, camera).map for camera in cameras]
    config = changed(SHORT, steps=30, sh_degree_every=1_000, half_until=0, start=100, reset_every=0)
    fit = fit_field(begin, cameras, targets, config, loss=ColorLoss(0.0))
    assert [row["loss"] for row in fit.history] == [0.0, 0.0, 0.0]
    assert same(fit.gaussians, begin)
    without = [rasterize(begin.replace(sh=begin.sh[:, :1]), camera).map for camera in cameras]
    assert min(float((a - b).abs().mean()) for a, b in zip(targets, without, strict=True)) > 0.01


def test_degrees_start_where_the_splat_is_and_go_on():
    cameras, targets = scene(3)
    begin, moved = shiny(filled=1), []
    for steps in (19, 20, 39, 40):
        config = changed(SHORT, steps=steps, start=100, half_until=0)
        rest = fit_field(begin, cameras, targets, config).gaussians.sh[:, 1:]
        moved.append([not torch.equal(rest[:, part], begin.sh[:, 1:][:, part]) for part in DEGREES])
    assert moved == [[True, False, False], [True, True, False], [True, True, False], [True, True, True]]


@pytest.mark.parametrize("stop_at", [10, 30])
def test_a_resumed_fit_of_a_splat_uses_the_same_degrees(tmp_path, stop_at):
    """At step 20 training has filled degree 2, which must not count as the start's."""
    cameras, targets = scene(3)
    begin, path = shiny(filled=1), tmp_path / "fit.safetensors"
    config = changed(SHORT, steps=40, checkpoint_every=5)
    whole = fit_field(begin, cameras, targets, config)

    def interrupt(row):
        if row["step"] == stop_at:
            raise StopIteration

    with pytest.raises(StopIteration):
        fit_field(begin, cameras, targets, config, progress=interrupt, checkpoint=path)
    assert same(fit_field(begin, cameras, targets, config, checkpoint=path).gaussians, whole.gaussians)


def test_small_pictures_must_have_the_cameras_size():
    cameras, targets = scene(2)
    with pytest.raises(ValueError, match=tells("targets[", "(24, 32)", "got (12, 16)")):
        fit_field(start(), cameras, [target[::2, ::2] for target in targets], SHORT)
