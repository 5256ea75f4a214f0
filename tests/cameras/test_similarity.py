import numpy as np
import pytest
import torch
from messages import refused
from scipy.spatial.transform import Rotation

from kfgs.cameras import Camera, Similarity
from kfgs.cameras.projection import world_to_camera

QUARTER = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # x to y
MIRROR = torch.diag(torch.tensor([1.0, 1.0, -1.0]))


def a_similarity(seed=0):
    rng = np.random.default_rng(seed)
    R = torch.from_numpy(Rotation.random(random_state=seed).as_matrix())
    return Similarity(float(np.exp(rng.normal())), R, torch.from_numpy(rng.normal(size=3) * 5))


def cloud(N=40, seed=0):
    return torch.randn(N, 3, generator=torch.Generator().manual_seed(seed)).double() * torch.tensor([4.0, 2.0, 1.0])


def close(a, b, **tolerance):
    torch.testing.assert_close(a.matrix(), b.matrix(), **tolerance)


def test_quarter_turn_twice_the_size_one_up():
    similarity = Similarity(2.0, QUARTER, torch.tensor([0.0, 0.0, 1.0]))
    assert similarity.apply(torch.tensor([[1.0, 0.0, 0.0], [0.0, 3.0, 5.0]])).tolist() == [[0, 2, 1], [-6, 0, 11]]
    assert similarity.matrix().tolist() == [[0, -2, 0, 0], [2, 0, 0, 0], [0, 0, 2, 1], [0, 0, 0, 1]]


@pytest.mark.parametrize("seed", range(3))
def test_group_laws(seed):
    a, points = a_similarity(seed), cloud()
    torch.testing.assert_close(a.inverse().apply(a.apply(points)), points)
    torch.testing.assert_close(Similarity.identity().apply(points), points)
    close(Similarity.from_matrix(a.matrix()), a)


def test_rounded_rotation_becomes_exact():
    R = torch.tensor(Rotation.random(random_state=3).as_matrix().round(5))
    a = Similarity(1.0, R, torch.zeros(3))
    torch.testing.assert_close(a.rotation @ a.rotation.T, torch.eye(3).double(), atol=1e-14, rtol=0)
    assert (a.rotation - R).abs().max() < 1e-5


def test_moved_camera_sees_moved_points_at_the_same_place():
    a, points = a_similarity(5), cloud() + torch.tensor([0.0, 0.0, 10.0])
    viewmat = torch.eye(4).double()
    viewmat[:3, :3], viewmat[:3, 3] = a_similarity(6).rotation, torch.tensor([0.3, -0.2, 1.0])
    K = torch.tensor([[50.0, 0, 20], [0, 45, 15], [0, 0, 1]]).double()
    camera = Camera(viewmat, K, 40, 30, name="front")
    moved = a.apply_to_camera(camera)
    expected = a.scale * world_to_camera(camera, points)
    torch.testing.assert_close(world_to_camera(moved, a.apply(points)), expected)
    torch.testing.assert_close(moved.center, a.apply(camera.center[None])[0])
    assert (moved.name, moved.size, moved.K.tolist()) == ("front", (30, 40), K.tolist())


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Similarity(0.0, QUARTER, torch.zeros(3)), ("scale:", "got 0.0")),
        (lambda: Similarity(1.0, 2 * QUARTER, torch.zeros(3)), ("rotation:", "divide")),
        (lambda: Similarity(1.0, QUARTER * torch.nan, torch.zeros(3)), ("rotation:", "rotation", "got [[nan")),
        (lambda: Similarity(1.0, MIRROR, torch.zeros(3)), ("rotation:", "reflection")),
        (lambda: Similarity(1.0, QUARTER, torch.full((3,), torch.inf)), ("translation:", "got [inf, inf, inf]")),
        (lambda: Similarity(1.0, QUARTER, torch.zeros(4)), ("translation:", "[3]", "got (4,)")),
        (lambda: Similarity.from_matrix(torch.ones(4, 4)), ("matrix:", "0 0 0 1")),
        (lambda: Similarity.from_matrix(torch.block_diag(2 * MIRROR, torch.ones(1, 1))), ("matrix:", "determinant -8")),
        (lambda: Similarity.from_matrix(torch.tensor([1.0, 2, 3, 1]).diag()), ("matrix:", "rotation", "got [[")),
        (lambda: Similarity.identity().apply(torch.zeros(2, 4)), ("points:", "[N, 3]", "got (2, 4)")),
    ],
)
def test_wrong_input_is_named(build, message):
    refused(build, *message)


def test_a_matrix_inverted_in_float32_is_read():
    matrix = a_similarity(2).matrix()
    rounded = matrix.clone()
    rounded[3] = torch.tensor([1e-8, -2e-7, 0, 1.0000001])
    close(Similarity.from_matrix(rounded), Similarity.from_matrix(matrix))
    for row in ([0, 0, 0, 1.001], [0, 1e-3, 0, 1], [0, 0, torch.nan, 1]):
        rounded[3] = torch.tensor(row)
        refused(lambda: Similarity.from_matrix(rounded), "matrix:", "0 0 0 1")
