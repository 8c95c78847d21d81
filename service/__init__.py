"""Star identification and attitude: from a batch of observed stars to a recorded attitude."""

from service.compiled.cache import keep_kernels_apart

__version__ = "0.2.0"

# Must precede any import of numba.
keep_kernels_apart()
