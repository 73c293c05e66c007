"""The methods: kind -> configuration, builder and description. Everything that lists methods reads this table."""

from rhmc.algorithms import coma, hitmac, ippo, iql, maddpg, mappo, qmix, rhmc, vdn
from rhmc.algorithms.base import Method

ALGORITHMS: dict[str, Method] = {
    "rhmc": Method(rhmc.Config, rhmc.RHMC, rhmc.ABOUT),
    "qmix": Method(qmix.Config, qmix.build, qmix.ABOUT),
    "vdn": Method(vdn.Config, vdn.build, vdn.ABOUT),
    "iql": Method(iql.Config, iql.build, iql.ABOUT),
    "maddpg": Method(maddpg.Config, maddpg.MADDPG, maddpg.ABOUT),
    "coma": Method(coma.Config, coma.COMA, coma.ABOUT),
    "mappo": Method(mappo.Config, mappo.build, mappo.ABOUT),
    "ippo": Method(ippo.Config, ippo.build, ippo.ABOUT),
    "hitmac": Method(hitmac.Config, hitmac.HiTMAC, hitmac.ABOUT),
}
