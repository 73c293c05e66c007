"""Runs of a study as files that another machine takes in, checked before anything is written; no training."""
