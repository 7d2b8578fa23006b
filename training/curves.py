"""The learning curves of a run as a picture."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from femoreg_torch.files import temporary_file


def draw_curves(events: Path, picture: Path) -> None:
    """Draw losses and validation accuracy over the steps from a folder of TensorBoard events into a PNG.

    A run that was resumed has several event files in one folder, and one curve.
    """
    log = EventAccumulator(str(events), size_guidance={"scalars": 0})
    log.Reload()
    figure = Figure(figsize=(9, 3), layout="constrained")
    losses, accuracy = figure.subplots(1, 2)
    logged = (tag.removeprefix("train/") for tag in log.Tags()["scalars"] if tag.startswith("train/"))
    for n, name in enumerate(sorted(logged)):
        _plot(losses, log, f"train/{name}", f"{name}, training", f"C{n}", 0.4)
        _plot(losses, log, f"validation/{name}", f"{name}, validation", f"C{n}", 1.0)
    _plot(accuracy, log, "validation/landmark_within_2px", "landmarks within 6.2 mm", "tab:blue", 1.0)
    _plot(accuracy, log, "validation/visibility", "visibility right", "tab:green", 1.0)
    _plot(accuracy, log, "validation/pixel_accuracy", "labels right", "tab:orange", 1.0)
    losses.set(xlabel="step", ylabel="loss", yscale="log")
    accuracy.set(xlabel="step", ylabel="share, validation", ylim=(0, 1))
    for axes in (losses, accuracy):
        axes.grid(alpha=0.3)
        if axes.get_lines():
            axes.legend(fontsize=7)
    with temporary_file(picture) as part:
        figure.savefig(part, dpi=90)


def _plot(axes: Axes, log: EventAccumulator, tag: str, label: str, colour: str, opacity: float) -> None:
    if tag in log.Tags()["scalars"]:
        scalars = log.Scalars(tag)
        axes.plot([s.step + 1 for s in scalars], [s.value for s in scalars], label=label, color=colour, alpha=opacity)
