"""Networks over observations, output heads, and sampling; no losses and no optimisers."""
