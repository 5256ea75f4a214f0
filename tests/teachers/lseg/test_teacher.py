"""LSeg as a teacher: options, preprocessing, the text tower on demand, messages. A tiny network runs the same code."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from lseg_layout import TINY, random_state
from messages import refused
from torch import Tensor
from torch.nn import functional

from kfgs.teachers.lseg import LSeg, LSegOptions, load_lseg
from kfgs.teachers.lseg.keys import network_from_state, text_from_state
from kfgs.teachers.lseg.windows import scaled_size, window_starts
from kfgs.teachers.protocol import Teacher, identify
from kfgs.teachers.tokenizer import tokenize

STATE = random_state(TINY, torch.Generator().manual_seed(0))


def tiny(options: LSegOptions | None = None, **more) -> LSeg:
    return LSeg(network_from_state(STATE, TINY, source="tiny"), options, **more)


def picture(height: int, width: int) -> Tensor:
    return torch.rand(3, height, width, generator=torch.Generator().manual_seed(height + 7 * width))


@pytest.mark.parametrize(
    ("size", "picture_size", "expected"),
    [
        ("auto", (480, 640), (360, 480)),  # 4:3, as in the paper
        ("auto", (479, 639), (360, 480)),  # and what a resampled picture may lack
        ("auto", (640, 480), (480, 360)),
        ("auto", (1080, 1920), (270, 480)),
        ("auto", (100, 480), (100, 480)),
        ("auto", (1, 5000), (1, 480)),
        ("auto", (3, 960), (2, 480)),  # 1.5 is rounded up
        (None, (1080, 1920), (1080, 1920)),
        ((360, 480), (480, 640), (360, 480)),
        ((360, 480), (1080, 1920), (360, 480)),  # the script's, which squeezes it
        ((360, 480), (640, 480), (640, 480)),  # and leaves what is not wider than 480
    ],
)
def test_size_of_the_map(size, picture_size: tuple[int, int], expected: tuple[int, int]) -> None:
    assert LSegOptions(size=size).map_size(*picture_size) == expected


def test_sizes_windows_and_forwards_of_the_released_script() -> None:
    """360 x 480: 1 + 2 + 4 + 6 = 13 windows, and their mirrors, 26 runs of the network."""
    assert [scaled_size(360, 480, s, 480) for s in LSegOptions().scales] == [
        (293, 390),
        (390, 520),
        (488, 650),
        (683, 910),
    ]
    assert scaled_size(480, 360, 1.25, 480) == (650, 488)
    assert scaled_size(1, 1000, 1.0, 480) == (1, 520)
    assert [window_starts(n, 480) for n in (390, 480, 481, 800, 801, 910)] == [
        [0], [0], [0, 320], [0, 320], [0, 320, 640], [0, 320, 640],
    ]  # fmt: skip


def test_paper_runs_26_times_and_fast_once() -> None:
    for options, size, runs in ((LSegOptions(), (48, 64), 26), (LSegOptions.fast(), (90, 101), 1)):
        teacher, calls = tiny(options), []
        teacher.network.register_forward_hook(lambda *_, calls=calls: calls.append(1))
        teacher.encode_image(picture(*size))
        assert len(calls) == runs


def test_text_is_unit_rows_of_the_tower_in_the_order_of_the_prompts() -> None:
    calls: list[int] = []
    teacher = tiny(load_text=lambda: calls.append(1) or text_from_state(STATE, TINY, source="tiny"))
    teacher.encode_image(picture(8, 8))
    assert calls == []
    prompts = ["wall", "a", "door"] + ["b" * (k % 5) for k in range(80)]  # more than are embedded at a time
    rows = teacher.encode_text(prompts)
    expected = text_from_state(STATE, TINY, source="tiny")(input_ids=tokenize(prompts)).text_embeds
    assert rows.shape == (83, 16)
    torch.testing.assert_close(rows.norm(dim=1), torch.ones(83), rtol=1e-6, atol=0)
    torch.testing.assert_close(rows, functional.normalize(expected, dim=1), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(teacher.encode_text(("door",))[0], rows[2], rtol=1e-4, atol=1e-5)
    assert calls == [1]  # it comes at the first prompt, and stays


def test_bfloat16_is_near_float32_and_not_equal() -> None:
    image = picture(50, 64)
    exact = tiny(LSegOptions.fast()).encode_image(image)
    rough = tiny(replace(LSegOptions.fast(), precision="bfloat16")).encode_image(image)
    assert rough.dtype == torch.float32
    assert functional.cosine_similarity(exact, rough, dim=0).min() > 0.99
    assert not torch.equal(exact, rough)


def test_a_teacher_is_a_module_that_never_trains() -> None:
    teacher = tiny()
    assert isinstance(teacher, Teacher)
    assert (teacher.name, teacher.to("cpu")) == ("lseg", teacher)
    torch.nn.Sequential(teacher).train()  # as part of something that is trained
    assert not any(part.training for part in teacher.modules())
    assert not any(parameter.requires_grad for parameter in teacher.parameters())


def test_identity_is_json_tells_the_options_and_asks_for_the_digest_once() -> None:
    calls: list[int] = []
    teacher = tiny(LSegOptions(scales=(1.0,), size=(30, 40)), weights=lambda: calls.append(1) or "abc")
    assert calls == []
    identity = identify(teacher)
    assert identity["weights"] == "abc"
    assert identity["options"] == {"scales": [1.0], "flip": True, "size": [30, 40], "precision": "float32"}
    assert identity["config"]["window"] == 64
    assert json.loads(json.dumps(identity)) == identity == teacher.identity
    assert calls == [1]
    assert tiny().identity["weights"] is None


def test_load_lseg_reads_both_towers_of_one_file_and_combines_fast_with_single_settings(tmp_path: Path) -> None:
    path = tmp_path / "demo.ckpt"
    torch.save({"state_dict": STATE, "epoch": 200, "hyper_parameters": {"backbone": "clip_vitl16_384"}}, path)
    teacher = load_lseg(path, config=TINY, scales=[1], flip=False)
    assert teacher.options == LSegOptions(scales=(1.0,), flip=False)
    expected = tiny(teacher.options).encode_image(picture(20, 30))
    torch.testing.assert_close(teacher.encode_image(picture(20, 30)), expected, rtol=0, atol=0)
    assert teacher.encode_text(["wall", "swivel chair"]).shape == (2, 16)
    assert len(teacher.identity["weights"]) == 64
    assert load_lseg(path, config=TINY).options == LSegOptions()
    assert load_lseg(path, config=TINY, fast=True).options == LSegOptions.fast()
    fast = load_lseg(path, config=TINY, fast=True, flip=True, size=None)
    assert fast.options == LSegOptions(scales=LSegOptions.fast().scales, flip=True, size=None)


def test_options_that_are_refused() -> None:
    refused(lambda: LSegOptions(scales=()), "scales:", "got none", "(1.0,)")
    refused(lambda: LSegOptions(scales=(1.0, 0.0)), "scales:", "(0, 16]", "got 0.0")
    refused(lambda: LSegOptions(scales=(float("nan"),)), "scales:", "(0, 16]", "got nan")
    refused(lambda: LSegOptions(scales=(520.0,)), "scales:", "(0, 16]", "got 520.0")
    refused(lambda: LSegOptions(size=480), "size:", "(height, width)", "got 480")
    refused(lambda: LSegOptions(size=(0, 480)), "size", "[1, inf)", "got 0")
    refused(lambda: LSegOptions(precision="half"), "precision:", "'float32', 'bfloat16'", "got 'half'")
