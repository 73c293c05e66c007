"""The tasks, a page each, which registers itself: importing this package fills `ENVS`."""

from rhmc.envs import coverage, navigation
from rhmc.envs.base import ENVS, Env, EnvConfig, Physics, Task, make_env, register_task
