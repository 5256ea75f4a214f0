"""The GPU engine: compositing by Triton kernels."""
