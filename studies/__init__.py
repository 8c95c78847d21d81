"""Reproductions of three published documents; the service does not use them."""
