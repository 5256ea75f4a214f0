"""SAM's image encoder, from a tiny checkpoint in the layout of the published ones."""

import pytest
import torch
from kornia.models.sam import Sam, SamConfig
from messages import refused

from kfgs.teachers.protocol import Teacher, identify
from kfgs.teachers.sam import load_sam

CONFIG = SamConfig(
    encoder_embed_dim=16, encoder_depth=3, encoder_num_heads=2, encoder_global_attn_indexes=(1,)
)  # blocks 0 and 2 look at windows


@pytest.fixture(scope="module")
def sam():
    torch.manual_seed(0)
    model = Sam.from_config(CONFIG).eval()
    with torch.no_grad():
        for parameter in model.image_encoder.parameters():  # positions are zero when they are drawn
            parameter.add_(0.05 * torch.randn_like(parameter))
    return model


@pytest.fixture(scope="module")
def file(sam, tmp_path_factory):
    path = tmp_path_factory.mktemp("sam") / "sam_vit_tiny.pth"
    torch.save(sam.state_dict(), path)
    return path


@pytest.fixture(scope="module")
def teacher(file):
    return load_sam(file)


def test_map_of_a_wide_picture_loses_the_rows_of_the_padding(teacher, sam):
    image = torch.rand(3, 600, 1024)  # as wide as SAM wants it: no resampling
    mean = torch.tensor([123.675, 116.28, 103.53])[:, None, None]
    std = torch.tensor([58.395, 57.12, 57.375])[:, None, None]
    square = torch.zeros(1, 3, 1024, 1024)
    square[0, :, :600] = (image * 255 - mean) / std
    with torch.no_grad():
        expected = sam.image_encoder(square)[0, :, : int(64 / 1024 * 600 + 0.5)]  # as Feature 3DGS cuts it
    got = teacher.encode_image(image)
    assert got.shape == (256, 38, 64)
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-4)


def test_it_is_a_teacher_without_text(teacher, file):
    assert isinstance(teacher, Teacher)
    assert teacher.to("cpu") is teacher
    assert identify(teacher) == identify(load_sam(file))
    assert identify(teacher)["name"] == "sam"
    assert len(identify(teacher)["weights"]) == 64
    refused(lambda: teacher.encode_text(["wall"]), "teacher 'sam':", "text encoder", error=NotImplementedError)


def test_mobile_sam_is_recognised(tmp_path):
    torch.manual_seed(1)
    model = Sam.from_config(SamConfig("mobile_sam")).eval()
    path = tmp_path / "mobile_sam.pt"
    torch.save(model.state_dict(), path)
    teacher = load_sam(path)
    for of in ("named_parameters", "named_buffers"):  # buffers hold a table of indices that the file does not
        got, expected = dict(getattr(teacher.encoder, of)()), dict(getattr(model.image_encoder, of)())
        assert got.keys() == expected.keys()
        assert all(torch.equal(got[name], expected[name]) for name in got)


def test_other_checkpoints_are_named(sam, tmp_path):
    path = tmp_path / "other.pth"
    torch.save({"visual.proj": torch.zeros(2)}, path)
    refused(lambda: load_sam(path), "other.pth:", "Segment Anything", "got none")
    torch.save({"image_encoder.trunk.pos_embed": torch.zeros(2)}, path)
    refused(lambda: load_sam(path), "other.pth:", "'patch_embed.proj.weight'")
    state = {**sam.state_dict(), "image_encoder.neck.0.weight": torch.zeros(256, 17, 1, 1)}
    torch.save(state, path)
    refused(lambda: load_sam(path), "other.pth:", "neck.0.weight", "[256, 17, 1, 1]", "[256, 16")
    del state["image_encoder.neck.0.weight"]
    torch.save({**state, "image_encoder.more": torch.zeros(1)}, path)
    refused(lambda: load_sam(path), "other.pth:", "Missing", "neck.0.weight", "more")
    refused(lambda: load_sam(tmp_path / "none.pth"), "none.pth:", "no such file", error=FileNotFoundError)
