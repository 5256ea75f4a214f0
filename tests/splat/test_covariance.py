import numpy as np
import torch
from messages import refused
from scipy.spatial.transform import Rotation

from kfgs.splat.covariance import covariance_3d


def _random(N=20, seed=0):
    g = torch.Generator().manual_seed(seed)
    return torch.randn(N, 4, generator=g).double(), 0.1 + torch.rand(N, 3, generator=g).double()


def test_quaternion_is_wxyz():
    quats, scales = _random()
    q = quats.numpy()
    right = Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix()  # scipy is xyzw
    wrong = Rotation.from_quat(q).as_matrix()
    S2 = np.array([np.diag(s**2) for s in scales.numpy()])
    ours = covariance_3d(quats, scales).numpy()
    np.testing.assert_allclose(ours, right @ S2 @ right.swapaxes(1, 2), atol=1e-13)
    assert np.abs(ours - wrong @ S2 @ wrong.swapaxes(1, 2)).max() > 0.1


def test_sign_and_length_of_the_quaternion_do_not_matter():
    quats, scales = _random()
    ours = covariance_3d(quats, scales)
    torch.testing.assert_close(covariance_3d(-quats, scales), ours, rtol=0, atol=0)
    torch.testing.assert_close(covariance_3d(3.7 * quats, scales), ours)


def test_zero_quaternion_is_no_rotation():
    ours = covariance_3d(torch.zeros(1, 4), torch.tensor([[1.0, 2.0, 3.0]]))
    torch.testing.assert_close(ours[0], torch.diag(torch.tensor([1.0, 4.0, 9.0])))


def test_shapes_must_agree():
    refused(lambda: covariance_3d(torch.ones(2, 4), torch.ones(3, 3)), "scales:", "[N, 3]", "N = 2", "got (3, 3)")
