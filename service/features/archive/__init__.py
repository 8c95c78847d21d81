"""Archive of old batches: Parquet files beside the database, and reprocessing into them."""

from service.feature import Feature

FEATURE = Feature("archive", __name__, ("archive", "part", "command", "pages"))
