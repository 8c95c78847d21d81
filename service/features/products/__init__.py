"""Products: attitudes and tables in the formats that other programs read."""

from service.feature import Feature

FEATURE = Feature("products", __name__, ("part", "command", "routes", "pages", "panels"))
