"""Commands of the simulated operating room: patients, procedures on them, labelled images, and the demo."""

from pathlib import Path
from typing import Annotated, Literal


def phantom(out: Path, *, seed: int = 1, side: Literal["left", "right"] = "left", spacing_mm: float = 1.0) -> None:
    """Make a procedural patient: CT, labels, landmarks, a plan and a drilling device.

    Args:
        out: Folder to write; `femoreg simulate` takes it as its case.
        seed: The same seed gives the same patient and device.
        side: Hip to be operated.
        spacing_mm: Voxel size of the CT, 0.5 to 2 mm.
    """
    from rich.console import Console

    from femoreg_torch.commands.telling import in_place_of
    from femoreg_torch.files import check_new_folder
    from sim.theatre.case_folders import write_phantom

    check_new_folder(out)
    before = in_place_of(out)
    console = Console()
    with console.status("building the patient"):
        write_phantom(out, seed, side, spacing_mm)
    console.print(f"Patient {seed} written to {out}{before}")


def around_surfaces(
    surfaces: Path,
    *,
    out: Path,
    seed: int = 7,
    spacing_mm: float = 1.0,
    osteoporotic: float = 1.0,
    below_mm: int = 165,
) -> None:
    """Make a patient around real bone surfaces: CT with invented grey values, labels, landmarks.

    Args:
        surfaces: NumPy archive (.npz) with BONE_vertices and BONE_faces in LPS mm of hip_left, hip_right, sacrum,
            femur_left and femur_right: closed surfaces, femora of 280 mm below the head or more.
        out: Folder to write; `femoreg simulate` takes it as its case.
        seed: The same seed gives the same texture, soft tissue and noise.
        spacing_mm: Voxel size of the CT, 0.5 or 1; both show the same patient. 0.5 mm needs 8 GB of memory.
        osteoporotic: 1 for healthy bone, down to 0.1; scales the spongy bone, and the cortex by its square root.
        below_mm: Femur in the CT below the centres of the heads, 100 to 300.
    """
    from rich.console import Console

    from femoreg_torch.commands.telling import in_place_of
    from femoreg_torch.files import check_new_folder
    from sim.patient.around_surfaces import Options, write_patient_around

    check_new_folder(out)
    before = in_place_of(out)
    console = Console()
    with console.status("building the patient"):
        write_patient_around(surfaces, out, Options(seed, spacing_mm, osteoporotic, below_mm))
    console.print(f"Patient around {surfaces} written to {out}{before}")


def around_labels(label_map: Path, *, out: Path, labels: str, seed: int = 1, spacing_mm: float = 1.0) -> None:
    """Make a patient around the bones of a label map: CT with invented grey values, labels, landmarks.

    Args:
        label_map: NIfTI, NRRD or MHA file with whole pelvis and upper femora; its grey values are not needed.
        out: Folder to write; `femoreg simulate` takes it as its case.
        labels: Label table that tells the map's ids, in `configs/anatomy/labels` (pelvic_ref, autoseg, …), or a YAML
            file.
        seed: The same seed gives the same bone density, soft tissue and noise.
        spacing_mm: Voxel size of the CT.
    """
    from rich.console import Console

    from femoreg_torch.anatomy import label_table
    from femoreg_torch.commands.telling import in_place_of
    from femoreg_torch.files import check_new_folder
    from sim.patient.from_labels import write_label_patient

    check_new_folder(out)
    before = in_place_of(out)
    table = label_table(labels)
    console = Console()
    with console.status("building the patient"):
        write_label_patient(label_map, table, out, seed, spacing_mm)
    console.print(f"Patient around {label_map} written to {out}{before}")


