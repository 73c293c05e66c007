"""Parts that learners share: replay, returns, normalisation, optimisation, settings, checkpoints; no method."""
