"""SPICE kernels: attitudes as a C-kernel, with the kernels that it takes to use it."""
