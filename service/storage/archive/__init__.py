"""The archive: old batches in Parquet files beside the database."""
