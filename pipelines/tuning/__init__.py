"""Searches with Optuna: trials, their workers, the best settings; no launch of studies."""
