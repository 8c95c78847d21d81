"""The geometry of the charts of a period: places in pixels and paths, no markup."""
