"""Archive of old batches in Parquet files beside the database."""
