import numpy as np
import pytest
import torch
from cases_ksplat import BLOCK, C0, CENTRES, QUANTUM, ROWS, SH, ksplat_file, ksplat_section
from messages import refused

from kfgs.formats import read_splats
from kfgs.formats.ksplat import read


@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("level", [0, 1, 2])
def test_every_level_and_degree_by_hand(tmp_path, level, degree):
    sections = [ksplat_section(level, [0, 1], degree, 1, [1]), ksplat_section(level, [2], 0, 0, [1])]
    (tmp_path / "a.ksplat").write_bytes(ksplat_file(level, sections, 3))
    splats = read(tmp_path / "a.ksplat")
    g = splats
    np.testing.assert_allclose(g.means, [row[0] for row in ROWS], atol=0 if level == 0 else BLOCK / 4 / QUANTUM + 1e-6)
    np.testing.assert_array_equal(g.scales, [row[1] for row in ROWS])
    np.testing.assert_allclose(g.quats, [row[2] for row in ROWS])
    np.testing.assert_allclose(0.5 + C0 * g.sh[:, 0], np.array([row[3][:3] for row in ROWS]) / 255, atol=1e-6)
    np.testing.assert_allclose(g.opacities, [row[3][3] / 255 for row in ROWS])
    assert g.sh.shape == (3, (degree + 1) ** 2, 3)
    within = 0.5 * 3 / 255 + 1e-6 if level == 2 else 1e-3
    for band, first in ((1, 0), (2, 9)):
        if degree >= band:
            size = 2 * band + 1
            stored = SH[first : first + 3 * size].reshape(3, size)  # channel, then coefficient
            np.testing.assert_allclose(g.sh[1, band**2 : (band + 1) ** 2], stored.T, atol=within)
    assert not g.sh[2, 1:].any()  # the section of degree 0


def test_empty_sections_say_nothing(tmp_path):
    sections = [
        ksplat_section(1, [], 0, 0, [], sh_degree=2),
        ksplat_section(1, [0, 2, 1], 1, 0, [1, 2], capacity=3, buckets=2),
    ]
    (tmp_path / "a.ksplat").write_bytes(ksplat_file(1, sections, 3))
    g = read(tmp_path / "a.ksplat")
    assert g.sh.shape == (3, 4, 3)
    np.testing.assert_allclose(g.means[:2], [ROWS[0][0], ROWS[2][0]], atol=1e-4)
    shifted = np.array(ROWS[1][0]) - CENTRES[1] + CENTRES[2]  # the third one lies in the bucket of the second
    np.testing.assert_allclose(g.means[2], shifted, atol=1e-4)


def test_the_fixture_is_the_scene_of_the_splat_file(shared_data):
    ours = read_splats(shared_data / "splats" / "minimal.ksplat")
    other = read_splats(shared_data / "splats" / "minimal.splat")
    for name in ("means", "quats", "scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(ours, name), getattr(other, name), rtol=0, atol=1e-6)


_S = ksplat_section(1, [0, 1], 1, 1, [1])
_NAN = bytearray(ksplat_file(0, [ksplat_section(0, [0], 0, 1, [])], 1))
_NAN[-44:-40] = np.float32(np.nan).tobytes()
BAD = {
    "short": bytes(100),
    "version": ksplat_file(1, [_S], 2, major=1),
    "minor": ksplat_file(1, [_S], 2, minor=0),
    "level": ksplat_file(7, [_S], 2),
    "sections": ksplat_file(1, [_S], 2, most=4_000_000_000),
    "count": ksplat_file(1, [_S], 5),
    "none": ksplat_file(1, [], 0),
    "capacity": ksplat_file(1, [ksplat_section(1, [0], 0, 1, [], capacity=4_000_000_000)], 1),
    "size": ksplat_file(1, [ksplat_section(1, [0], 0, 1, [], size=9)], 1),
    "degree": ksplat_file(1, [ksplat_section(1, [0], 0, 1, [], sh_degree=77)], 1),
    "buckets": ksplat_file(1, [ksplat_section(1, [0, 1], 0, 2, [], buckets=1, bucket=7)], 2),
    "full": ksplat_file(1, [ksplat_section(1, [0, 1], 0, 1, [0])], 2),
    "bytes": ksplat_file(1, [ksplat_section(1, [0], 0, 1, [], bytes=11)], 1),
    "cut": ksplat_file(1, [_S], 2)[:-1],
    "more": ksplat_file(1, [_S], 2) + b"x",
    "nan": bytes(_NAN),
    "wide block": ksplat_file(1, [ksplat_section(1, [0], 0, 1, [], block=3e38, quantum=1)], 1),
    "block": ksplat_file(1, [ksplat_section(1, [0], 0, 1, [], block=float("nan"))], 1),
}


@pytest.mark.parametrize("case", BAD)
def test_damage_is_named(tmp_path, case):
    (tmp_path / "bad.ksplat").write_bytes(BAD[case])
    refused(lambda: read_splats(tmp_path / "bad.ksplat"), "bad.ksplat: expected")
