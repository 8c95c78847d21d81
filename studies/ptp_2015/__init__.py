"""Reproduction of Zhou & Ye 2015: tables, figures, and the compared algorithms."""
