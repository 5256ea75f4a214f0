"""A tiny LSeg: every part of the network, in milliseconds."""

from kfgs.teachers.lseg import LSegConfig

TINY = LSegConfig(
    width=32,
    depth=4,
    heads=4,
    position_grid=3,
    window=64,
    hooks=(0, 1, 2, 3),
    neck=(8, 12, 16, 20),
    fusion=16,
    dim=24,
    text_width=32,
    text_layers=2,
    text_heads=4,
    context=9,
    vocabulary=60,
)
