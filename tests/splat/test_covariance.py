import numpy as np
import torch
from messages import refused
from scipy.spatial.transform import Rotation

from kfgs.splat.covariance import covariance_3d


def test_quaternion_is_wxyz_of_any_sign_and_length_and_zero_is_no_rotation():
    g = torch.Generator().manual_seed(0)
    quats, scales = torch.randn(20, 4, generator=g).double(), 0.1 + torch.rand(20, 3, generator=g).double()
    right = Rotation.from_quat(quats.numpy()[:, [1, 2, 3, 0]]).as_matrix()  # scipy is xyzw
    S2 = torch.diag_embed(scales**2)
    np.testing.assert_allclose(covariance_3d(quats, scales), right @ S2.numpy() @ right.swapaxes(1, 2), atol=1e-13)
    torch.testing.assert_close(covariance_3d(-3.7 * quats, scales), covariance_3d(quats, scales))
    torch.testing.assert_close(covariance_3d(0 * quats, scales), S2)
    refused(lambda: covariance_3d(torch.ones(2, 4), torch.ones(3, 3)), "scales:", "[N, 3]", "N = 2", "got (3, 3)")
