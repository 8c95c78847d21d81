"""Star images: frames of spacecraft, and pictures of any camera without a mission."""

from service.feature import Feature

FEATURE = Feature("pictures", __name__, ("kernels", "part", "command", "routes", "pages"))
