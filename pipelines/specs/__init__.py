"""YAML files become validated settings with an identity. Nothing is trained or logged here."""
