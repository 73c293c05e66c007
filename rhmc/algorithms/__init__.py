"""The methods: kind -> configuration, builder and description. Everything that lists methods reads this table."""

from rhmc.algorithms import iql, qmix, rhmc, vdn
from rhmc.algorithms.base import Method

ALGORITHMS: dict[str, Method] = {
    "rhmc": Method(rhmc.Config, rhmc.RHMC, rhmc.ABOUT),
    "qmix": Method(qmix.Config, qmix.build, qmix.ABOUT),
    "vdn": Method(vdn.Config, vdn.build, vdn.ABOUT),
    "iql": Method(iql.Config, iql.build, iql.ABOUT),
}
