"""What scanning trackers count and time, made to measured angles with their sigmas."""
