"""The science: tasks, networks, methods and their training. Knows neither studies nor logs nor reports."""

from rhmc.portable import apply, keep_memory

apply()
keep_memory()
