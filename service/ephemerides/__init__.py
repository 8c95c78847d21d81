"""Attitudes and orbits as other programs give them: AEM, ACM, C-kernels, CSV; OEM, OMM, TLE."""
