"""Definitive attitude: recorded days filtered and smoothed with gyro data, and live filtering."""

from service.feature import Feature

FEATURE = Feature(
    "definitive", __name__, ("kernels", "part", "command", "serving", "routes", "pages")
)
