"""The methods: kind -> (configuration, class). Everything that lists methods reads this table."""

from typing import Any

from rhmc.algorithms import iql, rhmc

ALGORITHMS: dict[str, tuple[type[Any], type[Any]]] = {
    "rhmc": (rhmc.Config, rhmc.RHMC),
    "iql": (iql.Config, iql.IQL),
}
