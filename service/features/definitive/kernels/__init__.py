"""The filter and the smoother, compiled, with what they take and give; no database."""

from service.features.definitive.kernels.smoother import compile_kernels

__all__ = ["compile_kernels"]
