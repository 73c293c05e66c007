"""A trained policy as MLflow loads it: `mlflow.pyfunc.load_model(...).predict(observations)` gives joint actions.

MLflow keeps a copy of this file in every model and runs it to load one, so nothing is pickled. The project has to be
installed where a model is loaded.
"""

from pathlib import Path
from typing import Any

import torch
from mlflow.models import set_model
from mlflow.pyfunc import PythonModel

from pipelines.tracking.policy import Actor, load
from rhmc.types import Obs


class Greedy:
    """A team that acts greedily, by MLflow's names.

    It remembers from call to call what its method remembers within an episode (an assignment, say), so one loaded model
    follows one batch of episodes: `first` says where a new one begins, and so does another batch size.
    """

    def load_context(self, context: Any) -> None:
        """Read the policy."""
        self.actor = Actor(load(Path(context.artifacts["policy"])))

    def predict(self, context, model_input, params=None):  # type: ignore[no-untyped-def]  # MLflow would judge hints
        """Actions (B, N), or (B, N, A) where they are continuous, of observations as in `rhmc.types.Obs`.

        Args:
            context: MLflow's.
            model_input: the arrays `agents` (B, N, Fa), `pairs` (B, N, M, Fp), `peers` (B, N, N, Fo), without those
                that have no features, and `first` (B,).
            params: none are known.
        """
        size = self.actor.sizes
        first = torch.as_tensor(model_input["first"], dtype=torch.bool)
        batch, n = len(first), size.agents
        shapes = {
            "agents": (batch, n, size.agent_features),
            "pairs": (batch, n, size.targets, size.pair_features),
            "peers": (batch, n, n, size.peer_features),
        }
        seen = {
            name: torch.as_tensor(model_input[name]) if name in model_input else torch.zeros(shape)
            for name, shape in shapes.items()
        }
        return self.actor.act(Obs(first=first, **seen))[0].numpy()


class ServedPolicy(Greedy, PythonModel):
    """The interface that MLflow asks for. Methods in this class itself would need type hints that it can check."""


set_model(ServedPolicy())
