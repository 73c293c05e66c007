"""Exported tables and the paper's statements, checked as they are read, and statistics over seeds; no figures."""
