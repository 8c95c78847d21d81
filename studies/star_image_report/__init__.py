"""The star image detection report, every claim of it held against what is built here."""
