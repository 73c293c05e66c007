"""Settings shared by several methods, each with one name and one meaning."""

from pydantic import Field

from rhmc.learning.normalisation import Scale
from rhmc.networks.nets import EncoderName
from rhmc.types import Frozen


class Networks(Frozen):
    """Settings of every method; the defaults are the paper's (section 5.1) where it gives a value."""

    encoder: EncoderName = Field(
        "mlp",
        description="fully connected on all features (the paper's), for fixed numbers of agents and targets; or one "
        "network on every pair of agent and target, for any numbers (`rhmc.networks.nets`)",
    )
    hidden_dim: int = Field(64, ge=1, description="units of each hidden layer")
    share: bool = Field(True, description="one network for all agents; `mlp` adds a one-hot id of the agent")
    lr: float = Field(5e-4, gt=0, description="Adam's step size")
    max_grad_norm: float = Field(10.0, gt=0, description="largest norm of a network's gradient")


class TargetNetworks(Networks):
    """Settings of methods whose targets come from target networks."""

    tau: float = Field(0.005, ge=0, le=1, description="share of the way that target networks move per update")


class Standardised(Frozen):
    """Settings of methods with one reward and one discount."""

    gamma: float = Field(0.99, ge=0, le=1, description="discount per environment step")
    standardise: Scale = Field(
        "reward",
        description="learn from rewards, or predict returns, of mean 0 and deviation 1 (`rhmc.learning.normalisation`)",
    )


class Replayed(Frozen):
    """Settings of methods that learn from a replay buffer."""

    buffer_size: int = Field(50_000, ge=1, description="rows kept: environment steps")
    learning_starts: int = Field(2_000, ge=0, description="environment steps before the first update")
    train_freq: int = Field(64, ge=1, description="environment steps collected for each update")


class OffPolicy(Replayed):
    """Settings of off-policy methods with one kind of update."""

    batch_size: int = Field(256, ge=1, description="rows of an update")


class OnPolicy(Frozen):
    """Settings of on-policy methods."""

    n_steps: int = Field(25, ge=1, description="steps of each environment between updates")
    ent_coef: float = Field(0.01, ge=0, description="weight of the policy's entropy")
