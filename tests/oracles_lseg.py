"""LSeg's network by transformers' DPT and CLIP, out of a checkpoint's tensors; none of kfgs's code.

Transformers is imported where it is used: it takes seconds, and every worker imports this file.
"""

import torch
from torch import nn


def plain(state, prefix, dtype):
    """Tensors whose name begins with net.<prefix>, without that."""
    prefix = "net." + prefix
    return {name[len(prefix) :]: value.to(dtype) for name, value in state.items() if name.startswith(prefix)}


def linear(state, ours, theirs):
    return {f"{ours}.weight": state[f"{theirs}.weight"], f"{ours}.bias": state[f"{theirs}.bias"]}


def thirds(state, ours, theirs):
    """A fused projection, as those of queries, keys and values."""
    result = {}
    for part, name in enumerate(ours):
        rows = slice(part * len(state[f"{theirs}weight"]) // 3, (part + 1) * len(state[f"{theirs}weight"]) // 3)
        result[f"{name}.weight"] = state[f"{theirs}weight"][rows]
        result[f"{name}.bias"] = state[f"{theirs}bias"][rows]
    return result


def vit_tensors(state, depth, width):
    ours = {
        "embeddings.cls_token": state["cls_token"],
        "embeddings.position_embeddings": state["pos_embed"],
        **linear(state, "embeddings.patch_embeddings.projection", "patch_embed.proj"),
        "layernorm.weight": torch.ones(width),  # its output is not looked at
        "layernorm.bias": torch.zeros(width),
    }
    for i in range(depth):
        block, layer = f"blocks.{i}", f"encoder.layer.{i}"
        names = [f"{layer}.attention.attention.{part}" for part in ("query", "key", "value")]
        ours |= thirds(state, names, f"{block}.attn.qkv.")
        ours |= linear(state, f"{layer}.attention.output.dense", f"{block}.attn.proj")
        ours |= linear(state, f"{layer}.intermediate.dense", f"{block}.mlp.fc1")
        ours |= linear(state, f"{layer}.output.dense", f"{block}.mlp.fc2")
        ours |= linear(state, f"{layer}.layernorm_before", f"{block}.norm1")
        ours |= linear(state, f"{layer}.layernorm_after", f"{block}.norm2")
    return ours


def neck_tensors(posts, scratch):
    ours = {}
    for i in range(4):
        stage, fusion = "reassemble_stage", f"fusion_stage.layers.{3 - i}"
        ours |= linear(posts, f"{stage}.readout_projects.{i}.0", f"{i + 1}.0.project.0")
        ours |= linear(posts, f"{stage}.layers.{i}.projection", f"{i + 1}.3")
        if i != 2:
            ours |= linear(posts, f"{stage}.layers.{i}.resize", f"{i + 1}.4")
        ours[f"convs.{i}.weight"] = scratch[f"layer{i + 1}_rn.weight"]
        ours |= linear(scratch, f"{fusion}.projection", f"refinenet{i + 1}.out_conv")
        for name, value in scratch.items():
            if name.startswith(f"refinenet{i + 1}.resConfUnit"):
                _, unit, part, kind = name.split(".")
                part = part.replace("conv", "convolution").replace("bn", "batch_norm")
                ours[f"{fusion}.residual_layer{unit[-1]}.{part}.{kind}"] = value
    return ours


def features(state, config, x, attention="sdpa"):
    """[B, 3, S, S] -> [B, D, S / 2, S / 2], in the dtype of x; attention "eager" takes its softmax in float32 always."""
    return network(state, config, x.dtype, attention)(x)


def network(state, config, dtype, attention="sdpa"):
    """What `features` computes, as a function of x, for many pictures."""
    from transformers import DPTConfig, DPTModel
    from transformers.models.dpt.modeling_dpt import DPTNeck

    settings = DPTConfig(
        hidden_size=config.width,
        num_hidden_layers=config.depth,
        num_attention_heads=config.heads,
        intermediate_size=4 * config.width,
        image_size=16 * config.position_grid,
        patch_size=16,
        layer_norm_eps=1e-6,
        backbone_out_indices=list(config.hooks),
        neck_hidden_sizes=list(config.neck),
        fusion_hidden_size=config.fusion,
        reassemble_factors=[4, 2, 1, 0.5],
        readout_type="project",
        use_batch_norm_in_fusion_residual=True,
        use_bias_in_fusion_residual=False,
        attn_implementation=attention,
    )
    with torch.device("meta"):
        vit, neck = DPTModel(settings, add_pooling_layer=False), DPTNeck(settings)
        head = nn.Conv2d(config.fusion, config.dim, 1)
    posts, scratch = plain(state, "pretrained.act_postprocess", dtype), plain(state, "scratch.", dtype)
    vit.load_state_dict(vit_tensors(plain(state, "pretrained.model.", dtype), config.depth, config.width), assign=True)
    neck.load_state_dict(neck_tensors(posts, scratch), assign=True)
    head.load_state_dict(plain(state, "scratch.head1.", dtype), assign=True)
    vit.to(dtype).eval()
    neck.eval()

    def run(x):
        with torch.no_grad():
            hidden = vit(x, output_hidden_states=True).hidden_states
            return head(neck([hidden[i + 1] for i in config.hooks])[-1])

    return run


def text_tensors(found, layers):
    """A text tower's tensors up to its last norm, in transformers' names."""
    ours = {
        "embeddings.token_embedding.weight": found["token_embedding.weight"],
        "embeddings.position_embedding.weight": found["positional_embedding"],
        **linear(found, "final_layer_norm", "ln_final"),
    }
    for i in range(layers):
        block, layer = f"transformer.resblocks.{i}", f"encoder.layers.{i}"
        ours |= thirds(found, [f"{layer}.self_attn.{part}_proj" for part in "qkv"], f"{block}.attn.in_proj_")
        ours |= linear(found, f"{layer}.self_attn.out_proj", f"{block}.attn.out_proj")
        ours |= linear(found, f"{layer}.layer_norm1", f"{block}.ln_1")
        ours |= linear(found, f"{layer}.layer_norm2", f"{block}.ln_2")
        ours |= linear(found, f"{layer}.mlp.fc1", f"{block}.mlp.c_fc")
        ours |= linear(found, f"{layer}.mlp.fc2", f"{block}.mlp.c_proj")
    return ours


def text_settings(config, attention):
    from transformers import CLIPTextConfig

    return CLIPTextConfig(
        vocab_size=config.vocabulary,
        hidden_size=config.text_width,
        intermediate_size=4 * config.text_width,
        num_hidden_layers=config.text_layers,
        num_attention_heads=config.text_heads,
        max_position_embeddings=config.context,
        projection_dim=config.dim,
        bos_token_id=config.vocabulary - 2,
        eos_token_id=config.vocabulary - 1,
        attn_implementation=attention,
    )


def text(state, config, ids, dtype=torch.float64, attention="sdpa"):
    """[n, context] -> [n, D]."""
    from transformers import CLIPTextModel

    tower = CLIPTextModel(text_settings(config, attention)).to(dtype).eval()
    found = plain(state, "clip_pretrained.", dtype)
    ours = text_tensors(found, config.text_layers)
    prefix = next(iter(tower.state_dict())).split("embeddings.")[0]  # "text_model." in some versions
    tower.load_state_dict({prefix + name: value for name, value in ours.items()})
    with torch.no_grad():
        hidden = tower(input_ids=ids).last_hidden_state  # after the last norm
    return (
        torch.stack([row[int(end)] for row, end in zip(hidden, ids.argmax(1), strict=True)]) @ found["text_projection"]
    )


def prompt_embeddings(state, config, prompts, tokenizer):
    """Unit rows [n, D] float64 by transformers from the text on: its tokenizer, pooling and projection, a prompt at a time."""
    from transformers import CLIPTextModelWithProjection

    tower = CLIPTextModelWithProjection(text_settings(config, "sdpa")).double().eval()
    found = plain(state, "clip_pretrained.", torch.float64)
    ours = {f"text_model.{name}": value for name, value in text_tensors(found, config.text_layers).items()}
    tower.load_state_dict({**ours, "text_projection.weight": found["text_projection"].T})
    rows = []
    for prompt in prompts:
        with torch.no_grad():
            row = tower(input_ids=torch.tensor([tokenizer(prompt)["input_ids"]])).text_embeds[0]
        rows.append(row / (row**2).sum().sqrt())
    return torch.stack(rows)
