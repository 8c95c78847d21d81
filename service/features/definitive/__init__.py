"""The definitive attitude: recorded days filtered and smoothed with their gyro, and live ones."""

from service.feature import Feature

FEATURE = Feature(
    "definitive", __name__, ("kernels", "part", "command", "serving", "routes", "pages")
)
