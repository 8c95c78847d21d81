"""Files of other programs: attitudes (AEM and C-kernels), and orbits (OEM and TLE)."""
