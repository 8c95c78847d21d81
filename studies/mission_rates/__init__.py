"""The simulator of Fink & Shoup 1994 for any mission: rates of its settings under given errors."""
