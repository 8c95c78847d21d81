"""The page at `/`: how well stars are identified, spacecraft by spacecraft."""
