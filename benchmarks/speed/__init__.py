"""What the service and its kernels cost: docs/performance.md."""
