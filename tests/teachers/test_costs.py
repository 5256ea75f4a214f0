"""What a teacher costs: closed-form counts against torch's own counter on networks without memory (meta tensors)."""

import json

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from kfgs.teachers.costs import (
    RELEASED,
    SAM_SIZES,
    TeacherCost,
    VitSizes,
    check_weights,
    known_costs,
    lseg_flops,
    sam_flops,
    teacher_cost,
)
from kfgs.teachers.vit_sizes import vit_sizes


def counted(make, *inputs):
    """Operations that torch counts in one forward, and parameters, of a network on the meta device."""
    with torch.device("meta"):
        network = make().eval()
        arguments = [torch.zeros(shape) for shape in inputs]
        with torch.no_grad(), FlopCounterMode(display=False) as counter:
            network(*arguments)
    return counter.get_total_flops(), sum(value.numel() for value in network.parameters())


def vision_network(kind, **sizes):
    transformers = pytest.importorskip("transformers")
    kinds = {
        "clip": (transformers.CLIPVisionConfig, transformers.CLIPVisionModel),
        "dinov2": (transformers.Dinov2Config, transformers.Dinov2Model),
    }
    config, model = kinds[kind]
    return lambda: model(config(**sizes))


@pytest.mark.parametrize("config", [{}, {"width": 32, "depth": 5, "heads": 4, "window": 96, "hooks": (0, 1, 2, 4)}])
def test_lseg_flops_are_torchs_count_to_the_last_one(config):
    from kfgs.teachers.lseg.network import LSegConfig, LSegNetwork

    sizes = LSegConfig(**config)
    flops, parameters = counted(lambda: LSegNetwork(sizes), (1, 3, sizes.window, sizes.window))
    assert lseg_flops(sizes) == flops
    if not config:
        assert flops == pytest.approx(0.80e12, rel=0.01)  # as measured with the authors' network
        cost = teacher_cost("lseg", (480, 640))
        assert cost.parameters_bytes == pytest.approx(4 * parameters, rel=0.02)


def test_lseg_runs_26_times_on_four_by_three_and_once_when_fast():
    cost, fast = teacher_cost("lseg", (480, 640)), teacher_cost("lseg", (480, 640), fast=True)
    assert (cost.map_size, cost.channels, cost.forwards) == ((360, 480), 512, 26)
    assert cost.flops == pytest.approx(20.8e12, rel=0.01)
    assert fast.flops * 26 == pytest.approx(cost.flops)
    assert fast.map_size == cost.map_size  # so the disk is the same
    assert teacher_cost("lseg", (480, 640), size=(180, 240)).map_size == (180, 240)
    assert teacher_cost("lseg", (480, 640), flip=False).forwards == 13


def test_a_smaller_map_of_lseg_takes_less_memory():
    assert teacher_cost("lseg", (480, 640), size=(180, 240)).peak_bytes < teacher_cost("lseg", (480, 640)).peak_bytes


