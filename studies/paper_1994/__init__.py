"""The simulator of Fink & Shoup 1994, and the paper's tables beside ours."""
