"""Attitudes read from files of other programs: AEM and C-kernels."""
