"""The training loop and greedy evaluation."""
