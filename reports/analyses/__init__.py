"""Comparisons of arms: pairs, scaling, transfer, equivalence, effects by alpha; no verdicts on the paper's claims."""
