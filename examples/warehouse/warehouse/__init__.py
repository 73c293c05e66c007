"""Warehouse: a task for rhmc in which targets are completed and appear anew."""
