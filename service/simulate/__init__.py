"""SKIES WITH KNOWN TRUTH: sample telemetry drawn from the real sky, and how answers compare."""
