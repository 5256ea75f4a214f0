"""The layout of LSeg's checkpoint, against the counts that are known of the released file."""

import math
from collections import Counter

import torch
from lseg_layout import layout, random_state

from kfgs.teachers.lseg.network import LSegConfig

TINY = LSegConfig(
    width=32, depth=4, heads=2, window=64, position_grid=3, hooks=(0, 1, 2, 3), neck=(8, 16, 24, 32), fusion=12, dim=10,
    text_width=16, text_layers=2, text_heads=2, vocabulary=60, context=12,
)  # fmt: skip


def test_layout_has_the_released_tensors_and_parameters() -> None:
    shapes = layout(LSegConfig())
    assert len(shapes) == 730
    assert round(sum(math.prod(shape) for shape in shapes.values()) / 1e6, 1) == 495.1
    visual = {name: shape for name, shape in shapes.items() if ".visual." in name}
    assert round(sum(math.prod(shape) for shape in visual.values()) / 1e6, 1) == 87.8
    assert shapes["net.clip_pretrained.transformer.resblocks.11.attn.in_proj_weight"] == (1536, 512)
    assert shapes["net.pretrained.act_postprocess4.4.weight"] == (1024, 1024, 3, 3)
    assert "net.pretrained.act_postprocess3.4.weight" not in shapes
    assert shapes["net.scratch.refinenet4.resConfUnit1.bn2.num_batches_tracked"] == ()
    assert all(name.startswith("net.") for name in shapes)


def test_half_precision_is_what_clip_converts() -> None:
    """convert_weights of CLIP: 8 tensors of each of 2 x 12 blocks, conv1, and both projections; not LayerNorm or tables."""
    deep = LSegConfig(**{**vars(TINY), "text_layers": 12})
    state = random_state(deep, torch.Generator().manual_seed(0))
    kinds = Counter(value.dtype for name, value in state.items() if ".clip_pretrained." in name)
    assert kinds == {torch.float16: 195, torch.float32: 107}
    assert not any(value.dtype == torch.float16 for name, value in state.items() if ".clip_pretrained." not in name)
    assert not any(v.dtype == torch.float16 for v in random_state(TINY, half_text=False).values())


def test_random_state_has_the_layout_is_seeded_and_keeps_magnitudes() -> None:
    state = random_state(TINY, torch.Generator().manual_seed(3))
    assert {name: tuple(value.shape) for name, value in state.items()} == layout(TINY)
    again = random_state(TINY, torch.Generator().manual_seed(3))
    assert all(torch.equal(state[name], again[name]) for name in state)
    weight = state["net.pretrained.model.blocks.0.mlp.fc2.weight"]  # [32, 128]
    torch.testing.assert_close(weight.std().item() * 128**0.5, 1.0, rtol=0.05, atol=0)
    upscale = state["net.pretrained.act_postprocess1.4.weight"]  # [8 in, 8 out, 4, 4]: each output sees 8 values
    torch.testing.assert_close(upscale.std().item() * 8**0.5, 1.0, rtol=0.1, atol=0)
    assert state["net.scratch.refinenet1.resConfUnit1.bn1.running_var"].min() >= 0.5
