"""The command `femoreg train`."""

from pathlib import Path


def train(
    settings: Path,
    *,
    out: Path,
    cases: list[Path] | None = None,
    cache: Path | None = None,
    override: list[str] | None = None,
    start: Path | None = None,
    resume: bool = False,
) -> None:
    """Train the landmark and segmentation network and export its weights.

    Views are rendered once into the cache; a run that was stopped goes on with `--resume`. OUT holds the logs
    (CSV and TensorBoard), checkpoints, and hip14.safetensors, the moving average of the weights at their best
    validation loss.

    Args:
        settings: YAML file such as configs/training/hip14.yaml.
        out: folder of this run.
        cases: folders with ct.nii.gz, labels.nii.gz and landmarks.json to learn from, beside the procedural patients.
        cache: folder of rendered views, to share between runs; by default OUT/cache.
        override: settings as group.key=value, for instance '[optimisation.epochs=3, cohort.views=10]'.
        start: weights (safetensors) to begin with instead of random ones.
        resume: continue from the last checkpoint in OUT.
    """
    from training.run import train_network
    from training.settings import read_settings

    train_network(read_settings(settings, override or []), cases or [], out, cache or out / "cache", start, resume)
