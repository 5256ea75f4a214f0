import numpy as np
import pytest
import torch
import torch.nn.functional as F
from cases_quant import made_autoencoder
from messages import refused

from kfgs import Camera, Gaussians
from kfgs.evaluation import FieldMethod, Method, TeacherMethod, View, label_view
from kfgs.evaluation.method import Labeller, best_labels
from kfgs.fields import Autoencoded, Codewords, Identity, Linear, SemanticField
from kfgs.quant import Codebook
from kfgs.scenes import FeatureFolder, save_feature_map

DIM = 6
ROWS = torch.nn.functional.normalize(
    torch.tensor([[1.0, 0, 0, 0.5, 0, 0], [0, 1, 0, 0, 0, 0], [0, 1, 1, 0, 0, 0.2]]), dim=1
)
VIEW = View("a", Camera(torch.eye(4), torch.tensor([[40.0, 0, 20], [0, 40, 8], [0, 0, 1]]), 40, 16))


def _field(mode: str, size: float = 0.1) -> SemanticField:
    """Three balls side by side with the features e0, e1, e2 at columns 10, 20, 30; the last ball of four knows nothing."""
    features = torch.cat([torch.eye(3, DIM) * torch.tensor([[1.0], [2.0], [0.5]]), torch.zeros(1, DIM)])
    decoder = Identity(DIM)
    if mode == "fused":
        decoder, features = Linear(torch.eye(DIM, 4)), features[:, :4]
    if mode in ("codebook", "autoencoder"):
        decoder = Codewords(Codebook(torch.eye(3, DIM) * 3))
    if mode == "autoencoder":
        out = torch.eye(DIM, 4) * torch.tensor([3.0, 1, 1, 1]), torch.zeros(DIM)  # mixed latents decode towards e0
        layers = ((torch.eye(4, DIM), torch.zeros(4)),), (out, (torch.eye(DIM), torch.zeros(DIM)))
        autoencoder = made_autoencoder(*layers, 0.0, 3.0)
        decoder = Autoencoded(decoder.codebook, autoencoder)
        features = torch.cat([autoencoder.encode(torch.eye(3, DIM) * 3).detach(), torch.zeros(1, 4)])
    means = torch.tensor([[-1.25, 0, 5], [0, 0, 5], [1.25, 0, 5], [50, 0, 5]])
    cloud = Gaussians(means, torch.eye(4)[:1].repeat(4, 1), torch.full((4, 3), size), torch.full((4,), 0.9), features)
    return SemanticField(cloud, decoder)


@pytest.mark.parametrize("mode", ["plain", "fused", "codebook", "autoencoder"])
def test_a_field_answers_with_the_cosines_of_what_is_seen(mode):
    method = FieldMethod(_field(mode))
    assert isinstance(method, Method)
    assert isinstance(method, Labeller)
    found = method.cosines(VIEW, ROWS)
    assert found.shape == (1, 16, 40, 3)
    torch.testing.assert_close(found[0, 8, [10, 20, 30]], ROWS[:, :3].T, atol=1e-5, rtol=0)
    assert found[0, 0].isnan().all()
    alone = method.gaussian_cosines(ROWS)
    torch.testing.assert_close(alone[0, :3], ROWS[:, :3].T, atol=1e-5, rtol=0)
    assert alone[0, 3].isnan().all()


@pytest.mark.parametrize("mode", ["plain", "fused", "autoencoder"])
def test_a_field_labels_pixels_as_segment_does(mode):
    field = _field(mode, 0.5)  # the balls overlap
    assert torch.equal(label_view(FieldMethod(field), VIEW, ROWS), field.segment(VIEW.camera, ROWS))
    printed = field.paper.segment(VIEW.camera, ROWS)
    assert torch.equal(printed, field.segment(VIEW.camera, ROWS)) == (mode == "plain")
    assert torch.equal(label_view(FieldMethod(field, rule="paper"), VIEW, ROWS), printed)
    plain = FieldMethod(field, "x", rule="nearest")
    assert torch.equal(label_view(plain, VIEW, ROWS), best_labels(plain.cosines(VIEW, ROWS)[0]))
    assert plain.name == "x"
    refused(lambda: label_view(plain, VIEW, ROWS, 1), "level: expected 0 to 0", "levels of 'x'", "got 1")


@pytest.mark.parametrize("align_corners", [False, True])
@pytest.mark.parametrize("size", [(5, 7), (3, 4), (16, 40), (1, 1)])
def test_a_teacher_resizes_features_and_not_cosines(size, align_corners):
    features = torch.randn(*size, DIM, generator=torch.Generator().manual_seed(0))
    features[0, 0] = 0
    method = TeacherMethod({"a": features}, align_corners=align_corners)
    whole = F.interpolate(features.permute(2, 0, 1)[None], (16, 40), mode="bilinear", align_corners=align_corners)[0]
    want = F.normalize(whole.permute(1, 2, 0), dim=-1) @ ROWS.T
    found = method.cosines(VIEW, ROWS)[0]
    torch.testing.assert_close(found.nan_to_num(0), want, atol=1e-5, rtol=1e-5)
    assert torch.equal(found.isnan().all(-1), whole.norm(dim=0) == 0)
    assert method.gaussians is None
    assert not isinstance(method, Labeller)


def test_a_teacher_reads_a_folder(tmp_path):
    rng = np.random.default_rng(0)
    values = torch.from_numpy(rng.normal(size=(16, 40, DIM))).float()
    save_feature_map(tmp_path, "a", values)
    found = TeacherMethod(FeatureFolder(tmp_path)).cosines(VIEW, ROWS)[0]
    torch.testing.assert_close(found, F.normalize(values, dim=-1) @ ROWS.T, atol=2e-3, rtol=0)  # half precision
    half = TeacherMethod({"a": values.half()}).cosines(VIEW, ROWS)[0]  # is computed in single precision
    torch.testing.assert_close(half, TeacherMethod({"a": values.half().float()}).cosines(VIEW, ROWS)[0])
    with pytest.raises(TypeError, match="expected one with Gaussians, got the teacher 'teacher'"):
        TeacherMethod({}).gaussian_cosines(ROWS)
    with pytest.raises(KeyError, match="expected a picture that has a map, got 'b'"):
        TeacherMethod(FeatureFolder(tmp_path)).cosines(View("b", VIEW.camera), ROWS)
