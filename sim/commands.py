"""Commands of the simulated operating room: `femoreg phantom`, `simulate`, `dataset` and `demo`."""

from pathlib import Path
from typing import Literal


def phantom(out: Path, *, seed: int = 1, side: Literal["left", "right"] = "left", spacing_mm: float = 1.0) -> None:
    """Make a procedural patient: CT, labels, landmarks, a plan and a drilling device.

    Args:
        out: Folder to write; `femoreg simulate` takes it as its case.
        seed: The same seed gives the same patient and device.
        side: Hip to be operated.
        spacing_mm: Voxel size of the CT.
    """
    from rich.console import Console

    from sim.writing import write_phantom

    console = Console()
    with console.status("building the patient"):
        write_phantom(out, seed, side, spacing_mm)
    console.print(f"Patient {seed} written to {out}")


def simulate(
    case: Path,
    *,
    out: Path,
    seed: int = 1,
    side: Literal["left", "right"] | None = None,
    config: str = "paper",
) -> None:
    """Simulate the six-image acquisition of the paper: a complete case folder with its truth.

    Args:
        case: Folder with ct.nii.gz, labels.nii.gz and landmarks.json, or with a case.yaml.
        out: Case folder to write.
        seed: The same seed gives the same poses and the same images.
        side: Hip to be operated; that of case.yaml, or the left one, if not given.
        config: Preset of `configs/simulation`, or a YAML file.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from sim.writing import SIMULATION_STEPS, write_simulation

    console = Console()
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("reading the patient", total=SIMULATION_STEPS)

        def report(step: str) -> None:
            progress.update(task, advance=1, description=step)

        write_simulation(case, out, seed, side, config, report)
    console.print(f"Simulated case {seed} written to {out} (look at {out / 'preview.png'})")


def dataset(config: str, *, out: Path) -> None:
    """Render labelled fluoroscopy into an HDF5 file in the layout of the public DeepFluoro data set.

    Args:
        config: Preset of `configs/simulation` with patients, views and X-ray settings (deepfluoro), or a YAML file.
        out: File to write, `.h5`; about half a second and 0.1 MB for an image of 180 × 180 pixels.
    """
    from rich.console import Console

    from sim.deepfluoro import write_dataset

    console = Console()
    with console.status("reading the settings") as status:
        write_dataset(config, out, lambda source: status.update(f"imaging {source}"))
    console.print(f"Simulated data set written to {out}")


def demo(*, out: Path = Path("out/demo"), seed: int = 1, preset: str = "fast") -> None:
    """Run the main job end to end on a procedural patient: simulate six images, register, measure, report.

    Args:
        out: Folder to write: patient/, case/ and run/ with result.json, overlay.png and report.html.
        seed: Of the patient, the acquisition and the registration.
        preset: Registration workflow in configs/registration.
    """
    from rich.console import Console

    from femoreg_torch.commands.evaluate import evaluate
    from femoreg_torch.commands.register import register

    console = Console()
    console.rule("1 Procedural patient (synthetic anatomy)")
    phantom(out / "patient", seed=seed)
    console.rule("2 Simulated fluoroscopy: three C-arm poses, with and without the device")
    simulate(out / "patient", out=out / "case", seed=seed)
    console.rule("3 Landmarks, start pose and registration")
    register(out / "case", out=out / "run", preset=preset, seed=seed)
    console.rule("4 Errors against the simulation's truth")
    evaluate(out / "case", out / "run")
    console.print("Research software, not a medical device: everything above is simulated.")
