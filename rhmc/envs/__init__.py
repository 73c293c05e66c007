"""The tasks, a page each, which registers itself as this package is imported; no learners and no networks."""

from rhmc.envs import coverage, navigation
from rhmc.envs.base import ENVS, Env, EnvConfig, Physics, Task, make_env, register_task
