"""Other methods of the field on kfgs's own engine, each from its equations: what the paper's Table 1 compares with.

They are no part of the package. All of them reuse one frozen cloud of Gaussians per scene, trained on the pictures alone, so that
they differ in nothing but how features get onto it. Each module has a configuration with `published()` and `short()`, and `fit`.
"""