def simulate(
    case: Path,
    *,
    out: Path,
    seed: int = 1,
    side: Literal["left", "right"] | None = None,
    config: str = "paper",
    device: Literal["cpu", "cuda", "auto"] = "cpu",
) -> None:
    """Simulate the six-image acquisition of the paper: a complete case folder with its truth.

    Args:
        case: Folder with a case.yaml, or with ct.nii.gz, labels.nii.gz and landmarks.json.
        out: Case folder to write.
        seed: The same seed gives the same poses and the same images.
        side: Hip to be operated; that of case.yaml, or the left one, if not given.
        config: Preset of `configs/simulation`, or a YAML file.
        device: Where rays are cast: cpu, cuda (the first GPU), or auto, a GPU where there is one. Noise is drawn on the
            CPU, so that a seed gives the same image but for rounding.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from femoreg_torch.case import case_folder
    from femoreg_torch.commands.telling import in_place_of, tell_device
    from femoreg_torch.files import check_new_folder
    from sim.theatre.case_folders import SIMULATION_STEPS, write_simulation

    console = Console()
    place = tell_device(console, device)
    case = case_folder(case)
    check_new_folder(out, case)
    before = in_place_of(out)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("reading the patient", total=SIMULATION_STEPS)

        def report(step: str) -> None:
            progress.update(task, advance=1, description=step)

        write_simulation(case, out, seed, side, config, report, device=place)
    console.print(f"Simulated case {seed} written to {out}{before} (look at {out / 'preview.png'})")


def dataset(config: str, *, out: Path) -> None:
    """Render labelled fluoroscopy into an HDF5 file in the layout of the public DeepFluoro data set.

    Args:
        config: Preset of `configs/simulation` with patients, views and X-ray settings (deepfluoro), or a YAML file.
        out: File to write, `.h5`; about half a second and 0.1 MB for an image of 180 × 180 pixels.
    """
    from rich.console import Console

    from femoreg_torch.commands.telling import in_place_of
    from femoreg_torch.files import check_suffix
    from sim.labelled.deepfluoro import write_dataset

    check_suffix(out, (".h5", ".hdf5"))
    before = in_place_of(out)
    console = Console()
    with console.status("reading the settings") as status:
        write_dataset(config, out, lambda source: status.update(f"imaging {source}"))
    console.print(f"Simulated data set written to {out}{before}")


def labelled_images(
    patient: Path, *, out: Path, count: int = 140, seed: int = 1, config: str = "labelled", name: str | None = None
) -> None:
    """Render labelled fluoroscopy of one patient, with true poses, for `femoreg measure`.

    Args:
        patient: Folder with a case.yaml, or with ct.nii.gz, labels.nii.gz and landmarks.json.
        out: File to write, `.safetensors`; a few seconds for an image.
        count: Number of views.
        seed: The same seed gives the same views.
        config: Preset of `configs/simulation` with views and X-ray settings (labelled), or a YAML file.
        name: Who it is; the folder's name, if not given. Images of one name count as one patient.
    """
    from rich.console import Console

    from femoreg_torch.commands.telling import in_place_of
    from femoreg_torch.files import check_suffix
    from sim.labelled.image_files import write_labelled_images

    check_suffix(out, (".safetensors",))
    before = in_place_of(out)
    console = Console()
    with console.status(f"imaging {patient}"):
        write_labelled_images(patient, out, config, count, seed, name)
    console.print(f"{count} labelled images written to {out}{before}")


def study(
    config: str,
    *,
    out: Path,
    procedures: Annotated[int | None, "-n"] = None,
    jobs: int = 1,
    scheduler: str | None = None,
    data: Path | None = None,
    keep_cases: bool = False,
    reuse: bool = False,
) -> int:
    """Simulate and register many procedures under one or many conditions, and write one table of all runs.

    Each run is kept in OUT/runs as soon as it is done. Started again after it was killed, the command goes on with the
    runs that are missing; runs of other code are made anew, and runs of other settings stay beside them, out of the
    table. A run that fails does not stop the others. The table is OUT/runs.parquet. Status 1 if a run failed.

    Args:
        config: Protocol in configs/study, or a YAML file: `paper`, `closed_loop`, `dose`, … (see docs/study.md).
        out: Folder of the runs and of the table.
        procedures: The first so many procedures; as many as the protocol says, if not given.
        jobs: Procedures at the same time, on one core each; each needs up to 4 GB of memory.
        scheduler: Address of a Dask scheduler, whose workers then do the work in place of this machine.
        data: Folder with meshes/SUBJECT.npz of real bones, for protocols that name `subjects`.
        keep_cases: Keep the simulated case folders in OUT/cases, some 50 MB each.
        reuse: Take runs that are there although the code has changed since.
    """
    from rich.console import Console

    from femoreg_torch.errors import InputError
    from femoreg_torch.files import check_folder
    from sim.study.engine import Executor
    from sim.study.executors import OnCluster, OnThisMachine
    from sim.study.study import plan_study
    from sim.study.telling import carry_out_told

    if jobs < 1:
        raise InputError(f"--jobs: at least 1 was expected, got {jobs}.")
    check_folder(out)
    with Console().status("reading the protocol"):
        plan = plan_study(config, procedures, out.resolve(), data, keep_cases)
    executor: Executor = OnThisMachine(jobs) if scheduler is None else OnCluster(scheduler)
    return carry_out_told(plan, out, executor, reuse)


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
    from femoreg_torch.files import check_folder, check_new_folder
    from femoreg_torch.registration import load_plan

    check_folder(out)  # all of this before half a minute of work
    for part in ("patient", "case", "run"):
        check_new_folder(out / part)
    load_plan(preset)
    console = Console()
    console.rule("1 Procedural patient (synthetic anatomy)")
    phantom(out / "patient", seed=seed)
    console.rule("2 Simulated fluoroscopy: three C-arm poses, with and without the device")
    simulate(out / "patient", out=out / "case", seed=seed)
    console.rule("3 Landmarks, start pose and registration")
    register(out / "case", out=out / "run", preset=preset, seed=seed)
    console.rule("4 Errors against the simulation's truth")
    evaluate(out / "case", out / "run")
    console.print(
        "That the guide's tip is far from the entry point is meant: the device is imaged in front of the patient, "
        "before it is moved there."
    )
    console.print("Research software, not a medical device: everything above is simulated.")
