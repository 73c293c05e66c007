"""Action values with memory: `qlearning` on recurrent networks, learned from segments of a replay.

Both networks are unrolled from the stored state, which the network that acted had then. The mixer is the encoder's own
and has no memory, as in PyMARL: it sees what all agents observe.
"""

import torch
from torch import Generator, Tensor, nn

from rhmc.algorithms.qlearning import Config, QLearning, Values
from rhmc.learning.experience import flat
from rhmc.learning.learner import taken, unpack
from rhmc.learning.segments import Segments, along, following
from rhmc.networks.recurrent import stepped
from rhmc.types import Batch, Carry, Obs, Spec, Transition


def learner(cfg: Config, spec: Spec, rng: Generator, mixer: nn.Module) -> QLearning:
    """The learner that the encoder asks for."""
    return (RecurrentQLearning if cfg.remembers else QLearning)(cfg, spec, rng, mixer)


class RecurrentQLearning(QLearning):
    """See the module."""

    def __init__(self, cfg: Config, spec: Spec, rng: Generator, mixer: nn.Module) -> None:
        super().__init__(cfg, spec, rng, mixer)
        self.experience: Segments = Segments(cfg, cfg.batch_size, cfg.segment_length, rng)

    def carry(self, batch: int) -> Carry:
        """The state of every agent's memory, (B, N, H)."""
        return {"state": torch.zeros(batch, self.spec.agents, self.cfg.hidden_dim, device=self.rng.device)}

    def act(self, obs: Obs, carry: Carry, rng: Generator, *, explore: bool) -> tuple[Tensor, Carry, Batch]:
        """As without memory; beside the action the state before it."""
        values, state = stepped(self.q.net.agents, obs, carry["state"])
        action = values.argmax(-1)
        return self._explored(action, rng) if explore else action, {"state": state}, carry

    def observe(self, transition: Transition) -> None:
        """Store one step of each environment."""
        self.standardiser.update_rewards(transition.reward)
        self.experience.add_step(transition, transition.extra["state"])

    def _values(self, rows: Batch) -> tuple[Tensor, Tensor]:
        """As without memory, of segments: (T, B, K) both."""
        net, target_net = self.q.net, self.q.target_net
        output, states = along(net.agents, rows, rows["state"])
        chosen = _mixed(net, rows, "", output, rows["action"])
        with torch.no_grad():
            values = following(target_net.agents, rows, *along(target_net.agents, rows, rows["state"]))
            judged = following(net.agents, rows, output, states) if self.cfg.double_q else values
            return chosen, _mixed(target_net, rows, "next_", values, judged.argmax(-1))


def _mixed(net: Values, rows: Batch, prefix: str, values: Tensor, action: Tensor) -> Tensor:
    """Mixed values (T, B, K) of joint actions (T, B, N) among values (T, B, N, actions)."""
    seen = flat({key: rows[key] for key in (f"{prefix}{name}" for name in ("agents", "pairs", "peers"))})
    mixed: Tensor = net.mixer(unpack(seen, prefix), taken(values, action).flatten(0, 1))
    return mixed.unflatten(0, action.shape[:2])
