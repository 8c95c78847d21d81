"""SKIES WITH KNOWN TRUTH: sample telemetry drawn from the real catalog, and how answers compare."""
