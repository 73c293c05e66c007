"""The methods, a page each, which registers itself as this package is imported; no task and no training loop.

There is nothing here but imports, so that a new page changes the code of no other method.
"""

# The order is that of tables.
# isort: off
from rhmc.algorithms.base import ALGORITHMS, Method, register_method
from rhmc.algorithms import rhmc, qmix, vdn, iql, maddpg, coma, mappo, ippo, hitmac
