"""Zhou & Ye 2015: their tables and figures, and the rivals that they compare with."""
