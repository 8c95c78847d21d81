"""Export of attitudes and tables in file formats for other programs."""

from service.feature import Feature

FEATURE = Feature("products", __name__, ("part", "command", "routes", "pages"))
