"""Trained policies in use: evaluation, transfer, assignments, animations. Nothing is trained here."""
