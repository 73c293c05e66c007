"""Parts that every learner uses: replay, returns, normalisation, optimisation, settings, checkpoints."""
