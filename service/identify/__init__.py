"""WHICH IS WHICH: observed stars to catalog stars."""
