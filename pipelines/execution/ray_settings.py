"""Ray's settings for studies, searches and workers. Ray reads them when it is imported, so nothing here imports it."""

import os
from collections.abc import Mapping

RAY_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_CHDIR_TO_TRIAL_DIR": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_AIR_NEW_OUTPUT": "0",
    "RAY_DEDUP_LOGS": "0",
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
    "TUNE_GLOBAL_CHECKPOINT_S": "3600",  # Tune's own state, from which nothing is restored
    "TUNE_DISABLE_SIGINT_HANDLER": "1",  # ours lets every run save itself first
    "TUNE_WARN_EXCESSIVE_EXPERIMENT_CHECKPOINT_SYNC_THRESHOLD_S": "0",
}

OWN_NODE = {  # of a node that is started for one launch: Ray's defaults suit many short tasks, a training lasts minutes
    "RAY_memory_monitor_refresh_ms": "2000",
    "RAY_raylet_report_resources_period_milliseconds": "1000",
    "RAY_metrics_report_interval_ms": "60000",
    "RAY_task_events_report_interval_ms": "0",
    "RAY_event_stats": "0",
}


def set_up_ray(settings: Mapping[str, str] = RAY_SETTINGS) -> None:
    """Put settings into the environment; what a person has set there stays."""
    os.environ.update({name: os.environ.get(name, value) for name, value in settings.items()})
