"""What programs that draw may be asked for, and what it is if they are not; without torch, as all that --help shows."""

from typing import Literal

FormName = Literal["mp4", "gif"]
"""Of a film."""
EMBEDDING_SHOTS = 3
"""Demonstrations that policies are adapted to for the t-SNE, as in Figure 4a."""
PERPLEXITY = 30.0
"""Of the t-SNE: about how many neighbours count as near."""
SEED = 0
"""Of the t-SNE."""
