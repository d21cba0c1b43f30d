"""The card of a model that is shipped: what it is, how it was made, how well it does, and what it is not for."""

from dmil_core.checkpoint import Checkpoint, Manifest
from dmil_core.methods.base import FineTuning
from services.evaluation.summary import Summary, table_markdown
from services.reporting.provenance import training_command

CARD = "README.md"
"""In a model's folder."""


def model_card(name: str, checkpoint: Checkpoint, summary: Summary, size: int) -> str:
    """Return the card of a model as Markdown; `size` is that of the files that are loaded, in bytes."""
    manifest = checkpoint.manifest
    config = manifest.config
    paragraphs = [
        f"# {name}",
        f"{config.method.name} meta-trained on {config.suite.name}: {manifest.size:,} parameters, {size / 1e6:.1f} MB. "
        "Its licence is the project's.",
        f'```python\nimport dmil_core as dmil\n\npolicy = dmil.load("{name}").adapt([(observations, actions)])\n```',
        f"{_interface(manifest)}{_adaptation(config.evaluation.fine_tuning)}",
        "## How it was made",
        f"```bash\n{training_command(config)}\n```",
        *_making(manifest, summary.checkpoint_digest),
        "## Figures",
        table_markdown(summary).rstrip(),
        "Success rates with Wilson's 95% intervals, over episodes.",
        "## Limits",
        *_limits(summary),
    ]
    return "\n\n".join(paragraphs) + "\n"


def _interface(manifest: Manifest) -> str:
    observed, actions = manifest.observed, manifest.actions
    if observed is None or actions is None:
        return ""
    return (
        f"An observation is the {len(observed)} numbers that {manifest.config.suite.name} has, an action "
        f"{len(actions)} numbers between {min(actions.low):g} and {max(actions.high):g}. "
    )


def _adaptation(fine_tuning: FineTuning) -> str:
    copies = (
        f", on {fine_tuning.displaced} displaced copies of the support set besides" if fine_tuning.displaced else ""
    )
    return (
        f"It adapts by {fine_tuning.steps} steps of {fine_tuning.optimiser} at {fine_tuning.learning_rate:g}{copies}."
    )


def _making(manifest: Manifest, digest: str) -> list[str]:
    data = manifest.config.demonstrations
    versions = ", ".join(f"{library} {version}" for library, version in manifest.versions.items())
    source = "the suite's scripted experts" if data.source == "expert" else data.source
    return [
        f"- **Data**: {data.per_task} demonstrations of each of {len(manifest.data)} tasks, by {source}; of each task "
        f"{data.held_out} are held out as support sets. `manifest.json` has their SHA-256.",
        f"- **Settings**: {manifest.iteration:,} iterations, seed {manifest.config.seed}; `manifest.json` has all.",
        f"- **Versions**: {versions}. The run's checkpoint has the digest {digest[:16]}.",
    ]


def _limits(summary: Summary) -> list[str]:
    collapsed = (
        "- One sub-skill takes nearly all states: the figures speak for few-shot imitation, not for the hierarchy."
    )
    return [
        "- One seed of training, in simulation. Nothing was measured on a robot.",
        f"- The protocol: {summary.protocol}. A policy sees state vectors, no pictures.",
        *([collapsed] if summary.collapsed else []),
        "- Another robot, other sensors or other units need a model of their own; see *When not to trust it* in "
        "docs/use-a-policy.md.",
    ]
