"""Everything about numba: how kernels are compiled, views without owners, the kernel cache."""
