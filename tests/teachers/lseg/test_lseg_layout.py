"""The layout of LSeg's checkpoint, against the counts that are known of the released file."""

import math

from lseg_layout import layout

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
