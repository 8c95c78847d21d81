import service  # noqa: F401 - before numba, which asks only once where it keeps kernels
