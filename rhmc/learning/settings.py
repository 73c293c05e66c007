"""Settings that several methods have, under one name and one meaning each."""

from pydantic import Field

from rhmc.learning.normalisation import Scale
from rhmc.networks.nets import EncoderName
from rhmc.types import Frozen


class Networks(Frozen):
    """What every method has; the defaults are the paper's (section 5.1) where it gives a value."""

    encoder: EncoderName = "mlp"
    hidden: int = Field(64, ge=1, description="units of each hidden layer")
    share: bool = Field(True, description="one network for all agents; with `mlp` it is told the agent's one-hot id")
    lr: float = Field(5e-4, gt=0, description="Adam's step size")
    grad_clip: float = Field(10.0, gt=0, description="largest norm of a network's gradient")


class Slow(Networks):
    """For methods that learn towards a slow copy of a network."""

    polyak: float = Field(0.995, ge=0, le=1, description="share of the slow copies kept per update")


class Standardised(Frozen):
    """For methods that learn from one reward and one discount."""

    gamma: float = Field(0.99, ge=0, le=1)
    standardise: Scale = Field(
        "reward",
        description="learn from rewards, or predict returns, of mean 0 and deviation 1 (`rhmc.learning.normalisation`)",
    )


class OffPolicy(Frozen):
    """For methods that learn from a replay."""

    buffer: int = Field(50_000, ge=1, description="rows kept: environment steps")
    batch: int = Field(256, ge=1, description="rows of an update")
    warmup: int = Field(2_000, ge=0, description="environment steps before the first update")
    steps_per_update: int = Field(64, ge=1, description="environment steps collected for each update")


class OnPolicy(Frozen):
    """For methods that learn from what they have just done."""

    rollout: int = Field(25, ge=1, description="steps of each environment between updates")
    entropy: float = Field(0.01, ge=0, description="weight of the policy's entropy")
