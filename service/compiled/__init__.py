"""Numba support: compilation of kernels, their array functions, and the kernel cache."""
