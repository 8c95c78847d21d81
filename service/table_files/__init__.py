"""Writers of tables as files: CSV, Parquet and FITS."""
