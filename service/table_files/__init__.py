"""Tables as files: CSV, Parquet and FITS."""
