"""Trainings on Ray Tune: launching, recording, clusters, adoption; no search for settings."""
