"""Benchmarks of the speed of the service and its kernels: docs/performance.md."""
