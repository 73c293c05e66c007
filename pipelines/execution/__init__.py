"""Trainings on Ray Tune: launching, recording, clusters, adoption. No search."""
