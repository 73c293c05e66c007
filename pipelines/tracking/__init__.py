"""The log of runs: plans, records, models and views in MLflow. Nothing is trained here."""
