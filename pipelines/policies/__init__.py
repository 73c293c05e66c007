"""Trained policies in use: evaluation, transfer, assignments, animations; nothing is trained here."""
