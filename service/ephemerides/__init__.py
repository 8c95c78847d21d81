"""Readers of attitude files (AEM, ACM, C-kernels, CSV) and orbit files (OEM, OMM, TLE)."""
