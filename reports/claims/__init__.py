"""The paper's claims, the rule of each and the verdict that it comes to; no statistics of its own, and no figure."""
