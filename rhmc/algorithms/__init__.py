"""The methods: kind -> (configuration, class). Everything that lists methods reads this table."""

from typing import Any

from rhmc.algorithms import iql

ALGORITHMS: dict[str, tuple[type[Any], type[Any]]] = {
    "iql": (iql.Config, iql.IQL),
}
