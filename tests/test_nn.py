"""The modules of kfgs.nn give the numbers of the functions behind them, and their gradients."""

from dataclasses import replace

import pytest
import torch
from cases_splat import a_camera, gaussians_before
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.liegroup import Se3
from messages import refused
from torch.func import functional_call

from kfgs.cameras import to_kornia
from kfgs.nn import GaussianRenderer, LatentAutoencoder, VectorQuantizer
from kfgs.quant import Autoencoder, Codebook
from kfgs.splat import rasterize

CAMERAS = [a_camera(), replace(a_camera(principal=(12.0, 9.5)), near=0.3)]
CLOUD = gaussians_before(CAMERAS[0], 10, seed=1)
NAMES = ("means", "quats", "scales", "opacities", "features")
FEATURES = torch.randn(2, 6, 3, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
BOOK = Codebook(torch.randn(5, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64))


@pytest.fixture
def coder():
    torch.manual_seed(0)
    made = Autoencoder((6, 8, 3), (3, 8, 6)).double().requires_grad_(False)
    made.range.copy_(torch.tensor([-1.5, 1.5]))
    return made


def test_the_renderer_is_rasterize_of_each_camera_in_kornias_layout():
    renderer = GaussianRenderer(background=torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64))
    for views in (renderer(CLOUD, CAMERAS), renderer(CLOUD, to_kornia(CAMERAS))):
        assert views.map.shape == (2, 3, 18, 24)
        for i, camera in enumerate(CAMERAS):
            expected = rasterize(CLOUD, camera, background=renderer.background)
            torch.testing.assert_close(views.map[i].permute(1, 2, 0), expected.map)
            torch.testing.assert_close((views.alpha[i, 0], views.depth[i, 0]), (expected.alpha, expected.depth))
    assert list(renderer.state_dict()) == ["background"]
    deep = float(CLOUD.means[:, 2].median())  # some are in front of it
    cut = GaussianRenderer(near=deep)(CLOUD, CAMERAS)
    assert cut.rendering.map.equal(rasterize(CLOUD, CAMERAS, near=deep).map)
    refused(lambda: GaussianRenderer(engine="fast")(CLOUD, CAMERAS), "engine:", "got 'fast'")
    other = [CAMERAS[0], CAMERAS[1].resized(9, 12)]
    refused(lambda: renderer(CLOUD, other), "cameras: expected one size", "(9, 12)", "resized")
    refused(lambda: renderer(CLOUD, CAMERAS[0].model), "got CameraModel", "from_kornia", error=TypeError)


def test_gradients_of_the_renderer():
    small = [camera.resized(6, 8) for camera in CAMERAS]
    pinhole, leaves = to_kornia(small), [getattr(CLOUD, name).clone().requires_grad_() for name in NAMES]

    def draw(*values):
        return GaussianRenderer()(CLOUD.replace(**dict(zip(NAMES, values, strict=True))), pinhole)[:2]

    def turned(step):  # left of the pose: a turn and a shift in the camera's frame
        poses = (Se3.exp(step) * Se3.from_matrix(pinhole.extrinsics)).matrix()
        return GaussianRenderer()(CLOUD, PinholeCamera(pinhole.intrinsics, poses, pinhole.height, pinhole.width)).map

    assert torch.autograd.gradcheck(draw, leaves)
    assert torch.autograd.gradcheck(turned, torch.zeros(2, 6, dtype=torch.float64, requires_grad=True))


def test_the_quantizer_is_equation_5_with_a_straight_gradient():
    layer, features = VectorQuantizer(BOOK), FEATURES.clone().requires_grad_()
    quantised, indices = layer(features)
    assert indices.equal(BOOK.quantize(FEATURES.movedim(1, -1)))
    assert quantised.equal(layer.decode(indices))
    assert layer.codebook().codewords.equal(BOOK.codewords)
    weights = torch.rand_like(quantised)
    (quantised * weights).sum().backward()
    assert features.grad.equal(weights)
    chosen = layer.codewords.detach().requires_grad_()
    assert torch.autograd.gradcheck(lambda rows: functional_call(layer, {"codewords": rows}, FEATURES).map, chosen)
    refused(lambda: layer(FEATURES[0]), "features: expected [B, 6, H, W]", "got (6, 3, 4)")
    kept, given = layer.codebook(), BOOK.codewords.clone()
    assert layer(FEATURES.float()).indices.equal(indices)  # of another dtype than the codewords
    with torch.no_grad():
        layer.codewords.zero_()
    assert kept.codewords.equal(given)
    assert BOOK.codewords.equal(given)
    layer, features = VectorQuantizer(torch.randn(50, 64)), torch.randn(2, 64, 30, 40)
    with torch.autocast("cpu", dtype=torch.bfloat16):  # changes no codeword
        indices = layer(features).indices
    assert indices.equal(layer(features).indices)


def test_the_autoencoder_over_maps_has_all_gradients_and_comes_back(coder):
    layer = LatentAutoencoder(coder)
    rows = FEATURES.movedim(1, -1)
    assert layer.encode(FEATURES).movedim(1, -1).equal(coder.encode(rows))
    assert layer(FEATURES).movedim(1, -1).equal(coder.decode(coder.encode(rows)))
    names, weights = zip(*layer.named_parameters(), strict=True)
    call = lambda x, *values: functional_call(layer, dict(zip(names, values, strict=True)), x)  # noqa: E731
    assert torch.autograd.gradcheck(call, (FEATURES[:1, :, :2].clone().requires_grad_(), *weights))
    layer.load_state_dict({name: 0.9 * value for name, value in layer.state_dict().items()})
    back = layer.autoencoder()
    assert not any(weight.requires_grad for weight in back.parameters())
    assert all(weight.requires_grad for weight in layer.parameters())
    assert back.encode(rows).equal(layer.encode(FEATURES).movedim(1, -1))
    assert not back.encode(rows).equal(coder.encode(rows))  # the one it began with is as it was
    refused(lambda: layer.decode(FEATURES), "latents: expected [B, 3, H, W]", "got (2, 6, 3, 4)")


def test_all_of_them_compile(coder):
    draw, quantise, code = GaussianRenderer(), VectorQuantizer(BOOK), LatentAutoencoder(coder)

    def network(features, pinhole):
        seen = draw(CLOUD, pinhole).map.mean()
        return seen * code(quantise(features).map)

    leaf = FEATURES.clone().requires_grad_()
    results = [call(leaf, to_kornia(CAMERAS)) for call in (network, torch.compile(network, backend="aot_eager"))]
    torch.testing.assert_close(*results)
    torch.testing.assert_close(*(torch.autograd.grad(result.sin().sum(), leaf)[0] for result in results))
