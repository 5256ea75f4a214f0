import pytest
import torch
from messages import refused

from kfgs.quant.linear import LinearLatents, fit_linear_latents, principal_directions


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def orthonormal(D, d, seed=0):
    return torch.linalg.qr(random(D, d, seed=seed)).Q


def with_spectrum(*energies, D=6):
    """Rows along the axes whose squares sum to these energies: the eigenvalues of the second moment, exactly."""
    rows = torch.zeros(len(energies), D, dtype=torch.float64)
    for i, energy in enumerate(energies):
        rows[i, i] = energy**0.5
    return rows


def test_decoding_an_encoded_feature_projects_it():
    basis, features = orthonormal(7, 3), random(2, 5, 7, seed=1)
    latents = LinearLatents(basis)
    assert (latents.dim, latents.latent) == (7, 3)
    found = latents.decode(latents.encode(features))
    expected = torch.linalg.lstsq(basis, features.reshape(-1, 7).T).solution.T @ basis.T  # least squares
    torch.testing.assert_close(found.reshape(-1, 7), expected)
    torch.testing.assert_close(latents.encode(found), latents.encode(features))  # projecting twice changes nothing


def test_cosines_are_those_of_the_decoded_features():
    latents, z = LinearLatents(orthonormal(9, 4)), random(5, 4, seed=1)
    rows = torch.nn.functional.normalize(random(3, 9, seed=2), dim=1)
    expected = torch.nn.functional.cosine_similarity(latents.decode(z)[:, None], rows[None], dim=-1)
    torch.testing.assert_close(latents.cosines(z, rows), expected)
    torch.testing.assert_close(latents.cosines(100 * z, rows), expected)  # only directions count


def test_a_basis_must_be_orthonormal():
    LinearLatents(torch.eye(4, 2))
    skew = torch.eye(4, 2)
    skew[1, 0] = 0.01
    for basis in (2 * torch.eye(4, 2), skew, torch.full((4, 2), torch.nan), torch.zeros(2, 4), torch.zeros(4, 0)):
        refused(lambda basis=basis: LinearLatents(basis), "basis:", "orthonormal", "fit_linear_latents")


def test_principal_directions_of_a_known_moment():
    axes = orthonormal(4, 4)
    energies = torch.tensor([1.0, 9.0, 0.25, 4.0], dtype=torch.float64)
    values, directions = principal_directions((axes * energies) @ axes.T)
    torch.testing.assert_close(values, energies.sort(descending=True).values)
    torch.testing.assert_close((directions.T @ axes).abs(), torch.eye(4, dtype=torch.float64)[[1, 3, 0, 2]])
    largest = directions.gather(0, directions.abs().argmax(dim=0)[None])
    assert (largest > 0).all()  # so the signs do not depend on the library


@pytest.mark.parametrize(
    ("keep", "latents"), [(0.1, 2), (0.49, 2), (0.51, 3), (0.79, 3), (0.81, 4), (0.99, 5), (1.0, 5)]
)
def test_the_fewest_latents_that_keep_the_share_beyond_the_first(keep, latents):
    """Beyond the first direction lie 5 + 3 + 1.8 + 0.2 = 10: shares 0.5, 0.8, 0.98 and 1."""
    rows = with_spectrum(1000, 5, 3, 1.8, 0.2)
    assert fit_linear_latents(rows, keep=keep).latent == latents
    assert fit_linear_latents(rows, keep=keep, maximum=3).latent == min(latents, 3)


def test_latents_are_the_main_directions():
    """By Eckart-Young no projection onto d directions loses less."""
    features = random(50, 6) * torch.tensor([5.0, 3, 2, 1, 0.5, 0.1])
    made = fit_linear_latents(features, maximum=3, keep=1.0)
    lost = (features - made.decode(made.encode(features))).square().sum()
    torch.testing.assert_close(lost, torch.linalg.svdvals(features)[3:].square().sum())


def test_a_weight_is_a_repetition():
    features, times = random(5, 6), torch.tensor([1, 3, 0, 2, 1])
    weighted = fit_linear_latents(features, times.double(), keep=0.9)
    repeated = fit_linear_latents(features.repeat_interleave(times, dim=0), keep=0.9)
    torch.testing.assert_close(weighted.basis, repeated.basis)
    assert not torch.allclose(weighted.basis[:, 0], fit_linear_latents(features).basis[:, 0])


def test_wrong_input_to_the_fit_is_named():
    for features in (torch.zeros(3, 4), torch.full((3, 4), torch.nan)):
        refused(lambda features=features: fit_linear_latents(features), "features:", "finite", "not all of them zero")
