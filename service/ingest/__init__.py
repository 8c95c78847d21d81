"""Processing of submissions to recorded answers: single posts, bulk, replays, reprocessing."""
