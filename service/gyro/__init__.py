"""Gyros: blocks of rates as they are sent and stored, and what is believed of them."""
