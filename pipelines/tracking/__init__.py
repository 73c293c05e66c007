"""The log of runs in MLflow: plans, records, models, views; nothing is trained here."""
