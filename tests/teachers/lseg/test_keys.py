import math

import pytest
import torch
from lseg_layout import TINY, layout, random_state
from messages import refused, tells

from kfgs.teachers.lseg import LSegConfig
from kfgs.teachers.lseg.keys import network_from_state, text_from_state

HEAD = "net.scratch.head1.weight"
POSITIONS = "net.pretrained.model.pos_embed"
QKV = "net.pretrained.model.blocks.2.attn.qkv.weight"


@pytest.fixture
def state():
    return random_state(TINY, torch.Generator().manual_seed(7))


def test_layout_of_these_tests_has_the_released_tensors_and_parameters():
    shapes = layout(LSegConfig())
    assert len(shapes) == 730
    assert round(sum(math.prod(shape) for shape in shapes.values()) / 1e6, 1) == 495.1
    visual = [math.prod(shape) for name, shape in shapes.items() if ".visual." in name]
    assert round(sum(visual) / 1e6, 1) == 87.8
    assert LSegConfig().hooks == (5, 11, 17, 23)


def test_single_precision_is_shared_and_half_is_cast(state, tmp_path):
    network = network_from_state(state, TINY, source="a")
    assert network.head.weight.data_ptr() == state[HEAD].data_ptr()
    assert network.vit.encoder.blocks[2][0].fn[1].qkv.weight.data_ptr() == state[QKV].data_ptr()
    torch.save(state, tmp_path / "a.pt")  # nor is a memory-mapped file copied
    mapped = torch.load(tmp_path / "a.pt", mmap=True, weights_only=True)
    assert network_from_state(mapped, TINY, source="a.pt").head.weight.data_ptr() == mapped[HEAD].data_ptr()
    half = network_from_state({**state, HEAD: state[HEAD].half()}, TINY, source="a")
    assert torch.equal(half.head.weight, state[HEAD].half().float())


def test_prefix_and_unused_tensors_may_be_missing(state):
    x = 2 * torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(8)) - 1
    expected = network_from_state(state, TINY, source="a")(x)
    unused = ("clip_pretrained.", "pretrained.model.norm", "pretrained.model.head", "scratch.refinenet4.resConfUnit1")
    bare = {name.removeprefix("net."): value for name, value in state.items()}
    bare = {n: v for n, v in bare.items() if not n.startswith(unused) and not n.endswith("num_batches_tracked")}
    assert len(state) - len(bare) > 60
    assert torch.equal(network_from_state(bare, TINY, source="a")(x), expected)
    refused(lambda: text_from_state(bare, TINY, source="a"), "a:", "text tower", "clip_pretrained.*")


def test_missing_unknown_and_misshapen_tensors_are_counted_and_named(state):
    del state[HEAD], state[QKV]
    state["net.scratch.extra"] = torch.zeros(2)
    state[POSITIONS] = torch.zeros(1, 17, 32)
    with pytest.raises(ValueError, match=tells("my.ckpt:", "clip_vitl16_384")) as caught:
        network_from_state(state, TINY, source="my.ckpt")
    message = str(caught.value)
    assert (
        "2 missing (pretrained.model.blocks.2.attn.qkv.weight (96, 32); scratch.head1.weight (16, 12, 1, 1" in message
    )
    assert "1 unknown (scratch.extra)" in message
    assert "1 of another shape or type (pretrained.model.pos_embed: expected (1, 10, 32), got (1, 17, 32)" in message
    assert message.endswith("use the file as its authors published it")
    assert "\n" not in message
    empty = lambda **state: network_from_state(state, TINY, source="other.pt")  # noqa: E731
    refused(empty, "other.pt:", "LSeg", "got another network of 0 tensors", "missing")
    refused(lambda: empty(**{"a\nb": torch.zeros(4)}), "of 1 tensors", "1 unknown (a\\nb)")
