"""YAML files become validated settings, and a run gets its identity; nothing is trained or logged here."""
