"""The embedded star catalog and how it is built."""
