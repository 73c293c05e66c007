"""Settings of methods whose networks may have memory; apart from the others', which name every method's runs."""

from pydantic import Field

from rhmc.learning.settings import Networks
from rhmc.networks.recurrent import AnyEncoderName, remembers


class Recurrent(Networks):
    """Settings of methods whose networks may have memory."""

    encoder: AnyEncoderName = Field(  # type: ignore[assignment]  # more than those of a method without memory
        "mlp",
        description="`mlp`: all features in a row; `pairwise`: one network for all (agent, target) pairs, pooled; "
        "`mlp_gru`, `pairwise_gru`: the same with a GRU behind, which remembers within an episode",
    )
    segment_length: int = Field(
        8, ge=1, description="with a GRU: steps in a row that are learned from at once, through which gradients flow"
    )

    @property
    def remembers(self) -> bool:
        """True if the encoder has memory."""
        return remembers(self.encoder)

    def need_segments(self, name: str) -> None:
        """See that a number of steps is one of whole segments.

        Raises:
            ValueError: it is not, and there is a GRU.
        """
        steps = getattr(self, name)
        if self.remembers and steps % self.segment_length:
            allowed = f"multiples of segment_length, {self.segment_length}"
            raise ValueError(f"{name}: {steps} is not allowed with encoder '{self.encoder}'; allowed: {allowed}")