@pytest.mark.parametrize(
    ("kind", "weights", "size"),
    [("clip", "openai/clip-vit-base-patch16", 224), ("clip", "openai/clip-vit-large-patch14-336", 336)],
)
def test_vit_flops_are_torchs_count(kind, weights, size):
    sizes = next(s for p, s in RELEASED[kind].items() if (p == "") == ("base" in weights) and s.patch in (14, 16))
    flops, parameters = counted(
        vision_network(
            kind,
            hidden_size=sizes.width,
            num_hidden_layers=sizes.depth,
            num_attention_heads=sizes.width // 64,
            intermediate_size=sizes.mlp,
            patch_size=sizes.patch,
            image_size=size,
        ),
        (1, 3, size, size),
    )
    cost = teacher_cost(kind, (size, size), weights=weights)
    assert cost.flops == pytest.approx(flops, rel=1e-9)
    assert cost.parameters_bytes == pytest.approx(4 * parameters, rel=0.01)
    assert cost.map_size == (size // sizes.patch,) * 2


def test_a_gated_mlp_has_three_matrices():
    sizes = VitSizes(64, 3, 96, 14, 64, 1, gated=True)
    # transformers makes a gated MLP of 2/3 of the width that mlp_ratio asks for, rounded up to a multiple of 8.
    hidden = (int(64 * 2 * 2 / 3) + 7) // 8 * 8
    make = vision_network(
        "dinov2",
        hidden_size=64,
        num_hidden_layers=3,
        num_attention_heads=4,
        mlp_ratio=2,
        use_swiglu_ffn=True,
        patch_size=14,
        image_size=70,
    )
    flops, _ = counted(make, (1, 3, 70, 70))
    assert VitSizes(64, 3, hidden, 14, 64, 1, gated=True).flops(25) == pytest.approx(flops, rel=1e-9)
    assert sizes.flops(25) > VitSizes(64, 3, 96, 14, 64, 1).flops(25)


@pytest.mark.parametrize("kind", SAM_SIZES)
def test_sam_flops_are_torchs_count(kind):
    from kornia.models.sam import Sam, SamConfig

    flops, parameters = counted(lambda: Sam.from_config(SamConfig(kind)).image_encoder, (1, 3, 1024, 1024))
    assert sam_flops(*SAM_SIZES[kind]) == flops
    cost = teacher_cost("sam", (480, 640), weights=f"sam_{kind}_01ec64.pth")
    assert cost.flops == flops
    assert cost.parameters_bytes == pytest.approx(4 * parameters, rel=0.05)
    assert (cost.map_size, cost.channels) == ((48, 64), 256)


def test_a_map_of_patches_follows_size_and_aspect():
    assert teacher_cost("clip", (479, 639), weights="B-16").map_size == (30, 40)
    assert teacher_cost("dinov2", (480, 640), size=448).map_size == (24, 32)
    assert teacher_cost("clip", (640, 480)).map_size == (40, 30)


@pytest.mark.parametrize(
    ("kind", "weights", "channels"),
    [
        ("clip", None, 512),
        ("clip", "openai/clip-vit-large-patch14", 768),
        ("openclip", "laion/CLIP-ViT-B-16-laion2B-s34B-b88K", 512),
        ("siglip", "google/siglip-so400m-patch14-384", 1152),
        ("siglip2", "google/siglip2-large-patch16-384", 1024),
        ("dinov2", "facebook/dinov2-small", 384),
        ("dinov2", "facebook/dinov2-giant", 1536),
        ("dinov3", "facebook/dinov3-vit7b16-pretrain-lvd1689m", 4096),
        ("tipsv2", "google/tipsv2-l14", 1024),
        ("openclip", "laion/CLIP-ViT-g-14-laion2B-s34B-b88K", 1024),
        ("openclip", "laion/CLIP-ViT-bigG-14-laion2B-39B-b160k", 1280),
        ("openclip", "laion/CLIP-ViT-H-14-laion2B-s32B-b79K", 1024),
        ("openclip", "laion/CLIP-ViT-L-14-laion2B-s32B-b82K", 768),
        ("clip", "/large/huge-patch14/clip-vit-base-patch16", 512),  # only the last part names the model
        ("openclip", "/large/CLIP-ViT-B-32/open_clip_pytorch_model.bin", 512),
        ("siglip", "/models/so400m/siglip-base-patch16-224", 768),
        ("radio", "nvidia/C-RADIOv3-B", 768),
        ("radio", "/data/base-l/C-RADIOv3-H", 1280),
    ],
)
def test_the_name_of_the_weights_tells_the_size(kind, weights, channels):
    cost = teacher_cost(kind, (448, 448), weights=weights)
    assert cost.channels == channels
    assert (cost.assumed is None) == (weights is not None)


def test_clip_of_other_widths_and_patches():
    sizes, assumed = vit_sizes("openclip", "laion/CLIP-ViT-g-14-laion2B-s34B-b88K")
    assert ((sizes.width, sizes.depth, sizes.mlp, sizes.patch), assumed) == ((1408, 40, 6144, 14), False)
    # OpenCLIP's ViT-g-14 has 1.01 G weights in its image tower, its bigG 1.84 G.
    assert sizes.parameters == pytest.approx(1.01e9, rel=0.02)
    assert vit_sizes("openclip", "CLIP-ViT-bigG-14-laion2B")[0].parameters == pytest.approx(1.84e9, rel=0.02)
    assert vit_sizes("openclip", "/x/CLIP-ViT-B-32/open_clip_model.safetensors")[0].patch == 32


def test_a_size_that_nothing_tells_is_called_assumed():
    unknown = teacher_cost("openclip", (448, 448), weights="somebody/clip-vit-tiny-patch14")
    assert unknown.assumed == "12 blocks of 768 channels, patches of 16, since 'clip-vit-tiny-patch14' tells no size"
    assert teacher_cost("dinov2", (448, 448)).assumed.endswith("since no weights are named")
    assert teacher_cost("sam", (448, 448)).assumed == "12 blocks of 768 channels, since no weights are named"
    assert teacher_cost("sam", (448, 448), weights="/vit_h/sam.pth").assumed.endswith("since 'sam.pth' tells no size")
    assert teacher_cost("sam", (448, 448), weights="/vit_h/sam_vit_b_01ec64.pth").assumed is None
    assert teacher_cost("sam", (448, 448), weights="/mobile/sam_vit_b_01ec64.pth").flops is not None
    assert teacher_cost("lseg", (448, 448)).assumed is None  # there is one size


def test_weights_that_loading_would_refuse_are_refused(tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"expected a checkpoint file of teacher 'lseg', got a folder; check its"
    ):
        check_weights("lseg", tmp_path)
    with pytest.raises(
        FileNotFoundError, match=r"teacher 'sam', or one of vit_b, vit_l, vit_h to plan for, got no such f"
    ):
        check_weights("sam", tmp_path / "sam_vit_h.pth")
    with pytest.raises(FileNotFoundError, match=r"expected a folder as save_pretrained .* got a folder without config"):
        check_weights("clip", tmp_path)
    with pytest.raises(FileNotFoundError, match=r"a path where nothing lies; check its name"):
        check_weights("dinov2", tmp_path / "none")
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "dinov2"}))
    with pytest.raises(ValueError, match=r"expected a model of type 'clip' .* load it as teacher 'dinov2'"):
        check_weights("clip", tmp_path)
    check_weights("dinov2", tmp_path)
    (tmp_path / "open_clip_model.safetensors").write_bytes(b"")
    for name, weights in (
        ("lseg", tmp_path / "config.json"),  # a file; what it holds is not looked at
        ("sam", "vit_h"),
        ("clip", "openai/clip-vit-base-patch16"),
        ("openclip", tmp_path),
        ("mine:encode", "w"),
        ("lseg", None),
        ("clip", None),
    ):
        check_weights(name, weights)


