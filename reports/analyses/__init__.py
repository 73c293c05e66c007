"""Comparisons of arms: pairs, scaling, transfer, equivalence."""
