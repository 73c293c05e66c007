"""The requirements on every method."""
