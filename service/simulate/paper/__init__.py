"""THE PAPER'S OWN TEST: the simulator of Fink & Shoup 1994, its tables beside ours."""
