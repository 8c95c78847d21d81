"""Compiled attitude filter and smoother, with their input and output types; no database."""

from service.features.definitive.kernels.smoother import compile_kernels

__all__ = ["compile_kernels"]
