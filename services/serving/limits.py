"""What the service bears: how many policies it keeps and for how long, how large a request is, how many at once."""

from dataclasses import dataclass

from dmil_core.errors import UserError


@dataclass(frozen=True)
class Limits:
    """Limits of the service, of all replicas together or of each."""

    policies: int = 1000
    """Policies kept by all replicas together; above it the one that was posted longest ago is evicted."""
    megabytes: float = 1000.0
    """Of all policies kept, as they are saved."""
    hours: float = 24.0
    """A policy is kept after it was posted last."""
    body_megabytes: float = 16.0
    """Of the body of a request."""
    demonstrations: int = 100
    """Demonstrations in a request."""
    steps: int = 2000
    """Gradient steps of an adaptation."""
    observations: int = 1024
    """Observations in a request."""
    adaptations: int = 4
    """Adaptations that wait or run in a replica; more are refused until one ends."""
    requests: int = 64
    """Requests that a replica answers at once; more are refused."""
    sockets: int = 64
    """Control loops that a replica has open at once; more are refused."""
    cached: int = 128
    """Policies that a replica holds ready to act."""

    def __post_init__(self) -> None:
        """See that each is above 0.

        Raises:
            UserError: names the one that is not.
        """
        for name, value in vars(self).items():
            if not 0 < value < 2**53:
                raise UserError(f"--limits.{name.replace('_', '-')}: got {value}; wanted a number above 0")

    @property
    def body(self) -> int:
        """Bytes of the body of a request."""
        return int(self.body_megabytes * 1e6)
