"""Everything about numba: how kernels are compiled, arrays in them, the kernel cache."""