def test_a_local_folder_tells_its_own_size(tmp_path):
    vision = {"hidden_size": 96, "num_hidden_layers": 2, "intermediate_size": 200, "patch_size": 8}
    (tmp_path / "config.json").write_text(json.dumps({"vision_config": vision, "projection_dim": 40}))
    cost = teacher_cost("clip", (64, 80), weights=tmp_path)
    assert (cost.channels, cost.map_size) == (40, (8, 10))
    assert cost.flops == VitSizes(96, 2, 200, 8, 40).flops(80)


def test_a_folder_of_another_model_is_refused(tmp_path):
    (tmp_path / "config.json").write_text(json.dumps({"architectures": ["Bert"]}))
    with pytest.raises(ValueError, match=r"config.json: expected hidden_size, .* give the folder of a clip model"):
        teacher_cost("clip", (64, 80), weights=tmp_path)


def test_every_teacher_by_name_has_a_cost():
    from kfgs.teachers.load import teacher_names

    assert set(known_costs()) == set(teacher_names())
    for name in known_costs():
        cost = teacher_cost(name, (480, 640))
        assert cost.flops > 0
        assert cost.peak_bytes > cost.parameters_bytes > 0


def test_a_teacher_of_ones_own_is_unknown_and_mobile_sam_in_part():
    assert teacher_cost("mine:encode", (480, 640)) == TeacherCost("mine:encode", None, None, None, None, None)
    mobile = teacher_cost("sam", (480, 640), weights="mobile_sam.pt")
    assert (mobile.map_size, mobile.flops) == ((48, 64), None)


def test_maps_that_exist_cost_nothing():
    cost = TeacherCost.of_maps("folder", (90, 120, 512))
    assert (cost.map_size, cost.channels, cost.flops, cost.forwards) == ((90, 120), 512, 0, 0)


def test_wrong_names_and_sizes_are_refused():
    with pytest.raises(ValueError, match=r"teacher: expected one of .*lseg.*, got 'lsge'; name one"):
        teacher_cost("lsge", (480, 640))
    with pytest.raises(ValueError, match=r"image_size\[1\]: expected a number in \[1, inf\), got 0"):
        teacher_cost("clip", (480, 0))
