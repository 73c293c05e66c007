"""The training loop and greedy evaluation; no log, no processes, no files."""
