"""Comparisons of arms: pairs, scaling, transfer, equivalence; no verdicts on the paper's claims."""
