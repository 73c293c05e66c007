"""Comparisons of arms: pairs, scaling, transfer, equivalence, effects, settings; no verdicts on the paper's claims."""
